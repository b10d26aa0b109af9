//! The gradient step against its bare matrix products.
//!
//! # Layout
//! - [`ranks`] is the step of several learners together.
//! - [`mod@floor`] is the least that an update can cost, [`vmpo`] and [`svg0`] have its layers; [`recorded`] is the batch that is
//!   learned from.

mod floor;
mod ranks;
mod recorded;
mod svg0;
mod vmpo;

use std::time::Instant;

use anyhow::{Result, anyhow};
use clap::Args;
use comic_experiment::{AlgorithmName, DeviceName, Experiment, Learner, LowLevelName, TaskName, TaskSpec};
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::algorithm::{Algorithm, Parts};
use comic_learner::algorithms;
use comic_learner::device::Backend;
use comic_learner::world::World;
use serde_json::json;
use tch::Device;

use crate::busy::Busy;
use crate::median::median;
use crate::transfer;
use floor::Floor;
use recorded::Recorded;

pub use ranks::Ranks;

/// Measure a gradient step of paper size against the matrix products of the same shapes
///
/// V-MPO's has 128 unrolls of 32 steps. SVG(0)'s has 64, with 8 rows of burn-in, of go-to-target with a latent as its action.
///
/// `value` is milliseconds of the step with its batch on the device. `floor` is milliseconds of its matrix products,
/// forward and backward, on the same threads, and of libtorch's own LSTM where the network has one. `copy` is milliseconds
/// of bringing the batch to the device, `read_back` of bringing the parameters back. `learner.update.contended` is the step beside
/// `--beside N` busy processes, against the same alone; with one for each core fair sharing is 2. All are medians of
/// interleaved repeats.
#[derive(Debug, Args)]
pub struct Update {
    /// libtorch's threads
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Interleaved repeats, of which the median is printed
    #[arg(long, default_value_t = 15)]
    repeats: usize,
    /// The low level: mlp, lstm, mixture or product. All but mlp add their name to the figure's
    #[arg(long, default_value_t = LowLevelName::Mlp)]
    low_level: LowLevelName,
    /// Joint training of two tasks, and beside it the first task alone
    #[arg(long, conflicts_with = "low_level")]
    joint: bool,
    /// SVG(0) instead of V-MPO
    #[arg(long, conflicts_with_all = ["low_level", "joint"])]
    svg0: bool,
    /// A preset's own networks and minibatch. Its name is added to the figure's
    #[arg(long, value_name = "NAME", conflicts_with_all = ["low_level", "joint", "svg0"])]
    preset: Option<String>,
    /// Measure it also beside so many busy processes of equal priority
    #[arg(long, value_name = "N")]
    beside: Option<usize>,
    /// Where the update runs: cpu, cuda, cuda:N, xla or xla:N
    #[arg(long, value_name = "DEVICE", default_value_t = DeviceName::default())]
    device: DeviceName,
}

/// Repeats that warm up and are not counted.
const WARM_UP: usize = 2;

impl Update {
    /// Measures and prints.
    ///
    /// # Errors
    /// A device that does not exist; an error of libtorch.
    pub fn run(&self) -> Result<()> {
        tch::set_num_threads(self.threads as i32);
        tch::manual_seed(1);
        let (experiment, figure) = self.subject()?;
        let backend = Backend::open(&Learner { device: self.device, ..experiment.learner.clone() })?;
        let mut networks = Networks::new(&experiment, &backend, &World::alone())?;
        let alone = Experiment { joint: Vec::new(), ..experiment.clone() };
        let mut one_task = self.joint.then(|| Networks::new(&alone, &backend, &World::alone())).transpose()?;
        let products = floor(&networks.spec, &experiment, backend.device());
        let (mut updates, mut one_tasks, mut floors) = (Vec::new(), Vec::new(), Vec::new());
        let (mut copies, mut reads, mut contended) = (Vec::new(), Vec::new(), Vec::new());
        for repeat in 0..self.repeats + WARM_UP {
            let copy = milliseconds(|| networks.refill(&backend))?;
            let update = networks.update(&backend)?;
            let read = milliseconds(|| networks.learner.policy_parameters())?;
            let one_task = one_task.as_mut().map(|networks| networks.update(&backend)).transpose()?;
            let floor = milliseconds(|| products.run(&backend))?;
            if let Some(neighbours) = self.beside.filter(|_| repeat >= WARM_UP) {
                let _neighbours = Busy::start(neighbours)?;
                contended.push(networks.update(&backend)?);
            }
            if repeat >= WARM_UP {
                updates.push(update);
                copies.push(copy);
                reads.push(read);
                one_tasks.extend(one_task);
                floors.push(floor);
            }
        }
        let (value, floor) = (median(updates), median(floors));
        let mut line = json!({
            "figure": figure, "value": value, "unit": "ms", "floor": floor, "ratio": value / floor,
            "threads": self.threads, "repeats": self.repeats, "device": self.device.to_string(),
            "copy": median(copies), "read_back": median(reads), "compilations": backend.compilations()?,
        });
        if !one_tasks.is_empty() {
            let one_task = median(one_tasks);
            line["one_task"] = json!(one_task);
            line["against_one_task"] = json!(value / one_task);
        }
        println!("{line}");
        if !contended.is_empty() {
            let (figure, alone, contended) = (format!("{figure}.contended"), value, median(contended));
            let ratio = contended / alone;
            println!(
                "{}",
                json!({ "figure": figure, "value": contended, "unit": "ms", "floor": alone, "ratio": ratio })
            );
        }
        Ok(())
    }

    /// The experiment that is measured, and the figure's name.
    fn subject(&self) -> Result<(Experiment, String)> {
        if let Some(preset) = &self.preset {
            return Ok((comic_experiment::resolve(preset, &[])?, format!("learner.update.{preset}")));
        }
        if self.svg0 {
            return Ok((transfer::experiment(TaskName::GoToTarget), "learner.svg0".into()));
        }
        let (preset, figure) = match self.low_level {
            _ if self.joint => ("joint-get-up".into(), "learner.update.joint".into()),
            LowLevelName::Mlp => ("tracking-mlp".into(), "learner.update".into()),
            other => (format!("tracking-{other}"), format!("learner.update.{other}")),
        };
        Ok((comic_experiment::resolve(&preset, &[])?, figure))
    }
}

/// Unrolls of a gradient step.
fn unrolls(experiment: &Experiment) -> usize {
    match experiment.algorithm {
        AlgorithmName::Vmpo => vmpo::unrolls(experiment),
        AlgorithmName::Svg0 => svg0::unrolls(experiment),
    }
}

/// The products of a gradient step.
fn floor(spec: &TaskSpec, experiment: &Experiment, device: Device) -> Floor {
    match experiment.algorithm {
        AlgorithmName::Vmpo => vmpo::floor(spec, experiment, device),
        AlgorithmName::Svg0 => svg0::floor(spec, experiment, device),
    }
}

/// Networks of paper size and a batch for them.
struct Networks {
    spec: TaskSpec,
    learner: Box<dyn Algorithm>,
    recorded: Recorded,
    minibatch: MinibatchTensors,
}

impl Networks {
    fn new(experiment: &Experiment, backend: &Backend, world: &World) -> Result<Self> {
        let spec = TaskSpec::new(experiment, vec!["clip".into()]).map_err(|name| anyhow!("no observation `{name}`"))?;
        let (pose, device) = (vec![0.0; spec.action], backend.device());
        let learner = algorithms::learner(Parts { experiment, spec: &spec, pose: &pose, device, world })?;
        let recorded = Recorded::new(&spec, experiment, unrolls(experiment))?;
        let minibatch = recorded.to_tensors(backend.device())?;
        Ok(Self { spec, learner, recorded, minibatch })
    }

    /// Copies the batch to the device again.
    fn refill(&mut self, backend: &Backend) -> Result<()> {
        self.minibatch = self.recorded.to_tensors(backend.device())?;
        backend.end_step()?;
        Ok(backend.wait()?)
    }

    /// Milliseconds of a gradient step.
    fn update(&mut self, backend: &Backend) -> Result<f64> {
        let Self { learner, minibatch, .. } = self;
        milliseconds(|| {
            let losses = learner.step(minibatch)?;
            backend.end_step()?;
            Ok::<_, anyhow::Error>(losses.to_values())
        })
    }
}

fn milliseconds<T, E: Into<anyhow::Error>>(work: impl FnOnce() -> Result<T, E>) -> Result<f64> {
    let start = Instant::now();
    work().map_err(Into::into)?;
    Ok(start.elapsed().as_secs_f64() * 1e3)
}
