//! The number of weights of an experiment's networks, without building them.

use comic_experiment::{Experiment, TaskSpec};

use super::part::Part;
use crate::algorithms;
use crate::policy::Weights;
use crate::weights;

/// Number of entries of the matrices in `part`, without the normaliser's. A reader compares it with the content of a
/// file, so that a small file cannot describe networks that need huge memory. `prior` has the hidden sizes of a prior. A
/// transfer's frozen low level is a file of its own inside, which is counted when that file is read.
pub(super) fn count(part: Part, prior: Option<&[usize]>, spec: &TaskSpec, experiment: &Experiment) -> u64 {
    let Weights { low_level, prior: own_prior, rest } = algorithms::weights(spec, experiment);
    match part {
        Part::Policy(_) => rest + own_prior + low_level,
        Part::Encoder(_) => rest + own_prior,
        Part::LowLevel => low_level + prior.map_or(0, |sizes| weights::prior(spec, &experiment.network, sizes)),
    }
}

/// Whether [`count`] counts a tensor of this name and shape.
pub(super) fn is_counted(name: &str, shape: &[usize]) -> bool {
    shape.len() > 1 && !name.ends_with("biases") && !name.starts_with("normaliser.")
}

#[cfg(test)]
mod tests {
    use comic_experiment::{Prior, presets, resolve};
    use tch::{Device, nn};

    use super::*;
    use crate::algorithms::new_policy;
    use crate::export::spec::task_spec;

    #[test]
    fn the_count_is_that_of_the_built_networks_in_every_preset() {
        let bare = ["network.latent.size=0".to_string()];
        let state_prior = ["network.latent.prior={state={hidden=[8,4]}}".to_string()];
        for (name, _) in presets::ALL {
            for overrides in [&[][..], &bare[..], &state_prior[..]] {
                // Not every low level can do without a bottleneck.
                let Ok(experiment) = resolve(name, overrides) else { continue };
                let spec = task_spec(&experiment).unwrap();
                let store = nn::VarStore::new(Device::Cpu);
                new_policy(&store.root(), &spec, &experiment, &vec![0.0; spec.action]).unwrap();
                // In joint training a file of one task's encoder describes that task alone.
                let encoder = match &experiment.tasks()[..] {
                    [(task, _)] if experiment.learns_low_level() => Some(Part::Encoder(*task)),
                    _ => None,
                };
                for part in [Part::Policy(None), Part::LowLevel].into_iter().chain(encoder) {
                    let sizes =
                        |tensor: &tch::Tensor| tensor.size().iter().map(|size| *size as usize).collect::<Vec<_>>();
                    let built: usize = store
                        .variables()
                        .iter()
                        .filter(|(name, tensor)| part.holds(name) && is_counted(name, &sizes(tensor)))
                        .map(|(_, tensor)| tensor.numel())
                        .sum();
                    let prior = match &experiment.network.latent.prior {
                        Prior::State { hidden } if experiment.learns_low_level() => Some(&hidden[..]),
                        _ => None,
                    };
                    assert_eq!(count(part, prior, &spec, &experiment), built as u64, "{name}: {part}");
                }
            }
        }
    }
}
