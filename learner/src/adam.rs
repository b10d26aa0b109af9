//! Adam (Kingma & Ba, 2015), with a state that can be saved and restored bit for bit.
//!
//! libtorch's own optimiser gives no access to its moments, so no checkpoint could hold them. Here they are plain tensors, one
//! pair for each parameter, updated in place: by libtorch's fused step where the device has one, otherwise, on XLA, by operations that
//! XLA fuses.
//!
//! Whether a step counts is decided on the device, so no thread waits for it within an update.

mod fused;

use std::collections::HashMap;

use comic_experiment::Optimiser;
use tch::{Device, Kind, TchError, Tensor};

/// What can go wrong when a state is restored.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StateError {
    /// A tensor of the state is absent.
    #[error("state has no `{name}`; it was saved by another experiment or version")]
    Missing {
        /// The tensor's name.
        name: String,
    },
    /// A tensor that does not belong to the state.
    #[error("state has an unknown `{name}`; it was saved by another experiment or version")]
    Unknown {
        /// The tensor's name.
        name: String,
    },
    /// A tensor of another shape or element type.
    #[error("`{name}` is {found} in the state where {expected} is needed")]
    Mismatch {
        /// The tensor's name.
        name: String,
        /// Shape and element type needed.
        expected: String,
        /// Shape and element type found.
        found: String,
    },
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}

/// Parameters that share a learning rate and are stepped together.
#[derive(Debug)]
struct Group {
    name: String,
    names: Vec<String>,
    parameters: Vec<Tensor>,
    /// m, the mean of the gradient.
    first: Vec<Tensor>,
    /// v, the mean of the squared gradient.
    second: Vec<Tensor>,
    /// Steps that counted, int64, on the device.
    steps: Tensor,
    /// Float64; a tensor, so that it is saved like everything else.
    learning_rate: Tensor,
}

impl Group {
    /// The update by libtorch's fused step.
    fn fused(
        &self,
        counted: &Tensor,
        gradients: &[Tensor],
        counts: &Tensor,
        config: &Optimiser,
    ) -> Result<(), TchError> {
        let Self { parameters, first, second, learning_rate, .. } = self;
        let [steps, skipped] = [counted, &counts.logical_not()].map(|scalar| scalar.to_kind(Kind::Float));
        // libtorch goes through the memory of each tensor in order, and a gradient may be a transposed view.
        let mut in_order = Vec::with_capacity(gradients.len());
        for (index, gradient) in gradients.iter().enumerate() {
            in_order.push(match parameters.get(index) {
                Some(parameter) if parameter.size() == gradient.size() && parameter.stride() != gradient.stride() => {
                    let mut copy = Tensor::empty(parameter.size(), (gradient.kind(), gradient.device()));
                    copy.f_copy_(gradient)?;
                    copy
                }
                _ => gradient.shallow_clone(),
            });
        }
        let all = fused::Parameters { parameters, gradients: &in_order, first, second };
        fused::step(&all, &steps, &skipped, learning_rate.double_value(&[]), config)
    }

    /// The same update composed of operations, in eight passes over the memory. It is computed either way; one that does not count
    /// adds nothing.
    fn composed(&mut self, counted: &Tensor, gradients: &[Tensor], counts: &Tensor, config: &Optimiser) {
        let Optimiser { beta1, beta2, epsilon, .. } = *config;
        let learning_rate = self.learning_rate.double_value(&[]);
        // Before the first step that counts, there is nothing to correct.
        let steps = counted.clamp_min(1).to_kind(Kind::Double);
        let bias1: Tensor = 1.0 - Tensor::pow_scalar(beta1, &steps);
        let bias2: Tensor = 1.0 - Tensor::pow_scalar(beta2, &steps);
        let bias2_root = bias2.sqrt();
        // lr · (m / bias1) / (√v / bias2_root + ε) with both corrections moved into two scalars.
        let step_size = learning_rate * &bias2_root / bias1;
        let epsilon = bias2_root * epsilon;
        // A step that does not count divides by infinity, and blends in zeros with weight −0: unlike 0, this keeps −0.
        let scale = (-step_size.reciprocal()).where_scalarother(counts, f64::NEG_INFINITY);
        let scalar = (Kind::Float, counts.device());
        let [weight1, weight2] = [1.0 - beta1, 1.0 - beta2]
            .map(|weight| Tensor::full([0i64; 0], weight, scalar).where_scalarother(counts, -0.0));
        let moments = self.first.iter_mut().zip(&mut self.second);
        for ((parameter, gradient), (first, second)) in self.parameters.iter_mut().zip(gradients).zip(moments) {
            let gradient = gradient.where_scalarother(counts, 0.0);
            let _ = first.lerp_tensor_(&gradient, &weight1);
            let _ = second.lerp_tensor_(&gradient.square(), &weight2);
            let mut divisor = second.sqrt();
            let _ = divisor.g_add_(&epsilon);
            let _ = divisor.g_mul_(&scale);
            let _ = parameter.addcdiv_(first, &divisor);
        }
    }
}

/// Adam over groups of parameters.
#[derive(Debug)]
pub struct Adam {
    groups: Vec<Group>,
    config: Optimiser,
}

impl Adam {
    /// No groups yet; β₁, β₂ and ε are `config`'s.
    pub fn new(config: &Optimiser) -> Self {
        Self { groups: Vec::new(), config: config.clone() }
    }

    /// Adds named parameters that share `learning_rate`, and returns the group's index. Names must be unique over all
    /// groups: they name the moments in the state.
    pub fn add_group(&mut self, name: &str, parameters: Vec<(String, Tensor)>, learning_rate: f64) -> usize {
        let (names, parameters): (Vec<_>, Vec<_>) = parameters.into_iter().unzip();
        let zeros = || parameters.iter().map(|parameter| parameter.detach().zeros_like()).collect::<Vec<_>>();
        let device = parameters.first().map_or(Device::Cpu, Tensor::device);
        self.groups.push(Group {
            name: name.to_string(),
            first: zeros(),
            second: zeros(),
            names,
            parameters,
            steps: Tensor::from(0i64).to_device(device),
            learning_rate: Tensor::from(learning_rate),
        });
        self.groups.len() - 1
    }

    /// The parameters of a group, in the order in which [`Adam::step`] takes their gradients.
    pub fn parameters(&self, group: usize) -> &[Tensor] {
        self.groups.get(group).map_or(&[], |group| &group.parameters)
    }

    /// The steps of a group that counted, an int64 scalar on its device.
    ///
    /// # Panics
    /// If there is no such group.
    pub(crate) fn steps(&self, group: usize) -> &Tensor {
        &self.groups[group].steps
    }

    /// The learning rate of a group.
    pub fn learning_rate(&self, group: usize) -> f64 {
        self.groups.get(group).map_or(0.0, |group| group.learning_rate.double_value(&[]))
    }

    /// Sets the learning rate of a group.
    pub fn set_learning_rate(&mut self, group: usize, learning_rate: f64) {
        if let Some(group) = self.groups.get_mut(group) {
            group.learning_rate = Tensor::from(learning_rate);
        }
    }

    /// One step of a group: θ ← θ − lr · m̂ / (√v̂ + ε), with gradients in the order of [`Adam::parameters`]. Where
    /// `counts`, a boolean scalar, is false, nothing changes, whatever the gradients are.
    ///
    /// # Errors
    /// [`StateError::Torch`] when libtorch refuses a gradient.
    pub fn step(&mut self, group: usize, gradients: &[Tensor], counts: &Tensor) -> Result<(), StateError> {
        let Some(group) = self.groups.get_mut(group) else { return Ok(()) };
        tch::no_grad(|| {
            let counted = &group.steps + counts.to_kind(Kind::Int64);
            match counts.device() {
                Device::Cpu | Device::Cuda(_) => group.fused(&counted, gradients, counts, &self.config)?,
                _ => group.composed(&counted, gradients, counts, &self.config),
            }
            group.steps.f_copy_(&counted)?;
            Ok(())
        })
    }

    /// Everything that changes future steps, by name. The tensors are copies.
    pub fn state(&self) -> Vec<(String, Tensor)> {
        self.entries().into_iter().map(|(name, tensor)| (name, tensor.copy())).collect()
    }

    /// Names and tensors of the state, sharing memory with it.
    pub(crate) fn entries(&self) -> Vec<(String, Tensor)> {
        let mut entries = Vec::new();
        for group in &self.groups {
            entries.push((format!("adam.{}.steps", group.name), group.steps.shallow_clone()));
            entries.push((format!("adam.{}.learning_rate", group.name), group.learning_rate.shallow_clone()));
            for ((name, first), second) in group.names.iter().zip(&group.first).zip(&group.second) {
                entries.push((format!("adam.first.{name}"), first.shallow_clone()));
                entries.push((format!("adam.second.{name}"), second.shallow_clone()));
            }
        }
        entries
    }

    /// Restores a state of [`Adam::state`].
    ///
    /// # Errors
    /// [`StateError`] when names, shapes or element types differ; nothing is changed then.
    pub fn load_state(&mut self, state: &[(String, Tensor)]) -> Result<(), StateError> {
        restore(self.entries(), state)
    }
}

/// Copies `state` into `entries`, all or nothing.
pub(crate) fn restore(entries: Vec<(String, Tensor)>, state: &[(String, Tensor)]) -> Result<(), StateError> {
    let saved: HashMap<&str, &Tensor> = state.iter().map(|(name, tensor)| (name.as_str(), tensor)).collect();
    for (name, entry) in &entries {
        let found = saved.get(name.as_str()).ok_or_else(|| StateError::Missing { name: name.clone() })?;
        if describe(found) != describe(entry) {
            return Err(StateError::Mismatch { name: name.clone(), expected: describe(entry), found: describe(found) });
        }
    }
    if entries.len() != state.len() {
        let known: std::collections::HashSet<&str> = entries.iter().map(|(name, _)| name.as_str()).collect();
        let unknown = state.iter().find(|(name, _)| !known.contains(name.as_str()));
        let name = unknown.map_or_else(|| "duplicate".to_string(), |(name, _)| name.clone());
        return Err(StateError::Unknown { name });
    }
    for (name, mut entry) in entries {
        if let Some(found) = saved.get(name.as_str()) {
            tch::no_grad(|| entry.f_copy_(found)).map(drop)?;
        }
    }
    Ok(())
}

fn describe(tensor: &Tensor) -> String {
    let kind: Kind = tensor.kind();
    format!("{kind:?} {:?}", tensor.size())
}

/// The Euclidean norm of all gradients together, a scalar tensor.
pub fn global_norm(gradients: &[Tensor]) -> Tensor {
    let norms: Vec<Tensor> = gradients.iter().map(Tensor::norm).collect();
    Tensor::stack(&norms, 0).norm()
}

/// Scales `gradients` in place so that their global norm, `norm`, becomes at most `limit`.
pub fn clip_by_global_norm(gradients: &mut [Tensor], norm: &Tensor, limit: f64) {
    let scale = (norm.clamp_min(limit).reciprocal() * limit).detach();
    for gradient in gradients {
        let _ = gradient.g_mul_(&scale);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CPU: (Kind, Device) = (Kind::Float, Device::Cpu);

    fn adam_of(start: &Tensor) -> Adam {
        let mut adam = Adam::new(&Optimiser::default());
        adam.add_group("all", vec![("x".into(), start.copy())], 3e-3);
        adam
    }

    fn state(adam: &Adam) -> Vec<Vec<u32>> {
        let group = &adam.groups[0];
        let all = [&group.parameters, &group.first, &group.second].into_iter().flatten();
        all.map(|tensor| Vec::<f32>::try_from(tensor.view(-1)).unwrap().into_iter().map(f32::to_bits).collect())
            .collect()
    }

    #[test]
    fn the_composed_step_of_other_devices_is_the_fused_one() {
        let start = Tensor::linspace(-1.0, 1.0, 38, CPU).view([2, 19]);
        let (mut fused, mut composed) = (adam_of(&start), adam_of(&start));
        for step in 0..500 {
            // A transposed view, as libtorch's gradient of a matrix may be.
            let gradient = (start.tr().contiguous() * f64::from(step)).sin().tr() * f64::from(10f32.powi(step % 9 - 6));
            let (gradients, counts) = ([gradient], Tensor::from(step % 5 != 3));
            fused.step(0, &gradients, &counts).unwrap();
            let (config, group) = (composed.config.clone(), &mut composed.groups[0]);
            let counted = &group.steps + counts.to_kind(Kind::Int64);
            group.composed(&counted, &gradients, &counts, &config);
            group.steps = counted;
            let [one, other] = [&fused, &composed].map(|adam| &adam.groups[0].parameters[0]);
            let difference = (one - other).abs().max().double_value(&[]);
            assert!(difference < 1e-6, "step {step}: {difference}");
        }
    }

    #[test]
    fn a_composed_step_that_does_not_count_changes_not_one_bit() {
        let mut adam = adam_of(&Tensor::from_slice(&[0.5f32, -1e-30, -0.0, 7.0]));
        let config = adam.config.clone();
        let poison = Tensor::from_slice(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38]);
        for step in 0..5 {
            let before = state(&adam);
            adam.groups[0].composed(&Tensor::from(i64::from(step)), &[poison.copy()], &Tensor::from(false), &config);
            assert_eq!(state(&adam), before, "before step {step}");
            adam.step(0, &[Tensor::from_slice(&[1.0, -1e-30, -1e-45, step as f32])], &Tensor::from(true)).unwrap();
        }
    }

    #[test]
    fn gradients_that_are_not_like_the_parameters_are_refused_and_change_nothing() {
        let mut adam = adam_of(&Tensor::zeros([2, 3], CPU));
        let before = (state(&adam), adam.groups[0].steps.int64_value(&[]));
        let wrong = [Tensor::zeros([3], CPU), Tensor::zeros([2, 3], (Kind::Double, Device::Cpu))];
        for gradients in [&[][..], &wrong[..1], &wrong[1..]] {
            assert!(adam.step(0, gradients, &Tensor::from(true)).is_err(), "{gradients:?}");
            assert_eq!((state(&adam), adam.groups[0].steps.int64_value(&[])), before);
        }
    }

    #[test]
    fn a_step_is_a_change_that_libtorch_counts() {
        let mut adam = adam_of(&Tensor::zeros([2, 3], CPU));
        let version = adam.groups[0].parameters[0].internal_version();
        adam.step(0, &[Tensor::ones([2, 3], CPU)], &Tensor::from(true)).unwrap();
        // Weights that are packed for acting are packed again then.
        assert!(adam.groups[0].parameters[0].internal_version() > version);
    }
}
