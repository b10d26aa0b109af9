//! What one batched forward pass reads and writes, and who can make one.

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
    /// Mean of the action `[E, A]`: written by the forward pass.
    pub mean: Vec<f32>,
    /// Standard deviation of the action `[E, A]`: written by the forward pass.
    pub std: Vec<f32>,
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
    /// `[A]`.
    pub mean: &'a mut [f32],
    /// `[A]`.
    pub std: &'a mut [f32],
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
            mean: zeros(sizes.action),
            std: zeros(sizes.action),
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
        let ActingSizes { proprioception, task, latent, action, image } = self.sizes;
        ActingRow {
            proprioception: part(&mut self.proprioception, environment, proprioception),
            task: part(&mut self.task, environment, task),
            image: part(&mut self.image, environment, image),
            previous_latent: part(&mut self.previous_latent, environment, latent),
            latent_noise: part(&mut self.latent_noise, environment, latent),
            latent: part(&mut self.latent, environment, latent),
            mean: part(&mut self.mean, environment, action),
            std: part(&mut self.std, environment, action),
        }
    }

    /// Draws the latents' noise of the coming step.
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

/// Makes a sampled action `mean + std · N(0, 1)`, unclipped: clipped actions must never be scored.
pub fn sample_action(mean: &[f32], std: &[f32], action: &mut [f32], rng: &mut impl Rng) {
    fill_normal(action, rng);
    for ((action, mean), std) in action.iter_mut().zip(mean).zip(std) {
        *action = mean + std * *action;
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

    /// Reads observations, previous latents and latent noise; writes `latent`, `mean` and `std`.
    ///
    /// # Errors
    /// When the library beneath fails.
    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error>;
}
