//! The unrolls of each gradient step: those of the newest batch, or of a replay.

use std::fmt::Debug;
use std::sync::Arc;

use comic_experiment::{Experiment, TransferAlgorithm};
use comic_proto::UnrollLayout;
use comic_replay::{Batch, Sample, Store};
use rand_pcg::Pcg64;
use tch::Device;

use crate::algorithm::minibatch::{MinibatchSource, MinibatchTensors};
use crate::algorithm::shape::MinibatchShape;
use crate::error::{Error, Result};
use crate::train::minibatches::{draw, to_device};

/// Turns batches into the minibatches of gradient steps. It decides how many there are.
pub(super) trait Experience: Debug {
    /// Takes a batch in. Returns how many gradient steps are due.
    ///
    /// # Errors
    /// When the device refuses.
    fn take(&mut self, batch: &Batch, random: &mut Pcg64) -> Result<usize>;

    /// The minibatch of gradient step number `step` since the last batch, which is below what [`take`](Self::take) returned.
    ///
    /// # Errors
    /// When the device refuses.
    fn minibatch(&mut self, step: usize, random: &mut Pcg64) -> Result<MinibatchTensors>;

    /// Frees what the gradient steps of the last batch needed.
    fn release(&mut self) {}
}

/// What the experiment's algorithm learns from.
///
/// # Errors
/// [`Error::Configuration`] when memory cannot hold its replay.
pub(super) fn experience(
    experiment: &Experiment,
    layout: &Arc<UnrollLayout>,
    tasks: usize,
    device: Device,
) -> Result<Box<dyn Experience>> {
    Ok(match experiment.transfer.algorithm {
        TransferAlgorithm::Vmpo => Box::new(Newest { experiment: experiment.clone(), tasks, device, batch: None }),
        TransferAlgorithm::Svg0 => Box::new(Replay::new(experiment, layout, tasks, device)?),
    })
}

/// The newest batch alone: on-policy.
#[derive(Debug)]
struct Newest {
    experiment: Experiment,
    tasks: usize,
    device: Device,
    /// The batch on the device, and the unrolls of each gradient step.
    batch: Option<(MinibatchTensors, Vec<Vec<usize>>)>,
}

impl Experience for Newest {
    fn take(&mut self, batch: &Batch, random: &mut Pcg64) -> Result<usize> {
        let tensors = tracing::debug_span!("to_device").in_scope(|| to_device(batch, self.tasks, self.device))?;
        let steps = draw(&self.experiment, random);
        let count = steps.len();
        self.batch = Some((tensors, steps));
        Ok(count)
    }

    fn minibatch(&mut self, step: usize, _: &mut Pcg64) -> Result<MinibatchTensors> {
        let chosen = self.batch.as_ref().and_then(|(tensors, steps)| Some(tensors.select(steps.get(step)?)));
        chosen.ok_or_else(|| Error::Defect("a gradient step has no batch".into()))
    }

    fn release(&mut self) {
        self.batch = None;
    }
}

/// Sequences of the last batches: off-policy. For each sequence that enters, a fixed number is sampled, so actors and learner
/// keep pace: actors wait while the learner is busy, and the learner waits for a batch.
#[derive(Debug)]
struct Replay {
    store: Store,
    sample: Sample,
    shape: MinibatchShape,
    device: Device,
    /// Sequences sampled for each one inserted.
    samples_per_insert: f64,
    /// Sequences that are there before the first gradient step.
    begin_at: usize,
    /// Sequences that may be sampled now.
    owed: f64,
}

/// Bytes of a MiB.
const MIB: u64 = 1 << 20;

impl Replay {
    fn new(experiment: &Experiment, layout: &Arc<UnrollLayout>, tasks: usize, device: Device) -> Result<Self> {
        let svg0 = &experiment.svg0;
        let minibatch = svg0.minibatch_sequences;
        let limit = svg0.replay_mib.saturating_mul(MIB);
        let store = Store::new(Arc::clone(layout), svg0.replay_steps, minibatch, limit);
        let store =
            store.map_err(|error| Error::configuration(format!("svg0.replay_steps, svg0.replay_mib: {error}")))?;
        Ok(Self {
            sample: Sample::new(layout, minibatch),
            shape: MinibatchShape { unrolls: minibatch, tasks, unroll: *layout.shape() },
            device,
            samples_per_insert: svg0.samples_per_insert,
            begin_at: (svg0.begin_at / layout.shape().length.max(1)).clamp(minibatch, store.capacity()),
            owed: 0.0,
            store,
        })
    }
}

impl Experience for Replay {
    fn take(&mut self, batch: &Batch, _: &mut Pcg64) -> Result<usize> {
        self.store.insert(batch);
        if self.store.len() < self.begin_at {
            return Ok(0);
        }
        let minibatch = self.shape.unrolls as f64;
        self.owed += self.samples_per_insert * batch.unrolls as f64;
        let steps = (self.owed / minibatch).floor();
        self.owed -= steps * minibatch;
        Ok(steps as usize)
    }

    fn minibatch(&mut self, _: usize, random: &mut Pcg64) -> Result<MinibatchTensors> {
        if !self.store.sample(&mut self.sample, random) {
            return Err(Error::Defect("the replay holds no minibatch".into()));
        }
        let Sample { floats, clips, images, tasks } = &self.sample;
        let floats = floats.each_ref().map(|_, values| values.as_slice());
        let source = MinibatchSource { floats, clip: clips, image: images, tasks };
        Ok(MinibatchTensors::new(&source, &self.shape, self.device)?)
    }
}
