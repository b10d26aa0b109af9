//! The layers of V-MPO's networks.

use comic_experiment::{Experiment, TaskSpec};
use comic_networks::{Sizes, low_level_layers};
use tch::Device;

use super::floor::{Floor, Gradients};

/// Unrolls of a gradient step.
pub(super) fn unrolls(experiment: &Experiment) -> usize {
    experiment.vmpo.minibatch_unrolls
}

/// Policy and value networks.
pub(super) fn floor(spec: &TaskSpec, experiment: &Experiment, device: Device) -> Floor {
    let mut floor = Floor::new(unrolls(experiment), device);
    let network = &experiment.network;
    let (unrolls, length) = (unrolls(experiment) as i64, experiment.unroll.length as i64);
    let (steps, observations) = (unrolls * length, unrolls * (length + 1));
    let (latent, sensed) = (network.latent.size as i64, (spec.task + spec.proprioception) as i64);
    let encoded = if latent > 0 { 2 * latent } else { network.primitives.count as i64 };
    floor.layers(steps, sensed + latent, &network.encoder, encoded, Gradients::WEIGHTS);
    if network.encoder_linear_path && latent > 0 {
        floor.layers(steps, sensed + latent, &[], 2 * latent, Gradients::WEIGHTS);
    }
    let sizes = Sizes { proprioception: spec.proprioception, actions: spec.action, network };
    for layer in low_level_layers(&sizes) {
        floor.layer(steps, layer);
    }
    let input = sensed + network.clip_embedding as i64;
    let terms = spec.reward_terms.len() as i64;
    if network.value_lstm.is_empty() {
        floor.layers(observations, input, &network.value, terms, Gradients::BOTH);
    } else {
        floor.layers(observations, input, &network.value, 0, Gradients::BOTH);
        let hidden = network.value.last().map_or(input, |size| *size as i64);
        let units = floor.lstm(observations, hidden, &network.value_lstm, Gradients::BOTH);
        floor.layers(observations, units, &[], terms, Gradients::BOTH);
    }
    floor
}
