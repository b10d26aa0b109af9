//! The Lagrange multipliers.

use comic_experiment::Vmpo;
use tch::{Device, Tensor};

/// Multipliers are projected to at least this after each step (V).
pub const MULTIPLIER_FLOOR: f64 = 1e-8;

/// η, α_μ and α_Σ: positive numbers that are learned as they are, one parameter of shape `[3]`.
#[derive(Debug)]
pub struct Multipliers {
    parameter: Tensor,
}

impl Multipliers {
    /// From a temperature η, α_μ and α_Σ; each at least [`MULTIPLIER_FLOOR`].
    pub fn new(temperature: f32, alpha_mean: f32, alpha_std: f32, device: Device) -> Self {
        let values = [temperature, alpha_mean, alpha_std].map(|value| value.max(MULTIPLIER_FLOOR as f32));
        Self { parameter: Tensor::from_slice(&values).to_device(device).set_requires_grad(true) }
    }

    /// The experiment's starting values (S: 1 each).
    pub fn initial(config: &Vmpo, device: Device) -> Self {
        Self::new(
            config.initial_temperature as f32,
            config.initial_alpha_mean as f32,
            config.initial_alpha_std as f32,
            device,
        )
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

    /// The parameter itself, `[3]`: η, α_μ, α_Σ.
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
