//! The number of weights of an experiment's networks, without building them.

use comic_experiment::{Network, TaskSpec};

use super::part::Part;
use crate::low_level::{Layer, Sizes, low_level_layers};

/// Number of entries of the matrices of encoders and low level in `part`. A reader compares it with the content of a
/// file, so that a small file cannot describe networks that need huge memory.
pub(super) fn count(part: Part, spec: &TaskSpec, network: &Network) -> u64 {
    let encoders = || spec.tasks.iter().map(|task| encoder(spec, task.observation, network)).sum();
    match part {
        Part::Policy(_) => encoders() + low_level(spec, network),
        Part::Encoder(_) => encoders(),
        Part::LowLevel => low_level(spec, network),
    }
}

/// Whether [`count`] counts a tensor of this name and shape.
pub(super) fn is_counted(name: &str, shape: &[usize]) -> bool {
    let matrix = shape.len() > 1 && !name.ends_with("biases");
    matrix && (name.starts_with("encoder.") || name.starts_with("low_level."))
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
                let (spec, network) = (task_spec(&experiment).unwrap(), &experiment.network);
                let store = nn::VarStore::new(Device::Cpu);
                Policy::new(&store.root(), &spec, network, &vec![0.0; spec.action]).unwrap();
                for part in [Part::Policy(None), Part::LowLevel] {
                    let sizes =
                        |tensor: &tch::Tensor| tensor.size().iter().map(|size| *size as usize).collect::<Vec<_>>();
                    let built: usize = store
                        .variables()
                        .iter()
                        .filter(|(name, tensor)| part.holds(name) && is_counted(name, &sizes(tensor)))
                        .map(|(_, tensor)| tensor.numel())
                        .sum();
                    assert_eq!(count(part, &spec, network), built as u64, "{name}: {part}");
                }
            }
        }
    }
}
