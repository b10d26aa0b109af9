//! libtorch's fused Adam: see `fused.cpp`.

#![allow(unsafe_code, reason = "calls a C++ function")]

use std::ffi::{c_char, c_void};

use comic_experiment::Optimiser;
use tch::{Device, Kind, TchError, Tensor};

unsafe extern "C" {
    fn comic_fused_adam(
        count: usize,
        parameters: *const *const c_void,
        gradients: *const *const c_void,
        first: *const *const c_void,
        second: *const *const c_void,
        steps: *const c_void,
        skipped: *const c_void,
        learning_rate: f64,
        beta1: f64,
        beta2: f64,
        epsilon: f64,
        message: *mut c_char,
        room: usize,
    ) -> bool;
}

/// Parameters with their gradients and moments, in the same order.
pub(super) struct Parameters<'a> {
    pub(super) parameters: &'a [Tensor],
    pub(super) gradients: &'a [Tensor],
    pub(super) first: &'a [Tensor],
    pub(super) second: &'a [Tensor],
}

/// Step number `steps` of the parameters and their moments, unless `skipped` is 1. Both are float32 scalars on the device.
///
/// # Errors
/// A gradient or a moment that is not like its parameter; whatever libtorch refuses. Nothing is changed then.
pub(super) fn step(
    of: &Parameters<'_>,
    steps: &Tensor,
    skipped: &Tensor,
    learning_rate: f64,
    config: &Optimiser,
) -> Result<(), TchError> {
    let Parameters { parameters, gradients, first, second } = of;
    let count = parameters.len();
    if count == 0 {
        return Ok(());
    }
    if [gradients, first, second].iter().any(|tensors| tensors.len() != count) {
        return Err(TchError::Shape(format!("{} gradients for {count} parameters", gradients.len())));
    }
    for others in [gradients, first, second] {
        for (parameter, other) in parameters.iter().zip(*others) {
            if !parameter.is_contiguous() || like(parameter) != like(other) {
                return Err(TchError::Shape(format!("Adam cannot step {parameter:?} by {other:?}")));
            }
        }
    }
    let [parameters, gradients, first, second] =
        [parameters, gradients, first, second].map(|tensors| tensors.iter().map(pointer).collect::<Vec<_>>());
    let mut message = [0_u8; 1024];
    // SAFETY: each list has `count` pointers to tensors that live until the function returns. libtorch goes through their memory in
    // order, which is right for contiguous tensors of one size and type. Every C++ exception is caught.
    let stepped = unsafe {
        comic_fused_adam(
            count,
            parameters.as_ptr(),
            gradients.as_ptr(),
            first.as_ptr(),
            second.as_ptr(),
            pointer(steps),
            pointer(skipped),
            learning_rate,
            config.beta1,
            config.beta2,
            config.epsilon,
            message.as_mut_ptr().cast(),
            message.len(),
        )
    };
    if stepped {
        return Ok(());
    }
    Err(TchError::Torch(String::from_utf8_lossy(&message).trim_end_matches('\0').to_owned()))
}

/// What a parameter has in common with its gradient and its moments.
fn like(tensor: &Tensor) -> (Vec<i64>, Vec<i64>, Kind, Device) {
    (tensor.size(), tensor.stride(), tensor.kind(), tensor.device())
}

fn pointer(tensor: &Tensor) -> *const c_void {
    tensor.as_ptr().cast()
}
