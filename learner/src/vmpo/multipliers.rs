//! The Lagrange multipliers.

use comic_experiment::Vmpo;
use tch::{Device, Tensor};

/// Multipliers are projected to at least this after each step (V).
pub const MULTIPLIER_FLOOR: f64 = 1e-8;

/// η, α_μ, α_Σ and, for a mixture, α_discrete: positive numbers that are learned as they are, one parameter.
#[derive(Debug)]
pub struct Multipliers {
    parameter: Tensor,
}

impl Multipliers {
    /// From η, α_μ, α_Σ and perhaps α_discrete; each at least [`MULTIPLIER_FLOOR`].
    pub fn new(values: &[f32], device: Device) -> Self {
        let values: Vec<f32> = values.iter().map(|value| value.max(MULTIPLIER_FLOOR as f32)).collect();
        Self { parameter: Tensor::from_slice(&values).to_device(device).set_requires_grad(true) }
    }

    /// The experiment's starting values (S: 1 each).
    pub fn initial(config: &Vmpo, components: usize, device: Device) -> Self {
        let mut values = vec![config.initial_temperature, config.initial_alpha_mean, config.initial_alpha_std];
        if components > 1 {
            values.push(config.initial_alpha_discrete);
        }
        let values: Vec<f32> = values.into_iter().map(|value| value as f32).collect();
        Self::new(&values, device)
    }

    /// η, a scalar that carries gradient.
    pub fn temperature(&self) -> Tensor {
        self.parameter.select(0, 0)
    }

    /// α_μ, a scalar that carries gradient.
    pub fn alpha_mean(&self) -> Tensor {
        self.parameter.select(0, 1)
    }

    /// α_Σ, a scalar that carries gradient.
    pub fn alpha_std(&self) -> Tensor {
        self.parameter.select(0, 2)
    }

    /// α_discrete, a scalar that carries gradient; only mixtures have one.
    pub fn alpha_discrete(&self) -> Option<Tensor> {
        (self.parameter.numel() > 3).then(|| self.parameter.select(0, 3))
    }

    /// The parameter itself: η, α_μ, α_Σ and perhaps α_discrete, `[3]` or `[4]`.
    pub fn parameter(&self) -> &Tensor {
        &self.parameter
    }

    /// Projects every multiplier to at least [`MULTIPLIER_FLOOR`]; to be called after each gradient step.
    pub fn project(&mut self) {
        tch::no_grad(|| {
            let _ = self.parameter.clamp_min_(MULTIPLIER_FLOOR);
        });
    }
}
