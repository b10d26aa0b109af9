//! Parameters as safetensors documents of float32, or of bfloat16.

use std::collections::HashMap;

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use tch::{Device, Kind, Tensor, nn};

use crate::error::Error;

/// All parameters of `store`, also those that are not trained, sorted by name. The same parameters give the same bytes.
///
/// # Errors
/// [`Error::Torch`] if a parameter cannot be copied from its device.
pub fn to_safetensors(store: &nn::VarStore) -> Result<Vec<u8>, Error> {
    let mut parameters = Vec::new();
    for (name, tensor) in store.variables() {
        let shape: Vec<usize> = tensor.size().iter().map(|size| *size as usize).collect();
        let mut values = vec![0f32; tensor.numel()];
        let host = tensor.detach().f_to_device(Device::Cpu)?.f_to_kind(Kind::Float)?.f_contiguous()?;
        host.f_copy_data(&mut values, tensor.numel())?;
        let bytes: Vec<u8> = values.into_iter().flat_map(f32::to_le_bytes).collect();
        parameters.push((name, shape, bytes));
    }
    parameters.sort_by(|a, b| a.0.cmp(&b.0));
    let views = parameters
        .iter()
        .map(|(name, shape, bytes)| Ok((name.as_str(), TensorView::new(Dtype::F32, shape.clone(), bytes)?)))
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
    Ok(safetensors::serialize(views, None)?)
}

/// The same document with bfloat16 in place of float32, which is about half as long. The normaliser stays as it is: observations would
/// lose more than parameters.
///
/// # Errors
/// [`Error::Malformed`] if `document` is not one of [`to_safetensors`].
pub fn to_bfloat16(document: &[u8]) -> Result<Vec<u8>, Error> {
    let parameters = SafeTensors::deserialize(document)?;
    let narrow = |(name, view): (String, TensorView)| {
        let (kind, bytes) = match view.dtype() {
            Dtype::F32 if !name.starts_with(NORMALISER) => {
                (Dtype::BF16, floats(&view).flat_map(|value| nearest_bfloat16(value).to_le_bytes()).collect())
            }
            kind => (kind, view.data().to_vec()),
        };
        (name, kind, view.shape().to_vec(), bytes)
    };
    let mut narrowed: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> =
        parameters.tensors().into_iter().map(narrow).collect();
    narrowed.sort_by(|a, b| a.0.cmp(&b.0));
    let views = narrowed
        .iter()
        .map(|(name, kind, shape, bytes)| Ok((name.as_str(), TensorView::new(*kind, shape.clone(), bytes)?)))
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
    Ok(safetensors::serialize(views, None)?)
}

/// The beginning of the names of a normaliser's statistics.
const NORMALISER: &str = "normaliser.";

/// The upper half of the nearest float32 that has a bfloat16, of two equally near ones the even one. A large number may become infinite,
/// which every reader refuses, as it does a NaN.
fn nearest_bfloat16(value: f32) -> u16 {
    if value.is_nan() {
        return 0x7fc0;
    }
    let bits = value.to_bits();
    let even = (bits >> 16) & 1;
    (bits.wrapping_add(0x7fff + even) >> 16) as u16
}

/// The numbers of a tensor of float32 or bfloat16.
fn floats(view: &TensorView<'_>) -> impl Iterator<Item = f32> {
    let (singles, halves): (&[[u8; 4]], &[[u8; 2]]) = match view.dtype() {
        Dtype::BF16 => (&[], view.data().as_chunks().0),
        _ => (view.data().as_chunks().0, &[]),
    };
    let halves = halves.iter().map(|bytes| f32::from_bits(u32::from(u16::from_le_bytes(*bytes)) << 16));
    singles.iter().map(|bytes| f32::from_le_bytes(*bytes)).chain(halves)
}

/// Sets every parameter of `store` from `bytes`, which may come from anywhere. Before the first parameter changes, it
/// checks every name, shape and element type, and that every number is finite.
///
/// # Errors
/// [`Error`] with the name of the invalid parameter; then `store` is unchanged.
pub fn from_safetensors(store: &mut nn::VarStore, bytes: &[u8]) -> Result<(), Error> {
    set(&store.variables(), bytes, None)
}

/// Like [`from_safetensors`], for these variables of a store. The document may have one tensor more, which is not read.
pub(crate) fn set(variables: &HashMap<String, Tensor>, bytes: &[u8], other: Option<&str>) -> Result<(), Error> {
    let document = SafeTensors::deserialize(bytes)?;
    let unknown = |name: &&str| !variables.contains_key(*name) && Some(*name) != other;
    if let Some(name) = document.names().into_iter().find(unknown) {
        return Err(Error::Unknown { name: name.to_string() });
    }
    let mut checked: HashMap<&str, Tensor> = HashMap::new();
    for (name, variable) in variables {
        let view = document.tensor(name).map_err(|_| Error::Missing { name: name.clone() })?;
        checked.insert(name, check(name, &variable.size(), &view)?);
    }
    for (name, variable) in variables {
        if let Some(values) = checked.get(name.as_str()) {
            tch::no_grad(|| variable.shallow_clone().f_copy_(values)).map(drop)?;
        }
    }
    Ok(())
}

fn check(name: &str, expected: &[i64], view: &TensorView) -> Result<Tensor, Error> {
    if !matches!(view.dtype(), Dtype::F32 | Dtype::BF16) {
        return Err(Error::Kind { name: name.to_string(), found: format!("{:?}", view.dtype()) });
    }
    let found: Vec<i64> = view.shape().iter().map(|size| i64::try_from(*size).unwrap_or(i64::MAX)).collect();
    if found != expected {
        return Err(Error::Shape { name: name.to_string(), expected: expected.to_vec(), found });
    }
    let values: Vec<f32> = floats(view).collect();
    if !values.iter().all(|value| value.is_finite()) {
        return Err(Error::Number { name: name.to_string(), what: "an infinity or a NaN" });
    }
    // A normaliser divides by its standard deviations.
    if name.starts_with(NORMALISER) && name.ends_with("_std") && !values.iter().all(|value| *value > 0.0) {
        return Err(Error::Number { name: name.to_string(), what: "a standard deviation that is not positive" });
    }
    Ok(Tensor::from_slice(&values).f_reshape(expected)?)
}
