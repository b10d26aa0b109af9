//! Named tensors as one safetensors document, bit for bit, for checkpoints.

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use tch::{Device, Kind, Tensor};

use crate::error::{Error, Result};

/// Float32, float64 and int64 tensors of any shape; the same tensors give the same bytes.
///
/// # Errors
/// A tensor of another element type.
pub fn to_bytes(named: &[(String, Tensor)]) -> Result<Vec<u8>> {
    let mut parts = Vec::with_capacity(named.len());
    for (name, tensor) in named {
        let kind = match tensor.kind() {
            Kind::Float => Dtype::F32,
            Kind::Double => Dtype::F64,
            Kind::Int64 => Dtype::I64,
            other => return Err(unknown_kind(name, other)),
        };
        let host = tensor.detach().f_to_device(Device::Cpu)?.f_contiguous()?;
        let shape: Vec<usize> = host.size().iter().map(|size| *size as usize).collect();
        let mut bytes = vec![0u8; host.numel() * host.kind().elt_size_in_bytes()];
        host.f_copy_data_u8(&mut bytes, host.numel())?;
        parts.push((name, kind, shape, bytes));
    }
    let views = parts
        .iter()
        .map(|(name, kind, shape, bytes)| Ok((name.as_str(), TensorView::new(*kind, shape.clone(), bytes)?)))
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
        .map_err(damaged)?;
    safetensors::serialize(views, None).map_err(damaged)
}

/// The tensors that [`to_bytes`] wrote.
///
/// # Errors
/// Bytes that are not such a document.
pub fn from_bytes(bytes: &[u8]) -> Result<Vec<(String, Tensor)>> {
    let document = SafeTensors::deserialize(bytes).map_err(damaged)?;
    let mut named = Vec::new();
    for (name, view) in document.iter() {
        let kind = match view.dtype() {
            Dtype::F32 => Kind::Float,
            Dtype::F64 => Kind::Double,
            Dtype::I64 => Kind::Int64,
            other => return Err(unknown_kind(name, other)),
        };
        let shape: Vec<i64> = view.shape().iter().map(|size| *size as i64).collect();
        named.push((name.to_string(), Tensor::f_from_data_size(view.data(), &shape, kind)?));
    }
    Ok(named)
}

fn unknown_kind(name: &str, kind: impl std::fmt::Debug) -> Error {
    Error::Checkpoint(format!("tensor `{name}` is {kind:?}; a checkpoint holds only f32, f64 and i64"))
}

fn damaged(error: safetensors::SafeTensorError) -> Error {
    Error::Checkpoint(format!("a tensor document is damaged: {error}"))
}
