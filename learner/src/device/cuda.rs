//! Copies batches to a GPU from pinned memory, on a separate stream: see `cuda.cpp`.

#![allow(unsafe_code, reason = "calls a C++ function")]

use std::ffi::{c_char, c_void};

use tch::kind::Element;
use tch::{Kind, TchError, Tensor};

unsafe extern "C" {
    fn comic_upload(
        bytes: *const c_void,
        size: *const i64,
        dimensions: usize,
        kind: i8,
        card: i64,
        message: *mut c_char,
        room: usize,
    ) -> *mut c_void;
}

/// A tensor on a GPU. Returns when the values were read, not when they were copied. Later operations of the calling thread
/// wait for the copy.
///
/// # Errors
/// When there are not as many values as `size` says, or the GPU refuses.
pub(super) fn upload<T: Element>(values: &[T], size: &[i64], card: usize) -> Result<Tensor, TchError> {
    let elements = size.iter().try_fold(1_usize, |product, width| product.checked_mul(usize::try_from(*width).ok()?));
    if elements != Some(values.len()) {
        return Err(TchError::Shape(format!("{} values do not fill a tensor of size {size:?}", values.len())));
    }
    // c10/core/ScalarType.h.
    let kind = match T::KIND {
        Kind::Uint8 => 0,
        Kind::Int64 => 4,
        Kind::Float => 6,
        other => return Err(TchError::Kind(format!("a batch has no field of {other:?}"))),
    };
    let mut message = [0_u8; 1024];
    // SAFETY: each pointer is valid for the length that is passed with it, and the function reads the values before it
    // returns. It catches every C++ exception.
    let made = unsafe {
        let (room, message) = (message.len(), message.as_mut_ptr().cast());
        comic_upload(values.as_ptr().cast(), size.as_ptr(), size.len(), kind, card as i64, message, room)
    };
    if made.is_null() {
        let said = String::from_utf8_lossy(&message);
        return Err(TchError::Torch(said.trim_end_matches('\0').to_owned()));
    }
    // SAFETY: it is a new tensor of libtorch that nothing else owns, like those that the bindings make.
    Ok(unsafe { Tensor::from_ptr(made.cast()) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_copy_has_the_same_values_and_without_a_gpu_it_is_an_error_of_libtorch() {
        let copied = upload(&[1_i64, 2, 3, 4, 5, 6], &[2, 3], 0);
        if tch::Cuda::device_count() > 0 {
            let found = copied.unwrap().to_device(tch::Device::Cpu);
            assert_eq!(found, Tensor::from_slice(&[1_i64, 2, 3, 4, 5, 6]).reshape([2, 3]));
        } else {
            let refused = copied.unwrap_err();
            assert!(matches!(&refused, TchError::Torch(said) if !said.is_empty()), "{refused}");
        }
    }

    #[test]
    fn a_size_that_does_not_fit_the_values_is_refused() {
        for size in [&[2_i64, 2][..], &[-3], &[i64::MAX, 3]] {
            assert!(matches!(upload(&[0_u8; 3], size, 0), Err(TchError::Shape(_))), "{size:?}");
        }
    }
}
