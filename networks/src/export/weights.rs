//! The number of weights of an experiment's networks, without building them.

use comic_experiment::{Experiment, TaskSpec};

use super::part::Part;
use crate::algorithms;
use crate::policy::Weights;
use crate::weights::hidden;

/// Number of entries of the matrices of encoders and low level in `part`. A reader compares it with the content of a
/// file, so that a small file cannot describe networks that need huge memory. `prior` has the hidden sizes of a prior. A
/// transfer's frozen low level is a file of its own inside, which is counted when that file is read.
pub(super) fn count(part: Part, prior: &[usize], spec: &TaskSpec, experiment: &Experiment) -> u64 {
    let Weights { low_level, rest } = algorithms::weights(spec, experiment);
    match part {
        Part::Policy(_) => rest + low_level,
        Part::Encoder(_) => rest,
        Part::LowLevel => low_level + of_prior(prior, spec, experiment.network.latent.size as u64),
    }
}

/// Whether [`count`] counts a tensor of this name and shape.
pub(super) fn is_counted(name: &str, shape: &[usize]) -> bool {
    let matrix = shape.len() > 1 && !name.ends_with("biases");
    let parts = ["encoder.", "low_level.", "high_level.", "prior.", "core.", "latent_policy."];
    matrix && parts.iter().any(|part| name.starts_with(part))
}

/// `prior` is empty if there is none.
fn of_prior(prior: &[usize], spec: &TaskSpec, latent: u64) -> u64 {
    let (weights, width) = hidden(spec.proprioception as u64, prior);
    if prior.is_empty() { 0 } else { weights + width * 2 * latent }
}

#[cfg(test)]
mod tests {
    use comic_experiment::{presets, resolve};
    use tch::{Device, nn};

    use super::*;
    use crate::algorithms::new_policy;
    use crate::export::spec::task_spec;

    #[test]
    fn the_count_is_that_of_the_built_networks_in_every_preset() {
        let bare = ["network.latent.size=0".to_string()];
        for (name, _) in presets::ALL {
            for overrides in [&[][..], &bare[..]] {
                // Not every low level can do without a bottleneck.
                let Ok(experiment) = resolve(name, overrides) else { continue };
                let spec = task_spec(&experiment).unwrap();
                let store = nn::VarStore::new(Device::Cpu);
                new_policy(&store.root(), &spec, &experiment, &vec![0.0; spec.action]).unwrap();
                for part in [Part::Policy(None), Part::LowLevel] {
                    let sizes =
                        |tensor: &tch::Tensor| tensor.size().iter().map(|size| *size as usize).collect::<Vec<_>>();
                    let built: usize = store
                        .variables()
                        .iter()
                        .filter(|(name, tensor)| part.holds(name) && is_counted(name, &sizes(tensor)))
                        .map(|(_, tensor)| tensor.numel())
                        .sum();
                    assert_eq!(count(part, &[], &spec, &experiment), built as u64, "{name}: {part}");
                }
            }
        }
    }
}
