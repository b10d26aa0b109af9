//! Adam (Kingma & Ba, 2015), with a state that can be saved and restored bit for bit.
//!
//! libtorch's own optimiser gives no access to its moments, so no checkpoint could hold them. Here they are plain tensors, one
//! pair for each parameter, updated in place. The update makes eight passes over the memory of a parameter.
//!
//! Whether a step counts is decided on the device. The step is computed either way, and one that does not count adds nothing.
//! So no thread waits for the device within an update.

use std::collections::HashMap;

use comic_experiment::Optimiser;
use tch::{Device, Kind, Tensor};

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

/// Adam over groups of parameters.
#[derive(Debug)]
pub struct Adam {
    groups: Vec<Group>,
    beta1: f64,
    beta2: f64,
    epsilon: f64,
}

impl Adam {
    /// No groups yet; β₁, β₂ and ε are `config`'s.
    pub fn new(config: &Optimiser) -> Self {
        Self { groups: Vec::new(), beta1: config.beta1, beta2: config.beta2, epsilon: config.epsilon }
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
    pub fn step(&mut self, group: usize, gradients: &[Tensor], counts: &Tensor) {
        let (beta1, beta2, epsilon) = (self.beta1, self.beta2, self.epsilon);
        let Some(group) = self.groups.get_mut(group) else { return };
        let learning_rate = group.learning_rate.double_value(&[]);
        tch::no_grad(|| {
            let _ = group.steps.g_add_(&counts.to_kind(Kind::Int64));
            // Before the first step that counts, there is nothing to correct.
            let steps = group.steps.clamp_min(1).to_kind(Kind::Double);
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
            let moments = group.first.iter_mut().zip(&mut group.second);
            for ((parameter, gradient), (first, second)) in group.parameters.iter_mut().zip(gradients).zip(moments) {
                let gradient = gradient.where_scalarother(counts, 0.0);
                let _ = first.lerp_tensor_(&gradient, &weight1);
                let _ = second.lerp_tensor_(&gradient.square(), &weight2);
                let mut divisor = second.sqrt();
                let _ = divisor.g_add_(&epsilon);
                let _ = divisor.g_mul_(&scale);
                let _ = parameter.addcdiv_(first, &divisor);
            }
        });
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
