//! The Lagrange multipliers.

use comic_experiment::Vmpo;
use tch::{Device, Tensor};

/// Multipliers are projected to at least this after each step (V).
pub const MULTIPLIER_FLOOR: f64 = 1e-8;

/// The ηs, α_μ, α_Σ and, for a mixture, α_discrete: positive numbers, learned directly as one parameter.
#[derive(Debug)]
pub struct Multipliers {
    parameter: Tensor,
    /// Number of ηs: one, or one for each task.
    temperatures: i64,
}

impl Multipliers {
    /// From the ηs, and α_μ, α_Σ and perhaps α_discrete; each at least [`MULTIPLIER_FLOOR`].
    pub fn new(temperatures: &[f32], alphas: &[f32], device: Device) -> Self {
        let values: Vec<f32> =
            temperatures.iter().chain(alphas).map(|value| value.max(MULTIPLIER_FLOOR as f32)).collect();
        let parameter = Tensor::from_slice(&values).to_device(device).set_requires_grad(true);
        Self { parameter, temperatures: temperatures.len() as i64 }
    }

    /// The experiment's starting values (S: 1 each).
    pub fn initial(config: &Vmpo, temperatures: usize, components: usize, device: Device) -> Self {
        let mut alphas = vec![config.initial_alpha_mean as f32, config.initial_alpha_std as f32];
        if components > 1 {
            alphas.push(config.initial_alpha_discrete as f32);
        }
        Self::new(&vec![config.initial_temperature as f32; temperatures], &alphas, device)
    }

    /// Every η, `[1]` or one for each task; carries gradient.
    pub fn temperatures(&self) -> Tensor {
        self.parameter.narrow(0, 0, self.temperatures)
    }

    /// α_μ, a scalar that carries gradient.
    pub fn alpha_mean(&self) -> Tensor {
        self.parameter.select(0, self.temperatures)
    }

    /// α_Σ, a scalar that carries gradient.
    pub fn alpha_std(&self) -> Tensor {
        self.parameter.select(0, self.temperatures + 1)
    }

    /// α_discrete, a scalar that carries gradient; only mixtures have one.
    pub fn alpha_discrete(&self) -> Option<Tensor> {
        let place = self.temperatures + 2;
        (self.parameter.size()[0] > place).then(|| self.parameter.select(0, place))
    }

    /// The parameter itself: the ηs, α_μ, α_Σ and perhaps α_discrete.
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
