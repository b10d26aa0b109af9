//! The number of weights of an experiment's networks, without building them.

use comic_experiment::{Experiment, Network, TaskSpec, TransferAlgorithm};

use super::part::Part;
use crate::low_level::{Layer, Sizes, low_level_layers};

/// Number of entries of the matrices of encoders and low level in `part`. A reader compares it with the content of a
/// file, so that a small file cannot describe networks that need huge memory. `prior` has the hidden sizes of a prior. A
/// transfer's frozen low level is a file of its own inside, which is counted when that file is read.
pub(super) fn count(part: Part, prior: &[usize], spec: &TaskSpec, experiment: &Experiment) -> u64 {
    let network = &experiment.network;
    match experiment.transfer.algorithm {
        TransferAlgorithm::Svg0 => return recurrent(spec, experiment),
        TransferAlgorithm::Vmpo if experiment.transfer.is_on() => return high_level(spec, network),
        TransferAlgorithm::Vmpo => {}
    }
    let encoders = || spec.tasks.iter().map(|task| encoder(spec, task.observation, network)).sum();
    match part {
        Part::Policy(_) => encoders() + low_level(spec, network),
        Part::Encoder(_) => encoders(),
        Part::LowLevel => low_level(spec, network) + of_prior(prior, spec, network),
    }
}

/// Whether [`count`] counts a tensor of this name and shape.
pub(super) fn is_counted(name: &str, shape: &[usize]) -> bool {
    let matrix = shape.len() > 1 && !name.ends_with("biases");
    let parts = ["encoder.", "low_level.", "high_level.", "prior.", "core.", "latent_policy."];
    matrix && parts.iter().any(|part| name.starts_with(part))
}

/// The number of weights of hidden layers, and the width of the last layer.
fn hidden(input: u64, sizes: &[usize]) -> (u64, u64) {
    sizes.iter().fold((0, input), |(weights, width), size| (weights + width * *size as u64, *size as u64))
}

fn encoder(spec: &TaskSpec, observation: usize, network: &Network) -> u64 {
    let latent = network.latent.size as u64;
    let image_features = if spec.image > 0 { network.image_features } else { 0 };
    let input = (spec.proprioception + observation + image_features) as u64 + latent;
    let (weights, width) = hidden(input, &network.encoder);
    let output = if latent == 0 { network.primitives.count as u64 } else { 2 * latent };
    let path = if latent > 0 && network.encoder_linear_path { output * input } else { 0 };
    weights + width * output + path
}

fn high_level(spec: &TaskSpec, network: &Network) -> u64 {
    let image_features = if spec.image > 0 { network.image_features } else { 0 };
    let (weights, width) = hidden((spec.proprioception + spec.task + image_features) as u64, &network.encoder);
    weights + width * 2 * spec.action as u64
}

/// Core and policy of SVG(0).
fn recurrent(spec: &TaskSpec, experiment: &Experiment) -> u64 {
    let (svg0, network) = (&experiment.svg0, &experiment.network);
    let image_features = if spec.image > 0 { network.image_features as u64 } else { 0 };
    let (mut weights, mut width) = (0, image_features);
    for input in [spec.proprioception, spec.task].into_iter().filter(|input| *input > 0) {
        let (own, output) = hidden(input as u64, &svg0.encoder);
        (weights, width) = (weights + own, width + output);
    }
    let lstm = |input: u64, units: usize| 4 * units as u64 * (input + units as u64);
    weights + lstm(width, svg0.core) + lstm(svg0.core as u64, svg0.policy) + svg0.policy as u64 * 2 * spec.action as u64
}

/// `prior` is empty if there is none.
fn of_prior(prior: &[usize], spec: &TaskSpec, network: &Network) -> u64 {
    let (weights, width) = hidden(spec.proprioception as u64, prior);
    if prior.is_empty() { 0 } else { weights + width * 2 * network.latent.size as u64 }
}

fn low_level(spec: &TaskSpec, network: &Network) -> u64 {
    let sizes = Sizes { proprioception: spec.proprioception, actions: spec.action, network };
    low_level_layers(&sizes).into_iter().map(Layer::weights).sum()
}

#[cfg(test)]
mod tests {
    use comic_experiment::{presets, resolve};
    use tch::{Device, nn};

    use super::*;
    use crate::export::spec::task_spec;
    use crate::policy::Policy;

    #[test]
    fn the_count_is_that_of_the_built_networks_in_every_preset() {
        let bare = ["network.latent.size=0".to_string()];
        for (name, _) in presets::ALL {
            for overrides in [&[][..], &bare[..]] {
                // Not every low level can do without a bottleneck.
                let Ok(experiment) = resolve(name, overrides) else { continue };
                let spec = task_spec(&experiment).unwrap();
                let store = nn::VarStore::new(Device::Cpu);
                Policy::of(&store.root(), &spec, &experiment, &vec![0.0; spec.action]).unwrap();
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
