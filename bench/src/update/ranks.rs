//! The gradient step of several learners, each a process with its share of the minibatch.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::process::{Child, Command};
use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use comic_learner::device::Backend;
use comic_learner::world::{MEETING, World};
use serde_json::json;
use tch::{Kind, Tensor};

use super::{Networks, WARM_UP};
use crate::median::median;

/// Measure a gradient step that several learners on this machine take together
///
/// `value` is milliseconds of the step, in which each of `ranks` processes has one thread and its share of the minibatch. `floor` is
/// the same without any exchange between them, on the same cores at the same time: the slowest process of each repeat. `one` is one
/// learner with the whole minibatch and as many threads. `sum` is the addition of the gradients alone. All are medians of interleaved
/// repeats. `bytes` is what each rank gives to the sum.
#[derive(Args, Clone, Debug)]
pub struct Ranks {
    /// Processes
    #[arg(long, default_value_t = 2)]
    ranks: usize,
    /// A preset's own networks and minibatch
    #[arg(long, value_name = "NAME", default_value = "tracking-mlp")]
    preset: String,
    /// Interleaved repeats, of which the median is printed
    #[arg(long, default_value_t = 9)]
    repeats: usize,
    /// Which of the processes this is
    #[arg(long, hide = true, requires = "rendezvous")]
    rank: Option<usize>,
    /// Where they meet
    #[arg(long, hide = true)]
    rendezvous: Option<SocketAddr>,
}

impl Ranks {
    /// Measures and prints.
    ///
    /// # Errors
    /// A process that cannot be started, or an error of libtorch.
    pub fn run(&self) -> Result<()> {
        ensure!(self.ranks > 1, "--ranks {}: there must be several", self.ranks);
        if let (Some(rank), Some(rendezvous)) = (self.rank, self.rendezvous) {
            return self.measure(World::meet(rank, self.ranks, rendezvous, None, MEETING)?);
        }
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).context("no free port")?;
        let address = listener.local_addr()?;
        let mut others = (1..self.ranks).map(|rank| self.start(rank, address)).collect::<Result<Vec<_>>>()?;
        let measured = World::meet(0, self.ranks, address, Some(listener), MEETING).map_err(Into::into);
        let measured = measured.and_then(|world| self.measure(world));
        for other in &mut others {
            other.wait()?;
        }
        measured
    }

    fn start(&self, rank: usize, rendezvous: SocketAddr) -> Result<Child> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["ranks", "--ranks", &self.ranks.to_string(), "--preset", &self.preset]);
        command.args(["--repeats", &self.repeats.to_string(), "--rank", &rank.to_string()]);
        command.args(["--rendezvous", &rendezvous.to_string()]);
        command.spawn().context("cannot start another process")
    }

    fn measure(&self, world: World) -> Result<()> {
        let backend = Backend::cpu();
        let whole = comic_experiment::resolve(&self.preset, &[])?;
        let share = whole.share(world.size())?;
        tch::manual_seed(1);
        let mut together = Networks::new(&share, &backend, &world)?;
        let mut apart = Networks::new(&share, &backend, &World::alone())?;
        let mut one = world.is_first().then(|| Networks::new(&whole, &backend, &World::alone())).transpose()?;
        let parameters: usize = together.learner.parameter_counts().iter().map(|(_, count)| count).sum();
        let mut gradients = [Tensor::zeros([parameters as i64], (Kind::Float, backend.device()))];
        let (mut values, mut floors, mut ones, mut sums) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for repeat in 0..self.repeats + WARM_UP {
            tch::set_num_threads(1);
            let slowest = |milliseconds: f64| {
                let all = world.exchange(milliseconds)?;
                Ok::<_, anyhow::Error>(all.into_iter().fold(0.0, f64::max))
            };
            world.exchange(())?;
            let value = slowest(together.update(&backend)?)?;
            let floor = slowest(apart.update(&backend)?)?;
            let begun = Instant::now();
            world.sum(&mut gradients)?;
            let sum = slowest(begun.elapsed().as_secs_f64() * 1e3)?;
            // The others wait meanwhile.
            tch::set_num_threads(self.ranks as i32);
            let alone = one.as_mut().map(|one| one.update(&backend)).transpose()?;
            if repeat >= WARM_UP {
                values.push(value);
                floors.push(floor);
                sums.push(sum);
                ones.extend(alone);
            }
        }
        if world.is_first() {
            let (value, floor, one) = (median(values), median(floors), median(ones));
            let line = json!({
                "figure": format!("learner.ranks.{}", self.preset), "value": value, "unit": "ms", "floor": floor,
                "ratio": value / floor, "one": one, "against_one": value / one, "ranks": self.ranks,
                "repeats": self.repeats, "sum": median(sums), "bytes": 4 * parameters,
            });
            println!("{line}");
        }
        Ok(())
    }
}
