//! The replay's table against bare copies of the same bytes.

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow};
use clap::Args;
use comic_experiment::{TaskName, TaskSpec};
use comic_proto::{Field, UnrollLayout, UnrollShape};
use comic_replay::{Sample, Table, TableConfig};
use rand::SeedableRng as _;
use rand::seq::index;
use rand_pcg::Pcg64;

use crate::figure::{Figure, interleave};
use crate::transfer;

/// Measure how fast unrolls enter the replay's table, and how fast minibatches are sampled from it
///
/// `value` and `floor` are MB/s, so a `ratio` of 1 is the best. `replay.insert`: minibatches are inserted into a full table.
/// `replay.sample`: minibatches are sampled from it. The floor is a bare copy for each unroll, of as many bytes, between two arrays
/// of the same sizes: to places in their order, or from random places. go-to-target's unrolls have no image; `.images` are
/// those of gaps. All are medians of interleaved repeats.
#[derive(Debug, Args)]
pub struct Replay {
    /// Seconds for each figure
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Size of the table, MiB. The floor's array has the same size
    #[arg(long, default_value_t = 512)]
    table_mib: usize,
}

/// Unrolls of a minibatch.
const MINIBATCH: usize = 64;
/// Bytes of a repeat, about.
const REPEAT: usize = 128 << 20;

impl Replay {
    /// Measures and prints.
    ///
    /// # Errors
    /// A table that is too small for a minibatch.
    pub fn run(&self) -> Result<()> {
        let budget =
            Duration::try_from_secs_f64(self.seconds).with_context(|| format!("--seconds {}", self.seconds))?;
        for (task, [insert, sample]) in [
            (TaskName::GoToTarget, ["replay.insert", "replay.sample"]),
            (TaskName::Gaps, ["replay.insert.images", "replay.sample.images"]),
        ] {
            let (mut full, mut bare) = pair(task, self.table_mib << 20)?;
            let bytes = bare.minibatch.len();
            let inserted = interleave::<anyhow::Error>(budget, || {
                Ok((speed(bytes, || full.insert()), speed(bytes, || bare.insert())))
            })?;
            Figure::new(insert, "MB/s", inserted, "floor: bare copies to an array of the same size").print()?;
            let sampled = interleave::<anyhow::Error>(budget, || {
                Ok((speed(bytes, || full.sample()), speed(bytes, || bare.sample())))
            })?;
            Figure::new(sample, "MB/s", sampled, "floor: bare copies from an array of the same size").print()?;
        }
        Ok(())
    }
}

/// A full table and a minibatch.
struct Full {
    table: Table,
    minibatch: Sample,
    random: Pcg64,
}

/// As many bytes in two arrays, in which the bytes of an unroll are together.
struct Bare {
    table: Vec<u8>,
    minibatch: Vec<u8>,
    /// Bytes of an unroll.
    unroll: usize,
    /// Where the next unroll is inserted.
    next: usize,
    random: Pcg64,
}

/// Both, for unrolls of this task, with tables of about so many bytes.
fn pair(task: TaskName, bytes: usize) -> Result<(Full, Bare)> {
    let experiment = transfer::experiment(task);
    let spec = TaskSpec::new(&experiment, Vec::new()).map_err(|name| anyhow!("no observation `{name}`"))?;
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(&spec, &experiment)));
    let unroll = layout.size();
    let config = TableConfig { max_size: bytes / unroll, sample_size: MINIBATCH, memory: u64::MAX };
    let mut table = Table::new(Arc::clone(&layout), config)?;
    let mut minibatch = Sample::new(layout, MINIBATCH);
    // Memory that was never written is one page of zeros, which the caches hold.
    for slot in 0..MINIBATCH {
        Field::ALL.into_iter().for_each(|field| minibatch.unrolls.bytes_mut(field, slot).fill(1));
    }
    while table.len() < table.max_size() {
        table.insert(&minibatch.unrolls, &minibatch.tasks);
    }
    let bare = Bare {
        table: vec![1; table.max_size() * unroll],
        minibatch: vec![1; MINIBATCH * unroll],
        unroll,
        next: 0,
        random: Pcg64::seed_from_u64(1),
    };
    Ok((Full { table, minibatch, random: Pcg64::seed_from_u64(1) }, bare))
}

impl Full {
    fn insert(&mut self) {
        self.table.insert(&self.minibatch.unrolls, &self.minibatch.tasks);
    }

    fn sample(&mut self) {
        self.table.sample(&mut self.minibatch, &mut self.random);
    }
}

impl Bare {
    fn insert(&mut self) {
        for unroll in self.minibatch.chunks_exact(self.unroll) {
            self.table[self.next..][..self.unroll].copy_from_slice(unroll);
            self.next = (self.next + self.unroll) % self.table.len();
        }
    }

    fn sample(&mut self) {
        let places = index::sample(&mut self.random, self.table.len() / self.unroll, MINIBATCH);
        for (unroll, place) in self.minibatch.chunks_exact_mut(self.unroll).zip(places) {
            unroll.copy_from_slice(&self.table[place * self.unroll..][..self.unroll]);
        }
        // Otherwise the compiler may remove copies that nothing reads.
        black_box(&mut self.minibatch);
    }
}

/// MB/s of minibatches of so many bytes, one for each call.
fn speed(bytes: usize, mut minibatch: impl FnMut()) -> f64 {
    let minibatches = REPEAT.div_ceil(bytes);
    let begin = Instant::now();
    (0..minibatches).for_each(|_| minibatch());
    (minibatches * bytes) as f64 / 1e6 / begin.elapsed().as_secs_f64()
}
