//! What a gradient step reports.

use tch::{Device, Kind, Tensor};

/// Entries of the packed tensor.
const COUNT: usize = 18;

/// The report of gradient steps, still on the device: nothing waits for it until [`Losses::to_values`].
#[derive(Debug)]
pub struct Losses {
    /// The scalars and the ηs, then how many steps were taken, and how many were skipped after the last of them.
    packed: Tensor,
    /// Steps taken or skipped.
    steps: u64,
}

impl Losses {
    /// Packs scalars in the order of [`LossValues`]' fields, the ηs, and whether the step was taken.
    pub(crate) fn pack(entries: [&Tensor; COUNT], temperatures: &Tensor, taken: &Tensor) -> Self {
        let scalars = entries.map(|entry| entry.detach().reshape([1]).to_kind(Kind::Float));
        let taken = taken.reshape([1]).to_kind(Kind::Float);
        let skipped = 1.0 - &taken;
        let entries: Vec<&Tensor> = scalars.iter().chain([temperatures, &taken, &skipped]).collect();
        Self { packed: Tensor::cat(&entries, 0), steps: 1 }
    }

    /// The mean over those of several single gradient steps that were taken, such as those on one batch; `None` of
    /// nothing.
    pub fn mean(steps: &[Losses]) -> Option<Losses> {
        let numbers = steps.first()?.packed.size()[0] - 2;
        let packed: Vec<&Tensor> = steps.iter().map(|losses| &losses.packed).collect();
        let packed = Tensor::stack(&packed, 0);
        let [taken, skipped] = [numbers, numbers + 1].map(|column| packed.narrow(1, column, 1));
        let sums = packed.where_scalarother(&taken.gt(0.5), 0.0).sum_dim_intlist(0i64, false, Kind::Float);
        let count = taken.sum(Kind::Float).reshape([1]);
        // From the last step backwards, 1 until the first one that was taken.
        let at_the_end = skipped.flip([0]).cumprod(0, Kind::Float).sum(Kind::Float).reshape([1]);
        let means = sums.narrow(0, 0, numbers) / &count;
        Some(Self { packed: Tensor::cat(&[means, count, at_the_end], 0), steps: steps.len() as u64 })
    }

    /// Reads the report from the device, in one transfer.
    pub fn to_values(&self) -> LossValues {
        let mut all = vec![f32::NAN; self.packed.numel()];
        let count = all.len();
        // A failed transfer leaves NaN, which `LossValues::is_finite` reports.
        let _ = self.packed.to_device(Device::Cpu).f_copy_data(&mut all, count);
        let counts = all.split_off(count.saturating_sub(2));
        let temperatures = all.split_off(COUNT.min(all.len()));
        let [taken, skipped_last] = counts.try_into().unwrap_or([f32::NAN; 2]);
        let [
            total_loss,
            policy_loss,
            temperature_loss,
            alpha_loss,
            value_loss,
            regression_loss,
            latent_kl,
            kl_mean,
            kl_std,
            kl_weights,
            temperature,
            alpha_mean,
            alpha_std,
            alpha_discrete,
            policy_std,
            gradient_norm,
            variance_explained,
            valid_share,
        ] = all.try_into().unwrap_or([f32::NAN; COUNT]);
        LossValues {
            total_loss,
            policy_loss,
            temperature_loss,
            alpha_loss,
            value_loss,
            regression_loss,
            latent_kl,
            kl_mean,
            kl_std,
            kl_weights,
            temperature,
            alpha_mean,
            alpha_std,
            alpha_discrete,
            policy_std,
            gradient_norm,
            variance_explained,
            valid_share,
            temperatures,
            steps: self.steps,
            // NaN counts none as taken.
            skipped: self.steps.saturating_sub(taken as u64),
            skipped_last: if taken >= 1.0 { skipped_last as u64 } else { self.steps },
        }
    }
}

/// Gradient steps in numbers. Those of steps that were skipped are left out; where none was taken they are NaN, or what
/// the one step made of its losses.
#[derive(Clone, Debug, PartialEq)]
pub struct LossValues {
    /// The loss that was differentiated.
    pub total_loss: f32,
    /// L_π.
    pub policy_loss: f32,
    /// L_η.
    pub temperature_loss: f32,
    /// L_α.
    pub alpha_loss: f32,
    /// ½ (V − G)², mean over valid steps, summed over reward terms.
    pub value_loss: f32,
    /// The regression's loss; 0 in a V-MPO step.
    pub regression_loss: f32,
    /// KL of the latent to its prior, nats a step.
    pub latent_kl: f32,
    /// Mean KL_μ to the behaviour policy, nats a step.
    pub kl_mean: f32,
    /// Mean KL_Σ to the behaviour policy, nats a step.
    pub kl_std: f32,
    /// Mean KL of a mixture's weights to the behaviour policy's, nats a step; 0 for one Gaussian.
    pub kl_weights: f32,
    /// η after the step; the mean where there are several.
    pub temperature: f32,
    /// α_μ after the step.
    pub alpha_mean: f32,
    /// α_Σ after the step.
    pub alpha_std: f32,
    /// α_discrete after the step; 0 for one Gaussian.
    pub alpha_discrete: f32,
    /// Mean standard deviation of the policy over valid steps and action dimensions.
    pub policy_std: f32,
    /// Global norm of the networks' gradients, before any clipping.
    pub gradient_norm: f32,
    /// 1 − Var(G − V) / Var(G), of the return summed over reward terms.
    pub variance_explained: f32,
    /// Assignment of the rows that are transitions, and in a warm start demonstrate something.
    pub valid_share: f32,
    /// Every η after the step: one, or one for each task.
    pub temperatures: Vec<f32>,
    /// Gradient steps taken or skipped.
    pub steps: u64,
    /// How many of them were skipped, since the loss or a gradient was not finite.
    pub skipped: u64,
    /// How many of them were skipped after the last one that was taken.
    pub skipped_last: u64,
}

impl LossValues {
    /// Names and numbers, for a log line.
    pub fn entries(&self) -> [(&'static str, f32); COUNT] {
        [
            ("total_loss", self.total_loss),
            ("policy_loss", self.policy_loss),
            ("temperature_loss", self.temperature_loss),
            ("alpha_loss", self.alpha_loss),
            ("value_loss", self.value_loss),
            ("regression_loss", self.regression_loss),
            ("latent_kl", self.latent_kl),
            ("kl_mean", self.kl_mean),
            ("kl_std", self.kl_std),
            ("kl_weights", self.kl_weights),
            ("temperature", self.temperature),
            ("alpha_mean", self.alpha_mean),
            ("alpha_std", self.alpha_std),
            ("alpha_discrete", self.alpha_discrete),
            ("policy_std", self.policy_std),
            ("gradient_norm", self.gradient_norm),
            ("variance_explained", self.variance_explained),
            ("valid_share", self.valid_share),
        ]
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.entries().iter().all(|(_, value)| value.is_finite())
    }
}
