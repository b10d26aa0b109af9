//! The sizes that determine the shape of an unroll.

use comic_experiment::{Experiment, TaskSpec};

/// Bytes per element of all fields except the image, whose elements are single bytes.
pub(crate) const ELEMENT: usize = 4;

/// The sizes that determine the shape of an unroll.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct UnrollShape {
    /// T, the number of transitions.
    pub length: usize,
    /// P, the size of proprioception.
    pub proprioception: usize,
    /// X, the size of the task observation.
    pub task: usize,
    /// A, the size of an action.
    pub action: usize,
    /// Z, the size of the latent.
    pub latent: usize,
    /// R, the number of reward terms.
    pub reward_terms: usize,
    /// I, the bytes of a camera image, a multiple of 4; 0 if the humanoid has no camera.
    pub image: usize,
    /// K, the number of components (Gaussians) of the behaviour policy's distribution.
    pub components: usize,
    /// S, the size of the policy's recurrent state; 0 if it is not recurrent.
    pub state: usize,
    /// A if every transition has the derivative of the coming rewards with respect to its action, else 0.
    pub action_gradient: usize,
}

impl UnrollShape {
    /// The shape of the unrolls of this experiment and its task spec.
    pub fn new(spec: &TaskSpec, experiment: &Experiment) -> Self {
        Self {
            length: experiment.unroll.length,
            proprioception: spec.proprioception,
            task: spec.task,
            action: spec.action,
            latent: experiment.latent_size(),
            reward_terms: spec.reward_terms.len(),
            // The image has whole words, so every row is aligned.
            image: spec.image.next_multiple_of(ELEMENT),
            components: experiment.components(),
            state: experiment.state_size(),
            action_gradient: if experiment.reads_action_gradient() { spec.action } else { 0 },
        }
    }
}
