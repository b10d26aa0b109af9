//! What one batched forward pass reads and writes.

mod one_by_one;

use std::ops::{Index, IndexMut, Range};

use comic_proto::{Field, PerField, UnrollShape};
use rand::Rng;
use rand_distr::{Distribution as _, StandardNormal};

use crate::Error;

pub use one_by_one::OneByOne;

/// The fields of an unroll that a forward pass reads or writes.
const FIELDS: [Field; 8] = [
    Field::Proprioception,
    Field::Task,
    Field::PreviousLatent,
    Field::LatentNoise,
    Field::State,
    Field::Mean,
    Field::Std,
    Field::LogWeights,
];

/// Widths of what a frozen low level makes, and of its memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LowLevelShape {
    /// Entries of a command.
    pub command: usize,
    /// S, the size of its recurrent state.
    pub state: usize,
}

/// The observations of E environments and the action distributions of the behaviour policy. Arrays are row-major.
///
/// Indexed by a [`Field`] it gives `[E, width]` f32. Fields that acting does not use are empty. The others are:
///
/// - `Proprioception` and `Task`: the observation;
/// - `PreviousLatent`: z_{t−1}, zero at an episode's first step;
/// - `LatentNoise`: the standard normal noise that makes z_t;
/// - `State`: the recurrent state, zero at an episode's first step; the forward pass reads and writes it;
/// - `Mean`, `Std`, `LogWeights`: the action distribution, written by the forward pass.
#[derive(Clone, Debug)]
pub struct ActingBatch {
    environments: usize,
    widths: PerField<usize>,
    fields: PerField<Vec<f32>>,
    /// z_t `[E, Z]`: written by the forward pass.
    pub latent: Vec<f32>,
    /// The policy's action, `[E, A]`, not clipped: chosen from the distribution.
    pub action: Vec<f32>,
    /// What the simulator receives, before it is clipped, `[E, 56]`: the action, or in transfer what the frozen low level
    /// makes of it.
    pub command: Vec<f32>,
    /// The recurrent state of a frozen low level, `[E, S]`, zero at an episode's first step.
    pub low_level_state: Vec<f32>,
    /// Camera images, `[E, I]`.
    pub image: Vec<u8>,
    /// The task of each environment's episode, `[E]`: its index among the tasks of the experiment.
    pub tasks: Vec<usize>,
}

/// One environment's row of an [`ActingBatch`], indexed in the same way.
#[derive(Debug)]
pub struct ActingRow<'a> {
    pub(crate) fields: PerField<&'a mut [f32]>,
    /// `[Z]`.
    pub latent: &'a mut [f32],
    /// `[A]`.
    pub action: &'a mut [f32],
    /// `[56]`.
    pub command: &'a mut [f32],
    /// `[S]` of a frozen low level.
    pub low_level_state: &'a mut [f32],
    /// `[I]`.
    pub image: &'a mut [u8],
    /// The task's index among the tasks of the experiment.
    pub task: &'a mut usize,
}

impl ActingBatch {
    /// Zeros for `environments` environments whose unrolls have this shape, and the frozen low level that acts, if any.
    pub fn new(environments: usize, shape: &UnrollShape, low_level: Option<LowLevelShape>) -> Self {
        let LowLevelShape { command, state } = low_level.unwrap_or(LowLevelShape { command: shape.action, state: 0 });
        let widths = PerField::from_fn(|field| if FIELDS.contains(&field) { field.width(shape) } else { 0 });
        Self {
            environments,
            widths,
            fields: widths.map(|_, width| vec![0.0; environments * width]),
            latent: vec![0.0; environments * shape.latent],
            action: vec![0.0; environments * shape.action],
            command: vec![0.0; environments * command],
            low_level_state: vec![0.0; environments * state],
            image: vec![0; environments * shape.image],
            tasks: vec![0; environments],
        }
    }

    /// E.
    pub fn environments(&self) -> usize {
        self.environments
    }

    /// The row of one environment, counted from 0.
    pub fn row(&mut self, environment: usize) -> ActingRow<'_> {
        fn part<T>(array: &mut [T], environment: usize, width: usize) -> &mut [T] {
            &mut array[environment * width..(environment + 1) * width]
        }
        let (widths, environments) = (&self.widths, self.environments.max(1));
        fn own<T>(array: &mut [T], environment: usize, environments: usize) -> &mut [T] {
            let width = array.len() / environments;
            part(array, environment, width)
        }
        ActingRow {
            fields: self.fields.each_mut().map(|field, array| part(array, environment, widths[field])),
            latent: own(&mut self.latent, environment, environments),
            action: own(&mut self.action, environment, environments),
            command: own(&mut self.command, environment, environments),
            low_level_state: own(&mut self.low_level_state, environment, environments),
            image: own(&mut self.image, environment, environments),
            task: &mut self.tasks[environment],
        }
    }
}

impl Index<Field> for ActingBatch {
    type Output = [f32];

    fn index(&self, field: Field) -> &[f32] {
        &self.fields[field]
    }
}

impl IndexMut<Field> for ActingBatch {
    fn index_mut(&mut self, field: Field) -> &mut [f32] {
        &mut self.fields[field]
    }
}

impl Index<Field> for ActingRow<'_> {
    type Output = [f32];

    fn index(&self, field: Field) -> &[f32] {
        self.fields[field]
    }
}

impl IndexMut<Field> for ActingRow<'_> {
    fn index_mut(&mut self, field: Field) -> &mut [f32] {
        self.fields[field]
    }
}

impl ActingRow<'_> {
    /// Copies everything from another row of the same shape.
    pub fn copy_from(&mut self, other: &ActingRow<'_>) {
        for (field, values) in self.fields.iter_mut() {
            values.copy_from_slice(&other[field]);
        }
        self.latent.copy_from_slice(other.latent);
        self.action.copy_from_slice(other.action);
        self.command.copy_from_slice(other.command);
        self.low_level_state.copy_from_slice(other.low_level_state);
        self.image.copy_from_slice(other.image);
        *self.task = *other.task;
    }

    /// Draws the latent's noise of the coming step.
    pub fn draw_latent_noise(&mut self, rng: &mut impl Rng) {
        fill_normal(&mut self[Field::LatentNoise], rng);
    }

    /// Sets the recurrent states and the previous latent to zero, as at an episode's beginning.
    pub fn reset_recurrent_state(&mut self) {
        self.low_level_state.fill(0.0);
        self[Field::PreviousLatent].fill(0.0);
        self[Field::State].fill(0.0);
    }

    /// Chooses an action from the distribution. It is not clipped: only the action as drawn has the distribution's density.
    /// A mixture draws its component first.
    pub fn sample(&mut self, rng: &mut impl Rng) {
        let Self { fields, action, .. } = self;
        let log_weights = &fields[Field::LogWeights];
        let component = if log_weights.is_empty() { 0 } else { draw_component(log_weights, rng.random()) };
        let place = component * action.len()..(component + 1) * action.len();
        fill_normal(action, rng);
        let (mean, std) = (&fields[Field::Mean][place.clone()], &fields[Field::Std][place]);
        for ((action, mean), std) in action.iter_mut().zip(mean).zip(std) {
            *action = mean + std * *action;
        }
    }

    /// Chooses the action without noise, the [mode](Self::mode).
    pub fn take_mode(&mut self) {
        let place = self.mode_place();
        self.action.copy_from_slice(&self.fields[Field::Mean][place]);
    }

    /// The action without noise, `[A]`: the mean of the most likely component.
    pub fn mode(&self) -> &[f32] {
        &self[Field::Mean][self.mode_place()]
    }

    fn mode_place(&self) -> Range<usize> {
        let (mean, log_weights) = (&self[Field::Mean], &self[Field::LogWeights]);
        let actions = mean.len() / log_weights.len().max(1);
        let component = most_likely(log_weights);
        component * actions..(component + 1) * actions
    }

    /// Adds Gaussian noise with this standard deviation to the command. Nothing is drawn for a deviation of 0.
    pub fn disturb_command(&mut self, std: f32, rng: &mut impl Rng) {
        if std > 0.0 {
            for value in self.command.iter_mut() {
                let noise: f32 = StandardNormal.sample(rng);
                *value += std * noise;
            }
        }
    }

    /// Makes the action distribution one action without noise: every component has this mean and no deviation, and all
    /// weights are equal. `mean` fills `[A]`.
    pub fn set_action(&mut self, mean: impl Fn(&mut [f32])) {
        let components = self[Field::LogWeights].len().max(1);
        let means = &mut self[Field::Mean];
        for component in means.chunks_exact_mut((means.len() / components).max(1)) {
            mean(component);
        }
        self[Field::Std].fill(0.0);
        self[Field::LogWeights].fill(-(components as f32).ln());
    }
}

/// The component with the largest weight. A single component has no weight and is the first.
fn most_likely(log_weights: &[f32]) -> usize {
    let likelier = |best: usize, other: usize| if log_weights[other] > log_weights[best] { other } else { best };
    (1..log_weights.len()).fold(0, likelier)
}

/// The component at `uniform` in [0, 1) of the weights' sum.
fn draw_component(log_weights: &[f32], uniform: f32) -> usize {
    let mut left = uniform;
    for (component, log_weight) in log_weights.iter().enumerate() {
        left -= log_weight.exp();
        if left < 0.0 {
            return component;
        }
    }
    // Rounding can make the sum a little less than 1.
    most_likely(log_weights)
}

/// Fills `values` with independent draws of N(0, 1).
fn fill_normal(values: &mut [f32], rng: &mut impl Rng) {
    for value in values {
        *value = StandardNormal.sample(rng);
    }
}

/// Makes a command one that the simulator takes: each entry within [−1, 1], and 0 instead of NaN.
pub fn clip_command(command: &mut [f32]) {
    for value in command {
        *value = if value.is_nan() { 0.0 } else { value.clamp(-1.0, 1.0) };
    }
}

/// Makes latents and action distributions of observations, and commands of chosen actions, for all environments of a thread
/// at once.
///
/// The acting loop is generic over it, so that the rows of unrolls are tested without libtorch.
pub trait ForwardPass {
    /// Loads new parameters (safetensors).
    ///
    /// # Errors
    /// When they do not fit; the parameters before stay in use.
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error>;

    /// Reads observations, previous latents, latent noise and recurrent state. Writes the latent, the action distribution
    /// and the next recurrent state.
    ///
    /// # Errors
    /// When libtorch fails.
    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error>;

    /// The frozen low level that acts for the policy; `None` if the policy's actions are commands.
    fn low_level(&self) -> Option<LowLevelShape> {
        None
    }

    /// Turns the chosen actions into commands for the simulator.
    ///
    /// # Errors
    /// When libtorch fails.
    fn actuate(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        batch.command.copy_from_slice(&batch.action);
        Ok(())
    }

    /// Turns derivatives with respect to commands into derivatives with respect to the actions they were made of, `[N, A]`.
    ///
    /// # Errors
    /// When libtorch fails.
    fn action_derivatives(&mut self, actuated: Actuated) -> Result<Vec<f32>, Error> {
        Ok(actuated.derivatives)
    }
}

/// N steps of one environment: what made the commands, and the derivatives of the coming rewards with respect to them.
#[derive(Clone, Debug, Default)]
pub struct Actuated {
    /// N.
    pub steps: usize,
    /// The policy's actions, `[N, A]`.
    pub action: Vec<f32>,
    /// `[N, P]`.
    pub proprioception: Vec<f32>,
    /// The recurrent state that a frozen low level read, `[N, S]`.
    pub low_level_state: Vec<f32>,
    /// With respect to the commands, `[N, 56]`.
    pub derivatives: Vec<f32>,
}

impl<F: ForwardPass + ?Sized> ForwardPass for Box<F> {
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error> {
        (**self).load(parameters)
    }

    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        (**self).forward(batch)
    }

    fn low_level(&self) -> Option<LowLevelShape> {
        (**self).low_level()
    }

    fn actuate(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        (**self).actuate(batch)
    }

    fn action_derivatives(&mut self, actuated: Actuated) -> Result<Vec<f32>, Error> {
        (**self).action_derivatives(actuated)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_pcg::Pcg64;

    use super::*;

    const SHAPE: UnrollShape = UnrollShape {
        length: 1,
        proprioception: 0,
        task: 0,
        latent: 0,
        action: 2,
        reward_terms: 1,
        image: 0,
        components: 3,
        state: 4,
        action_gradient: 0,
    };

    /// Components whose samples cannot be confused, with these weights.
    fn mixture(weights: [f32; 3]) -> ActingBatch {
        let mut batch = ActingBatch::new(1, &SHAPE, None);
        batch[Field::Mean].copy_from_slice(&[-10.0, -20.0, 0.5, 0.25, 10.0, 20.0]);
        batch[Field::Std].fill(0.1);
        batch[Field::LogWeights].copy_from_slice(&weights.map(f32::ln));
        batch
    }

    #[test]
    fn a_mixture_draws_its_components_by_their_weights_and_acts_by_one_of_them() {
        let mut batch = mixture([0.2, 0.5, 0.3]);
        let mut rng = Pcg64::seed_from_u64(1);
        let mut counts = [0_u32; 3];
        for _ in 0..10_000 {
            batch.row(0).sample(&mut rng);
            let action = &batch.action;
            let component = if action[0] < -5.0 { 0 } else { 1 + usize::from(action[0] > 5.0) };
            let mean = &batch[Field::Mean][2 * component..2 * component + 2];
            assert!(action.iter().zip(mean).all(|(action, mean)| (action - mean).abs() < 1.0), "{action:?}");
            counts[component] += 1;
        }
        // Five standard deviations of a count are 250.
        for (count, expected) in counts.into_iter().zip([2_000, 5_000, 3_000]) {
            assert!(count.abs_diff(expected) < 250, "{counts:?}");
        }
    }

    #[test]
    fn without_noise_the_most_likely_component_acts() {
        assert_eq!(mixture([0.2, 0.3, 0.5]).row(0).mode(), [10.0, 20.0]);
        assert_eq!(mixture([0.2, 0.5, 0.3]).row(0).mode(), [0.5, 0.25]);
        let mut one = ActingBatch::new(1, &UnrollShape { components: 1, ..SHAPE }, None);
        one[Field::Mean].copy_from_slice(&[0.5, -0.5]);
        assert_eq!(one.row(0).mode(), [0.5, -0.5]);
    }

    #[test]
    fn weights_whose_rounded_sum_is_below_one_still_draw_a_component() {
        assert_eq!(draw_component(&[0.1_f32.ln(), 0.2_f32.ln()], 0.999), 1);
        assert_eq!(
            draw_component(&[(1.0_f32 - 1e-6).ln(), -80.0], 1.0 - 1e-7),
            0,
            "not the one that all but never acts"
        );
        assert_eq!(draw_component(&[0.0, f32::NEG_INFINITY], 0.0), 0);
    }

    #[test]
    fn an_action_fills_every_component_and_a_reset_empties_the_recurrent_state() {
        let mut batch = mixture([0.2, 0.3, 0.5]);
        batch[Field::State].fill(1.0);
        let mut row = batch.row(0);
        row.set_action(|mean| mean.copy_from_slice(&[0.1, 0.2]));
        row.reset_recurrent_state();
        assert_eq!(batch[Field::Mean], [0.1, 0.2, 0.1, 0.2, 0.1, 0.2]);
        assert_eq!((&batch[Field::Std], &batch[Field::State]), (&[0.0; 6][..], &[0.0; 4][..]));
        assert!(batch[Field::LogWeights].iter().all(|weight| (weight.exp() - 1.0 / 3.0).abs() < 1e-6));
    }
}
