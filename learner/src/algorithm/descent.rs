//! A step down the gradients of one loss.

use tch::Tensor;

use crate::adam::{self, Adam};
use crate::algorithm::error::Error;

/// The gradients of one group of Adam's parameters.
pub(crate) struct Gradients {
    group: usize,
    gradients: Vec<Tensor>,
    /// Their global norm, before any clipping.
    norm: Tensor,
}

/// The gradient of `total` for each input. An input that the loss does not depend on has no gradient tensor; here its gradient is
/// 0.
///
/// # Errors
/// When libtorch refuses.
pub(crate) fn gradients_of(total: &Tensor, inputs: &[&Tensor]) -> Result<Vec<Tensor>, Error> {
    let mut gradients = Tensor::f_run_backward(&[total], inputs, false, false)?;
    for (gradient, input) in gradients.iter_mut().zip(inputs) {
        if !gradient.defined() {
            *gradient = input.detach().zeros_like();
        }
    }
    Ok(gradients)
}

impl Gradients {
    /// In the order of the group's parameters.
    pub(crate) fn new(group: usize, gradients: Vec<Tensor>) -> Self {
        let norm = adam::global_norm(&gradients);
        Self { group, gradients, norm }
    }

    /// Their global norm, before any clipping.
    pub(crate) fn norm(&self) -> Tensor {
        self.norm.shallow_clone()
    }

    /// Scaled down to the global norm `limit` if theirs is larger; 0 is no limit.
    pub(crate) fn clipped(mut self, limit: f64) -> Self {
        if limit > 0.0 {
            adam::clip_by_global_norm(&mut self.gradients, &self.norm, limit);
        }
        self
    }
}

/// Steps every group, or none of them if `total` or a gradient is not finite. Returns whether the step was taken, a boolean
/// scalar on the device.
///
/// # Errors
/// When libtorch refuses.
pub(crate) fn descend(adam: &mut Adam, total: &Tensor, groups: &[Gradients]) -> Result<Tensor, Error> {
    // Of the squares, because Adam keeps squares: if their sum is finite, each of them is.
    let sum = groups.iter().fold(total.detach(), |sum, gradients| sum + gradients.norm.square());
    let finite = sum.isfinite().all();
    for Gradients { group, gradients, .. } in groups {
        adam.step(*group, gradients, &finite)?;
    }
    Ok(finite)
}
