//! The transfer that is measured: SVG(0) gives latents to a frozen low level.

use comic_experiment::{AlgorithmName, Experiment, TaskName};

/// SVG(0) on this task, with its default sizes. Its action is a latent. The low level itself acts in actors, so nothing here
/// reads it.
pub(crate) fn experiment(task: TaskName) -> Experiment {
    let mut experiment = Experiment { algorithm: AlgorithmName::Svg0, task, ..Experiment::default() };
    experiment.transfer.low_level = "low-level".into();
    experiment
}
