//! What the targets share: a very small experiment, and how seeds are written.
//!
//! Any bytes must give a value or an error; a panic is a finding. For each finding there is a test beside the code that was
//! wrong.

use comic_experiment::{Experiment, TaskSpec, resolve};
use comic_proto::{UnrollLayout, UnrollShape};

/// A tracking experiment with narrow layers, so that runs are fast and seeds are small.
pub fn experiment() -> Experiment {
    experiment_with(&[])
}

/// The same with these overrides.
pub fn experiment_with(more: &[&str]) -> Experiment {
    let overrides = [
        "network.encoder=[2]",
        "network.mlp.hidden=[2]",
        "network.value=[2]",
        "network.latent.size=2",
        "unroll.length=2",
        "unroll.batch=2",
        "vmpo.minibatch_unrolls=2",
        "tracking.observations=[\"body_height\"]",
    ];
    let overrides: Vec<String> = overrides.iter().chain(more).map(|field| (*field).into()).collect();
    resolve("tracking-mlp", &overrides).expect("a valid experiment")
}

/// The observations of its task.
pub fn spec(experiment: &Experiment) -> TaskSpec {
    TaskSpec::new(experiment, vec!["one".into(), "another".into()]).expect("known observations")
}

/// The memory layout of its unrolls.
pub fn layout(spec: &TaskSpec, experiment: &Experiment) -> UnrollLayout {
    UnrollLayout::new(UnrollShape::new(spec, experiment))
}

/// Writes valid bytes as a seed if `COMIC_FUZZ_SEEDS=DIR` is set.
pub fn seed(name: &str, bytes: &[u8]) {
    if let Some(directory) = std::env::var_os("COMIC_FUZZ_SEEDS") {
        let path = std::path::Path::new(&directory).join(name);
        std::fs::write(&path, bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    }
}
