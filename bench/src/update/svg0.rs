//! The layers of SVG(0)'s networks.

use comic_experiment::{Experiment, Svg0, TaskSpec};
use tch::Device;

use super::floor::{Floor, Gradients};

/// Unrolls of a gradient step.
pub(super) fn unrolls(experiment: &Experiment) -> usize {
    experiment.svg0.minibatch_sequences
}

/// Online and target networks without images, and the action values of every sampled action.
pub(super) fn floor(spec: &TaskSpec, experiment: &Experiment, device: Device) -> Floor {
    let mut floor = Floor::new(unrolls(experiment), device);
    let Svg0 { encoder, core, policy, action_value, burn_in, action_samples, .. } = &experiment.svg0;
    let unrolls = unrolls(experiment) as i64;
    let [length, burn_in, samples, action, features] =
        [experiment.unroll.length, *burn_in, *action_samples, spec.action, *core].map(|size| size as i64);
    let (steps, observations) = (unrolls * (length - burn_in), unrolls * (length - burn_in + 1));
    let inputs = [spec.proprioception, spec.task].map(|input| input as i64);
    let encoded: i64 = inputs.iter().map(|input| encoder.last().map_or(*input, |size| *size as i64)).sum();
    // The critic alone trains the core, so the policy's LSTM has no gradient of its input.
    let mut recurrent = |rows: i64, of_encoders: Gradients, of_core: Gradients| {
        for input in inputs {
            floor.layers(rows, input, encoder, 0, of_encoders);
        }
        floor.lstm(rows, encoded, &[*core], of_core);
        floor.lstm(rows, features, &[*policy], of_encoders);
    };
    let (none, weights, both) = (Gradients::NONE, Gradients::WEIGHTS, Gradients::BOTH);
    // Online and target networks, each over the burn-in and then over the rest.
    recurrent(unrolls * burn_in, none, none);
    recurrent(observations, weights, both);
    recurrent(unrolls * burn_in, none, none);
    recurrent(observations, none, none);
    for wanted in [both, none] {
        floor.layers(observations, *policy as i64, &[], 2 * action, wanted);
    }
    // The action value that is learned, the two in its target, and that of the policy's gradient.
    for (rows, wanted) in
        [(steps, both), (steps, none), (samples * observations, none), (samples * steps, Gradients::INPUT)]
    {
        floor.layers(rows, features + action, action_value, 1, wanted);
    }
    floor
}
