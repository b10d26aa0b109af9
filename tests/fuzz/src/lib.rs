//! What the targets share: an experiment of the smallest size, and how bytes become a few of their own.
//!
//! Whatever the bytes, the outcome is a value or an error; a panic is a finding. What was found is a test beside the
//! code that it was found in.

use comic_experiment::{Experiment, TaskSpec, resolve};
use comic_proto::{UnrollLayout, UnrollShape};

/// A tracking experiment whose every layer is narrow, so that a run takes little time and its seeds little room.
pub fn experiment() -> Experiment {
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
    resolve("tracking-mlp", &overrides.map(String::from)).expect("the experiment is sound")
}

/// What its task observes.
pub fn spec(experiment: &Experiment) -> TaskSpec {
    TaskSpec::new(experiment, vec!["one".into(), "another".into()]).expect("the observations are known")
}

/// How its unrolls lie in memory.
pub fn layout(spec: &TaskSpec, experiment: &Experiment) -> UnrollLayout {
    UnrollLayout::new(UnrollShape::new(spec, experiment))
}

/// Where the target is to write what is sound, if that is all it is asked to do: `COMIC_FUZZ_SEEDS=DIR`.
pub fn seed(name: &str, bytes: &[u8]) {
    if let Some(directory) = std::env::var_os("COMIC_FUZZ_SEEDS") {
        let path = std::path::Path::new(&directory).join(name);
        std::fs::write(&path, bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    }
}
