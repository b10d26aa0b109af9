//! What one batched forward pass reads and writes, and who can make one.

use comic_experiment::{Experiment, TaskSpec};
use comic_proto::UnrollShape;
use rand::Rng;
use rand_distr::{Distribution as _, StandardNormal};

use crate::Error;

/// Widths of the arrays of an [`ActingBatch`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActingSizes {
    /// P.
    pub proprioception: usize,
    /// X.
    pub task: usize,
    /// Z.
    pub latent: usize,
    /// A.
    pub action: usize,
    /// I, bytes; 0 when the task is blind.
    pub image: usize,
    /// K, Gaussians that the action is drawn from.
    pub components: usize,
    /// S, numbers that the policy remembers.
    pub state: usize,
}

impl ActingSizes {
    /// The widths of an experiment's acting arrays.
    pub fn new(spec: &TaskSpec, experiment: &Experiment) -> Self {
        Self::from(&UnrollShape::new(spec, experiment))
    }

    /// The weights' width: one component needs none.
    fn weights(&self) -> usize {
        if self.components > 1 { self.components } else { 0 }
    }
}

impl From<&UnrollShape> for ActingSizes {
    fn from(shape: &UnrollShape) -> Self {
        let UnrollShape { length: _, proprioception, task, action, latent, reward_terms: _, image, components, state } =
            *shape;
        Self { proprioception, task, latent, action, image, components, state }
    }
}

/// The observations of E environments, and what the behaviour policy makes of them: row-major f32 arrays.
#[derive(Clone, Debug)]
pub struct ActingBatch {
    environments: usize,
    sizes: ActingSizes,
    /// `[E, P]`.
    pub proprioception: Vec<f32>,
    /// `[E, X]`.
    pub task: Vec<f32>,
    /// What the humanoids see, `[E, I]`.
    pub image: Vec<u8>,
    /// z_{t−1} `[E, Z]`; zero at an episode's first step.
    pub previous_latent: Vec<f32>,
    /// The standard normal noise that makes z_t `[E, Z]`.
    pub latent_noise: Vec<f32>,
    /// z_t `[E, Z]`: written by the forward pass.
    pub latent: Vec<f32>,
    /// Mean of each component `[E, K·A]`: written by the forward pass.
    pub mean: Vec<f32>,
    /// Standard deviation of each component `[E, K·A]`: written by the forward pass.
    pub std: Vec<f32>,
    /// ln of the components' weights `[E, K]`, empty where K is 1: written by the forward pass.
    pub log_weights: Vec<f32>,
    /// What the policy remembers `[E, S]`; zero at an episode's first step: read and written by the forward pass.
    pub state: Vec<f32>,
    /// Whose episode it is, `[E]`: the task's place among the tasks.
    pub tasks: Vec<usize>,
}

/// One environment's row of an [`ActingBatch`].
#[derive(Debug)]
pub struct ActingRow<'a> {
    /// `[P]`.
    pub proprioception: &'a mut [f32],
    /// `[X]`.
    pub task: &'a mut [f32],
    /// `[I]`.
    pub image: &'a mut [u8],
    /// `[Z]`.
    pub previous_latent: &'a mut [f32],
    /// `[Z]`.
    pub latent_noise: &'a mut [f32],
    /// `[Z]`.
    pub latent: &'a mut [f32],
    /// `[K·A]`.
    pub mean: &'a mut [f32],
    /// `[K·A]`.
    pub std: &'a mut [f32],
    /// `[K]`, or empty.
    pub log_weights: &'a mut [f32],
    /// `[S]`.
    pub state: &'a mut [f32],
    /// The task's place among the tasks.
    pub of_task: &'a mut usize,
}

impl ActingRow<'_> {
    /// Takes everything from another row of the same sizes.
    pub fn copy_from(&mut self, other: &ActingRow<'_>) {
        self.proprioception.copy_from_slice(other.proprioception);
        self.task.copy_from_slice(other.task);
        self.image.copy_from_slice(other.image);
        self.previous_latent.copy_from_slice(other.previous_latent);
        self.latent_noise.copy_from_slice(other.latent_noise);
        self.latent.copy_from_slice(other.latent);
        self.mean.copy_from_slice(other.mean);
        self.std.copy_from_slice(other.std);
        self.log_weights.copy_from_slice(other.log_weights);
        self.state.copy_from_slice(other.state);
        *self.of_task = *other.of_task;
    }

    /// Draws the latent's noise of the coming step.
    pub fn draw_latent_noise(&mut self, rng: &mut impl Rng) {
        fill_normal(self.latent_noise, rng);
    }

    /// A mind without memory: an episode's beginning.
    pub fn forget(&mut self) {
        self.previous_latent.fill(0.0);
        self.state.fill(0.0);
    }

    /// Draws an action, unclipped: clipped actions must never be scored. Of a mixture first the component is drawn.
    pub fn sample(&self, action: &mut [f32], rng: &mut impl Rng) {
        let component = if self.log_weights.is_empty() { 0 } else { draw(self.log_weights, rng.random()) };
        let place = component * action.len()..(component + 1) * action.len();
        fill_normal(action, rng);
        for ((action, mean), std) in action.iter_mut().zip(&self.mean[place.clone()]).zip(&self.std[place]) {
            *action = mean + std * *action;
        }
    }

    /// The action without noise, `[A]`: the mean of the likeliest component.
    pub fn mode(&self) -> &[f32] {
        let components = self.log_weights.len().max(1);
        let actions = self.mean.len() / components;
        let component = likeliest(self.log_weights);
        &self.mean[component * actions..(component + 1) * actions]
    }

    /// Decides for one action, whatever the policy's form: every component is N(mean, std²), and they weigh the same.
    /// `mean` is `[A]`.
    pub fn decide(&mut self, mean: impl Fn(&mut [f32]), std: f32) {
        let components = self.log_weights.len().max(1);
        for component in self.mean.chunks_exact_mut((self.mean.len() / components).max(1)) {
            mean(component);
        }
        self.std.fill(std);
        self.log_weights.fill(-(components as f32).ln());
    }
}

/// The component of the largest weight; the first where there is one component, which has none.
fn likeliest(log_weights: &[f32]) -> usize {
    let likelier = |best: usize, other: usize| if log_weights[other] > log_weights[best] { other } else { best };
    (1..log_weights.len()).fold(0, likelier)
}

/// The component at `uniform` in [0, 1) of the weights' sum.
fn draw(log_weights: &[f32], uniform: f32) -> usize {
    let mut left = uniform;
    for (component, log_weight) in log_weights.iter().enumerate() {
        left -= log_weight.exp();
        if left < 0.0 {
            return component;
        }
    }
    // Rounding may leave a little over: then it is the likeliest.
    likeliest(log_weights)
}

impl ActingBatch {
    /// Zeros for `environments` environments.
    pub fn new(environments: usize, sizes: ActingSizes) -> Self {
        let zeros = |width| vec![0.0; environments * width];
        Self {
            environments,
            sizes,
            proprioception: zeros(sizes.proprioception),
            task: zeros(sizes.task),
            image: vec![0; environments * sizes.image],
            previous_latent: zeros(sizes.latent),
            latent_noise: zeros(sizes.latent),
            latent: zeros(sizes.latent),
            mean: zeros(sizes.components * sizes.action),
            std: zeros(sizes.components * sizes.action),
            log_weights: zeros(sizes.weights()),
            state: zeros(sizes.state),
            tasks: vec![0; environments],
        }
    }

    /// E.
    pub fn environments(&self) -> usize {
        self.environments
    }

    /// The widths.
    pub fn sizes(&self) -> ActingSizes {
        self.sizes
    }

    /// The row of one environment, counted from 0.
    pub fn row(&mut self, environment: usize) -> ActingRow<'_> {
        fn part<T>(array: &mut [T], environment: usize, width: usize) -> &mut [T] {
            &mut array[environment * width..(environment + 1) * width]
        }
        let ActingSizes { proprioception, task, latent, action, image, components, state } = self.sizes;
        let weights = self.sizes.weights();
        ActingRow {
            proprioception: part(&mut self.proprioception, environment, proprioception),
            task: part(&mut self.task, environment, task),
            image: part(&mut self.image, environment, image),
            previous_latent: part(&mut self.previous_latent, environment, latent),
            latent_noise: part(&mut self.latent_noise, environment, latent),
            latent: part(&mut self.latent, environment, latent),
            mean: part(&mut self.mean, environment, components * action),
            std: part(&mut self.std, environment, components * action),
            log_weights: part(&mut self.log_weights, environment, weights),
            state: part(&mut self.state, environment, state),
            of_task: &mut self.tasks[environment],
        }
    }

    /// Draws the latents' noise of the coming step, all from one source.
    pub fn draw_latent_noise(&mut self, rng: &mut impl Rng) {
        fill_normal(&mut self.latent_noise, rng);
    }
}

/// Fills `values` with independent draws of N(0, 1).
fn fill_normal(values: &mut [f32], rng: &mut impl Rng) {
    for value in values {
        *value = StandardNormal.sample(rng);
    }
}

/// What the simulator sees of an action: each dimension within [−1, 1], and 0 where it is not a number.
pub fn clip_action(action: &[f32], clipped: &mut [f32]) {
    for (clipped, action) in clipped.iter_mut().zip(action) {
        *clipped = if action.is_nan() { 0.0 } else { action.clamp(-1.0, 1.0) };
    }
}

/// Whoever turns observations into latents and action distributions, for all environments of a thread at once.
///
/// The hot loop is generic over it, so that the law of its rows is tested without libtorch.
pub trait ForwardPass {
    /// Takes new parameters (safetensors).
    ///
    /// # Errors
    /// When they do not fit; the ones before stay in force.
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error>;

    /// Reads observations, previous latents, latent noise and state; writes `latent`, `mean`, `std`, `log_weights` and
    /// the state after.
    ///
    /// # Errors
    /// When the library beneath fails.
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

/// A forward pass for each environment alone. The order in which a library adds up depends on the size of the batch, so
/// this is how an environment's numbers do not depend on how many others there are.
#[derive(Debug)]
pub struct OneByOne<F> {
    forward: F,
    alone: ActingBatch,
}

impl<F: ForwardPass> OneByOne<F> {
    /// By this forward pass, over arrays of these widths.
    pub fn new(forward: F, sizes: ActingSizes) -> Self {
        Self { forward, alone: ActingBatch::new(1, sizes) }
    }
}

impl<F: ForwardPass> ForwardPass for OneByOne<F> {
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error> {
        self.forward.load(parameters)
    }

    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        for environment in 0..batch.environments() {
            self.alone.row(0).copy_from(&batch.row(environment));
            self.forward.forward(&mut self.alone)?;
            batch.row(environment).copy_from(&self.alone.row(0));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_pcg::Pcg64;

    use super::*;

    /// Adds the batch's size to what it reads, so that whoever depends on it shows.
    struct Sizes;

    impl ForwardPass for Sizes {
        fn load(&mut self, _: &[u8]) -> Result<(), Error> {
            Ok(())
        }

        fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
            let environments = batch.environments() as f32;
            batch.state.iter_mut().for_each(|value| *value += environments);
            Ok(())
        }
    }

    #[test]
    fn one_by_one_every_environment_is_a_batch_of_its_own() {
        let mut batch = ActingBatch::new(3, SIZES);
        batch.state = (0..12).map(|value| value as f32).collect();
        OneByOne::new(Sizes, SIZES).forward(&mut batch).unwrap();
        assert_eq!(batch.state, (1..13).map(|value| value as f32).collect::<Vec<_>>());
    }

    const SIZES: ActingSizes =
        ActingSizes { proprioception: 0, task: 0, latent: 0, action: 2, image: 0, components: 3, state: 4 };

    /// Components that no noise can confuse, and their weights.
    fn mixture(weights: [f32; 3]) -> ActingBatch {
        let mut batch = ActingBatch::new(1, SIZES);
        batch.mean = vec![-10.0, -20.0, 0.5, 0.25, 10.0, 20.0];
        batch.std.fill(0.1);
        batch.log_weights = weights.map(f32::ln).to_vec();
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
            let mean = &batch.mean[2 * component..2 * component + 2];
            assert!(action.iter().zip(mean).all(|(action, mean)| (action - mean).abs() < 1.0), "{action:?}");
            counts[component] += 1;
        }
        // Five standard deviations of a count are 250.
        for (count, expected) in counts.into_iter().zip([2_000, 5_000, 3_000]) {
            assert!(count.abs_diff(expected) < 250, "{counts:?}");
        }
    }

    #[test]
    fn without_noise_the_likeliest_component_acts() {
        assert_eq!(mixture([0.2, 0.3, 0.5]).row(0).mode(), [10.0, 20.0]);
        assert_eq!(mixture([0.2, 0.5, 0.3]).row(0).mode(), [0.5, 0.25]);
        let mut one = ActingBatch::new(1, ActingSizes { components: 1, ..SIZES });
        one.mean = vec![0.5, -0.5];
        assert_eq!(one.row(0).mode(), [0.5, -0.5]);
    }

    #[test]
    fn weights_that_rounding_leaves_short_of_one_still_draw_a_component() {
        assert_eq!(draw(&[0.1_f32.ln(), 0.2_f32.ln()], 0.999), 1);
        assert_eq!(draw(&[(1.0_f32 - 1e-6).ln(), -80.0], 1.0 - 1e-7), 0, "and none that all but never acts");
        assert_eq!(draw(&[0.0, f32::NEG_INFINITY], 0.0), 0);
    }

    #[test]
    fn a_decision_fills_every_component_and_forgetting_empties_the_mind() {
        let mut batch = mixture([0.2, 0.3, 0.5]);
        batch.state.fill(1.0);
        let mut row = batch.row(0);
        row.decide(|mean| mean.copy_from_slice(&[0.1, 0.2]), 0.3);
        row.forget();
        assert_eq!(batch.mean, [0.1, 0.2, 0.1, 0.2, 0.1, 0.2]);
        assert_eq!((batch.std, batch.state), (vec![0.3; 6], vec![0.0; 4]));
        assert!(batch.log_weights.iter().all(|weight| (weight.exp() - 1.0 / 3.0).abs() < 1e-6));
    }
}
