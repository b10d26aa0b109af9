//! Parameters as bytes: they are read as they were written, and invalid documents are refused.

#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

use std::collections::HashMap;

use comic_experiment::{Mlp, Network, TaskPart, TaskSpec};
use comic_networks::{Error, VmpoPolicy, from_safetensors, to_bfloat16, to_safetensors};
use proptest::prelude::*;
use safetensors::tensor::{Dtype, TensorView};
use tch::{Device, Kind, Tensor, nn};

fn store() -> nn::VarStore {
    let spec = TaskSpec {
        proprioception: 3,
        task: 4,
        action: 2,
        reward_terms: vec!["a".into()],
        image: 0,
        clips: vec!["x".into()],
        tasks: vec![TaskPart { name: "tracking".into(), observation: 4, clips: 1, max_reward: 1.0 }],
    };
    let mut network =
        Network { encoder: vec![8], mlp: Mlp { hidden: vec![8] }, normaliser_steps: 1, ..Network::default() };
    network.latent.size = 2;
    let store = nn::VarStore::new(Device::Cpu);
    VmpoPolicy::new(&store.root(), &spec, &network, &[0.0; 2]).unwrap();
    store
}

struct Entry {
    kind: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

/// The document of a fresh policy, altered by `alter`.
fn altered(alter: impl FnOnce(&mut HashMap<String, Entry>)) -> Vec<u8> {
    let bytes = to_safetensors(&store()).unwrap();
    let document = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let mut entries: HashMap<String, Entry> = document
        .tensors()
        .into_iter()
        .map(|(name, view)| {
            (name, Entry { kind: view.dtype(), shape: view.shape().to_vec(), bytes: view.data().to_vec() })
        })
        .collect();
    alter(&mut entries);
    let views = entries
        .iter()
        .map(|(name, entry)| (name, TensorView::new(entry.kind, entry.shape.clone(), &entry.bytes).unwrap()));
    safetensors::serialize(views, None).unwrap()
}

fn refused(bytes: &[u8]) -> Error {
    let mut store = store();
    let before = to_safetensors(&store).unwrap();
    let error = from_safetensors(&mut store, bytes).unwrap_err();
    assert_eq!(to_safetensors(&store).unwrap(), before, "a refused document changed the parameters");
    error
}

#[test]
fn parameters_are_read_as_they_were_written() {
    let (from, mut to) = (store(), store());
    let bytes = to_safetensors(&from).unwrap();
    from_safetensors(&mut to, &bytes).unwrap();
    assert_eq!(to_safetensors(&to).unwrap(), bytes);
}

#[test]
fn bfloat16_parameters_are_those_that_pytorch_rounds_to_and_the_normaliser_stays() {
    let (from, mut to) = (store(), store());
    let document = to_safetensors(&from).unwrap();
    let narrowed = to_bfloat16(&document).unwrap();
    assert!(narrowed.len() < document.len());
    from_safetensors(&mut to, &narrowed).unwrap();
    let read = to.variables();
    for (name, tensor) in from.variables() {
        let expected = match name.starts_with("normaliser.") {
            true => tensor,
            false => tensor.to_kind(Kind::BFloat16).to_kind(Kind::Float),
        };
        assert_eq!(read[&name], expected, "{name}");
    }
}

#[test]
fn the_error_names_a_missing_parameter() {
    let bytes = altered(|entries| drop(entries.remove("low_level.head.bias")));
    assert!(matches!(refused(&bytes), Error::Missing { name } if name == "low_level.head.bias"));
}

#[test]
fn the_error_names_an_unknown_parameter() {
    let bytes = altered(|entries| {
        let entry = entries.remove("low_level.head.bias").unwrap();
        let copy = Entry { kind: entry.kind, shape: entry.shape.clone(), bytes: entry.bytes.clone() };
        entries.insert("low_level.head.bias".into(), entry);
        entries.insert("intruder".into(), copy);
    });
    assert!(matches!(refused(&bytes), Error::Unknown { name } if name == "intruder"));
}

#[test]
fn another_shape_with_the_same_number_of_elements_is_refused() {
    let bytes = altered(|entries| entries.get_mut("low_level.layers.0.weight").unwrap().shape.reverse());
    assert!(matches!(refused(&bytes), Error::Shape { name, .. } if name == "low_level.layers.0.weight"));
}

#[test]
fn integer_parameters_are_refused() {
    let bytes = altered(|entries| entries.get_mut("low_level.head.bias").unwrap().kind = Dtype::I32);
    assert!(matches!(refused(&bytes), Error::Kind { .. }));
}

#[test]
fn infinities_and_nans_are_refused() {
    for number in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let bytes = altered(|entries| {
            entries.get_mut("low_level.head.bias").unwrap().bytes[4..8].copy_from_slice(&number.to_le_bytes());
        });
        assert!(matches!(refused(&bytes), Error::Number { .. }));
    }
}

#[test]
fn a_normaliser_with_a_standard_deviation_of_zero_is_refused() {
    let bytes = altered(|entries| entries.get_mut("normaliser.task_std").unwrap().bytes.fill(0));
    assert!(matches!(refused(&bytes), Error::Number { .. }));
}

proptest! {
    /// Every bit pattern of a finite number, so also subnormal ones and those between two.
    #[test]
    fn rounding_to_bfloat16_is_pytorchs(bits in any::<u32>()) {
        let value = f32::from_bits(bits);
        prop_assume!(value.is_finite());
        let expected = f32::try_from(Tensor::from(value).to_kind(Kind::BFloat16).to_kind(Kind::Float)).unwrap();
        let bytes = altered(|entries| {
            entries.get_mut("low_level.head.bias").unwrap().bytes[..4].copy_from_slice(&value.to_le_bytes());
        });
        let mut to = store();
        match from_safetensors(&mut to, &to_bfloat16(&bytes).unwrap()) {
            Ok(()) => {
                let found = to.variables()["low_level.head.bias"].double_value(&[0]) as f32;
                prop_assert_eq!(found.to_bits(), expected.to_bits());
            }
            Err(Error::Number { .. }) => prop_assert!(expected.is_infinite()),
            Err(error) => prop_assert!(false, "{}", error),
        }
    }

    #[test]
    fn random_bytes_are_refused_without_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        prop_assert!(from_safetensors(&mut store(), &bytes).is_err());
    }

    #[test]
    fn a_truncated_document_is_refused(cut in 1usize..1000) {
        let bytes = to_safetensors(&store()).unwrap();
        let length = bytes.len().saturating_sub(cut);
        prop_assert!(from_safetensors(&mut store(), &bytes[..length]).is_err());
    }
}
