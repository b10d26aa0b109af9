//! What a gradient step reports.

use tch::{Device, Kind, Tensor};

/// The report of gradient steps, still on the device: nothing waits for it until [`Losses::to_values`].
#[derive(Debug)]
pub struct Losses {
    /// The names of the first entries of `packed`.
    names: Vec<&'static str>,
    /// The named losses, the temperatures, how many steps were taken, and how many were skipped after the last of them.
    packed: Tensor,
    /// Steps taken or skipped.
    steps: u64,
}

impl Losses {
    /// Packs the losses of one gradient step, each beside its name, so that one transfer reads them all.
    /// `temperatures` is a vector, and `taken`, a boolean scalar, says whether the step was taken.
    pub fn pack<const N: usize>(named: [(&'static str, &Tensor); N], temperatures: &Tensor, taken: &Tensor) -> Self {
        let scalars = named.map(|(_, loss)| loss.detach().reshape([1]).to_kind(Kind::Float));
        let taken = taken.reshape([1]).to_kind(Kind::Float);
        let skipped = 1.0 - &taken;
        let entries: Vec<&Tensor> = scalars.iter().chain([temperatures, &taken, &skipped]).collect();
        Self { names: named.iter().map(|(name, _)| *name).collect(), packed: Tensor::cat(&entries, 0), steps: 1 }
    }

    /// The mean over those of several single gradient steps that were taken, such as those on one batch; `None` if there
    /// is no step.
    pub fn mean(steps: &[Losses]) -> Option<Losses> {
        let first = steps.first()?;
        let numbers = first.packed.size()[0] - 2;
        let packed: Vec<&Tensor> = steps.iter().map(|losses| &losses.packed).collect();
        let packed = Tensor::stack(&packed, 0);
        let [taken, skipped] = [numbers, numbers + 1].map(|column| packed.narrow(1, column, 1));
        let sums = packed.where_scalarother(&taken.gt(0.5), 0.0).sum_dim_intlist(0i64, false, Kind::Float);
        let count = taken.sum(Kind::Float).reshape([1]);
        // From the last step backwards: 1 until the first step that was taken.
        let at_the_end = skipped.flip([0]).cumprod(0, Kind::Float).sum(Kind::Float).reshape([1]);
        let means = sums.narrow(0, 0, numbers) / &count;
        let packed = Tensor::cat(&[means, count, at_the_end], 0);
        Some(Self { names: first.names.clone(), packed, steps: steps.len() as u64 })
    }

    /// Reads the report from the device, in one transfer.
    pub fn to_values(&self) -> LossValues {
        let mut all = vec![f32::NAN; self.packed.numel()];
        let count = all.len();
        // A failed transfer leaves NaN, which `LossValues::is_finite` reports.
        let _ = self.packed.to_device(Device::Cpu).f_copy_data(&mut all, count);
        let counts = all.split_off(count.saturating_sub(2));
        let temperatures = all.split_off(self.names.len().min(all.len()));
        let [taken, skipped_last] = counts.try_into().unwrap_or([f32::NAN; 2]);
        LossValues {
            named: self.names.iter().copied().zip(all).collect(),
            temperatures,
            steps: self.steps,
            // NaN counts none as taken.
            skipped: self.steps.saturating_sub(taken as u64),
            skipped_last: if taken >= 1.0 { skipped_last as u64 } else { self.steps },
        }
    }
}

/// Gradient steps in numbers. Steps that were skipped do not count in the means. If no step was taken, the losses are NaN,
/// or, after a single step, whatever that step computed.
#[derive(Clone, Debug, PartialEq)]
pub struct LossValues {
    named: Vec<(&'static str, f32)>,
    /// Every temperature after the step: one, or one for each task; empty if the algorithm has none.
    pub temperatures: Vec<f32>,
    /// Gradient steps taken or skipped.
    pub steps: u64,
    /// How many of them were skipped, because the loss or a gradient was not finite.
    pub skipped: u64,
    /// How many of them were skipped after the last one that was taken.
    pub skipped_last: u64,
}

impl LossValues {
    /// Names and numbers, for a log line.
    pub fn entries(&self) -> &[(&'static str, f32)] {
        &self.named
    }

    /// The loss of this name; `None` if the algorithm reports none.
    pub fn get(&self, name: &str) -> Option<f32> {
        self.named.iter().find(|(found, _)| *found == name).map(|(_, value)| *value)
    }

    /// Whether every loss is finite.
    pub fn is_finite(&self) -> bool {
        self.named.iter().all(|(_, value)| value.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_loss_is_read_by_the_name_it_was_packed_with() {
        let [mean, std] = [1.0f32, 2.0].map(Tensor::from);
        let (temperatures, taken) = (Tensor::from_slice(&[3.0f32, 4.0]), Tensor::from(true));
        let losses = Losses::pack([("kl_mean", &mean), ("kl_std", &std)], &temperatures, &taken);
        let values = Losses::mean(&[losses]).unwrap().to_values();
        assert_eq!([values.get("kl_mean"), values.get("kl_std")], [Some(1.0), Some(2.0)]);
        assert_eq!((values.temperatures.as_slice(), values.skipped), (&[3.0, 4.0][..], 0));
        assert_eq!(values.get("another"), None);
    }
}
