//! The gradient step against its bare matrix products.
//!
//! # Layout
//! - [`floor`] is the least that an update can cost; [`recorded`] is the batch that is learned from.

mod floor;
mod recorded;

use std::time::Instant;

use anyhow::{Result, anyhow};
use clap::Args;
use comic_experiment::{DeviceName, Experiment, Learner, LowLevelName, TaskSpec};
use comic_learner::algorithm::Algorithm as _;
use comic_learner::algorithm::minibatch::MinibatchTensors;
use comic_learner::device::Backend;
use comic_learner::vmpo::VmpoLearner;
use comic_networks::to_safetensors;
use serde_json::json;

use crate::busy::Busy;
use crate::median::median;
use floor::Floor;
use recorded::Recorded;

/// Measure a gradient step of paper size (128 unrolls of 32 steps) against the matrix products of the same shapes
///
/// `value` is milliseconds of the step with its batch on the device. `floor` is milliseconds of its matrix products,
/// forward and backward, on the same threads, and of libtorch's own LSTM where the network has one. `copy` is milliseconds
/// of bringing the batch to the device, `read_back` of bringing the parameters back. `learner.update.contended` is the step with
/// one busy process of equal priority for each core, against the same alone; fair sharing is 2. All are medians of
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
    /// Measure it also beside busy processes
    #[arg(long)]
    contended: bool,
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
        let (preset, figure) = self.subject();
        let experiment = comic_experiment::resolve(&preset, &[])?;
        let backend = Backend::open(&Learner { device: self.device, ..experiment.learner.clone() })?;
        let mut networks = Networks::new(&experiment, &backend)?;
        let alone = Experiment { joint: Vec::new(), ..experiment.clone() };
        let mut one_task = self.joint.then(|| Networks::new(&alone, &backend)).transpose()?;
        let products = Floor::new(&networks.spec, &experiment, backend.device());
        let (mut updates, mut one_tasks, mut floors) = (Vec::new(), Vec::new(), Vec::new());
        let (mut copies, mut reads, mut contended) = (Vec::new(), Vec::new(), Vec::new());
        for repeat in 0..self.repeats + WARM_UP {
            let copy = milliseconds(|| networks.refill(&backend))?;
            let update = networks.update(&backend)?;
            let read = milliseconds(|| to_safetensors(networks.learner.policy_store()))?;
            let one_task = one_task.as_mut().map(|networks| networks.update(&backend)).transpose()?;
            let floor = milliseconds(|| products.run(&backend))?;
            if self.contended && repeat >= WARM_UP {
                let _neighbours = Busy::on_every_core()?;
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

    /// The preset that is measured, and the figure's name.
    fn subject(&self) -> (String, String) {
        if self.joint {
            return ("joint-get-up".into(), "learner.update.joint".into());
        }
        let figure = match self.low_level {
            LowLevelName::Mlp => "learner.update".into(),
            other => format!("learner.update.{other}"),
        };
        (format!("tracking-{}", self.low_level), figure)
    }
}

/// Networks of paper size and a batch for them.
struct Networks {
    spec: TaskSpec,
    learner: VmpoLearner,
    recorded: Recorded,
    minibatch: MinibatchTensors,
}

impl Networks {
    fn new(experiment: &Experiment, backend: &Backend) -> Result<Self> {
        let spec = TaskSpec::new(experiment, vec!["clip".into()]).map_err(|name| anyhow!("no observation `{name}`"))?;
        let learner = VmpoLearner::new(&spec, experiment, &vec![0.0; spec.action], backend.device())?;
        let recorded = Recorded::new(&spec, experiment)?;
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
