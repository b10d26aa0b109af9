//! What one batched forward pass reads and writes.

use std::ops::{Index, IndexMut};

use comic_proto::{Field, PerField, UnrollShape};
use rand::Rng;
use rand_distr::{Distribution as _, StandardNormal};

use crate::Error;

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
    /// `[I]`.
    pub image: &'a mut [u8],
    /// The task's index among the tasks of the experiment.
    pub task: &'a mut usize,
}

impl ActingBatch {
    /// Zeros for `environments` environments whose unrolls have this shape.
    pub fn new(environments: usize, shape: &UnrollShape) -> Self {
        let widths = PerField::from_fn(|field| if FIELDS.contains(&field) { field.width(shape) } else { 0 });
        Self {
            environments,
            widths,
            fields: widths.map(|_, width| vec![0.0; environments * width]),
            latent: vec![0.0; environments * shape.latent],
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
        let (latent, image) = (self.latent.len() / environments, self.image.len() / environments);
        ActingRow {
            fields: self.fields.each_mut().map(|field, array| part(array, environment, widths[field])),
            latent: part(&mut self.latent, environment, latent),
            image: part(&mut self.image, environment, image),
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
        self.image.copy_from_slice(other.image);
        *self.task = *other.task;
    }

    /// Draws the latent's noise of the coming step.
    pub fn draw_latent_noise(&mut self, rng: &mut impl Rng) {
        fill_normal(&mut self[Field::LatentNoise], rng);
    }

    /// Sets the recurrent state and the previous latent to zero, as at an episode's beginning.
    pub fn reset_recurrent_state(&mut self) {
        self[Field::PreviousLatent].fill(0.0);
        self[Field::State].fill(0.0);
    }

    /// Draws an action from the distribution. It is not clipped: only the action as drawn has the distribution's density.
    /// A mixture draws its component first.
    pub fn sample(&self, action: &mut [f32], rng: &mut impl Rng) {
        let log_weights = &self[Field::LogWeights];
        let component = if log_weights.is_empty() { 0 } else { draw_component(log_weights, rng.random()) };
        let place = component * action.len()..(component + 1) * action.len();
        fill_normal(action, rng);
        let (mean, std) = (&self[Field::Mean][place.clone()], &self[Field::Std][place]);
        for ((action, mean), std) in action.iter_mut().zip(mean).zip(std) {
            *action = mean + std * *action;
        }
    }

    /// The action without noise, `[A]`: the mean of the most likely component.
    pub fn mode(&self) -> &[f32] {
        let (mean, log_weights) = (&self[Field::Mean], &self[Field::LogWeights]);
        let actions = mean.len() / log_weights.len().max(1);
        let component = most_likely(log_weights);
        &mean[component * actions..(component + 1) * actions]
    }

    /// The action without noise plus Gaussian noise with this standard deviation. Nothing is drawn for a deviation of 0.
    pub fn mode_with_noise(&self, std: f32, action: &mut [f32], rng: &mut impl Rng) {
        action.copy_from_slice(self.mode());
        if std > 0.0 {
            for value in action {
                let noise: f32 = StandardNormal.sample(rng);
                *value += std * noise;
            }
        }
    }

    /// Makes the action distribution N(mean, std²): every component has these values, and all weights are equal. `mean`
    /// fills `[A]`.
    pub fn set_gaussian(&mut self, mean: impl Fn(&mut [f32]), std: f32) {
        let components = self[Field::LogWeights].len().max(1);
        let means = &mut self[Field::Mean];
        for component in means.chunks_exact_mut((means.len() / components).max(1)) {
            mean(component);
        }
        self[Field::Std].fill(std);
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

/// The action for the simulator: each dimension within [−1, 1], and 0 instead of NaN.
pub fn clip_action(action: &[f32], clipped: &mut [f32]) {
    for (clipped, action) in clipped.iter_mut().zip(action) {
        *clipped = if action.is_nan() { 0.0 } else { action.clamp(-1.0, 1.0) };
    }
}

/// Makes latents and action distributions of observations, for all environments of a thread at once.
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
}

impl<F: ForwardPass + ?Sized> ForwardPass for Box<F> {
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error> {
        (**self).load(parameters)
    }

    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        (**self).forward(batch)
    }
}

/// A forward pass for each environment alone. The order of a library's sums depends on the size of the batch. With a batch
/// of one, an environment's numbers do not depend on the number of environments.
#[derive(Debug)]
pub struct OneByOne<F> {
    forward: F,
    single: ActingBatch,
}

impl<F: ForwardPass> OneByOne<F> {
    /// Uses this forward pass for environments whose unrolls have this shape.
    pub fn new(forward: F, shape: &UnrollShape) -> Self {
        Self { forward, single: ActingBatch::new(1, shape) }
    }
}

impl<F: ForwardPass> ForwardPass for OneByOne<F> {
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error> {
        self.forward.load(parameters)
    }

    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        for environment in 0..batch.environments() {
            self.single.row(0).copy_from(&batch.row(environment));
            self.forward.forward(&mut self.single)?;
            batch.row(environment).copy_from(&self.single.row(0));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_pcg::Pcg64;

    use super::*;

    /// Adds the batch's size to the recurrent state.
    struct AddsBatchSize;

    impl ForwardPass for AddsBatchSize {
        fn load(&mut self, _: &[u8]) -> Result<(), Error> {
            Ok(())
        }

        fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
            let environments = batch.environments() as f32;
            batch[Field::State].iter_mut().for_each(|value| *value += environments);
            Ok(())
        }
    }

    #[test]
    fn one_by_one_every_environment_is_a_batch_of_its_own() {
        let mut batch = ActingBatch::new(3, &SHAPE);
        let state: Vec<f32> = (0..12).map(|value| value as f32).collect();
        batch[Field::State].copy_from_slice(&state);
        OneByOne::new(AddsBatchSize, &SHAPE).forward(&mut batch).unwrap();
        assert_eq!(batch[Field::State], (1..13).map(|value| value as f32).collect::<Vec<_>>());
    }

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
        let mut batch = ActingBatch::new(1, &SHAPE);
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
        let mut action = [0.0; 2];
        for _ in 0..10_000 {
            batch.row(0).sample(&mut action, &mut rng);
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
        let mut one = ActingBatch::new(1, &UnrollShape { components: 1, ..SHAPE });
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
    fn a_gaussian_fills_every_component_and_a_reset_empties_the_recurrent_state() {
        let mut batch = mixture([0.2, 0.3, 0.5]);
        batch[Field::State].fill(1.0);
        let mut row = batch.row(0);
        row.set_gaussian(|mean| mean.copy_from_slice(&[0.1, 0.2]), 0.3);
        row.reset_recurrent_state();
        assert_eq!(batch[Field::Mean], [0.1, 0.2, 0.1, 0.2, 0.1, 0.2]);
        assert_eq!((&batch[Field::Std], &batch[Field::State]), (&[0.3; 6][..], &[0.0; 4][..]));
        assert!(batch[Field::LogWeights].iter().all(|weight| (weight.exp() - 1.0 / 3.0).abs() < 1e-6));
    }
}
