//! Compares every array of the compiled models with dm_control's, bit for bit.

use std::path::Path;

use comic_clips::WalkerModel;
use comic_tasks::{comparison, humanoid};
use mujoco_rs::prelude::MjModel;

use crate::recording::models;
use crate::rules::RecordedArena;
use crate::{model_arrays, npz};

fn assert_every_array_equal(build: impl FnOnce(&Path) -> MjModel, file: &str) {
    let path = models().join(file);
    let ours = build(&path);
    let arrays = npz::read(&path).unwrap();
    // The sizes come first: the lengths of the arrays follow from them.
    let (sizes, rest): (Vec<_>, Vec<_>) = arrays.iter().partition(|(_, array)| array.shape.is_empty());
    let mut different = Vec::new();
    for group in [sizes, rest] {
        for (name, array) in group {
            let expected = array.numbers().unwrap();
            // SAFETY: the sizes have been compared, so dm_control's array is as long as ours.
            #[allow(unsafe_code)]
            let found = unsafe { model_arrays::values(ours.ffi(), name, expected.len()) }
                .unwrap_or_else(|| panic!("{name}: not in the table"));
            let same = expected.iter().zip(&found).all(|(a, b)| a == b || (a.is_nan() && b.is_nan()));
            if !same {
                let pairs = expected.iter().zip(&found).enumerate().filter(|(_, (a, b))| a != b);
                different.push(format!("{name}: {:?}", pairs.take(4).collect::<Vec<_>>()));
            }
        }
        assert!(different.is_empty(), "{file}: {} arrays differ\n{}", different.len(), different.join("\n"));
    }
}

#[test]
fn parity_of_every_array_of_the_2020_body() {
    assert_every_array_equal(|_| humanoid::build(WalkerModel::Cmu2020).unwrap(), "tracking_model.npz");
}

#[test]
fn parity_of_every_array_of_the_2019_body() {
    assert_every_array_equal(|_| humanoid::build(WalkerModel::Cmu2019).unwrap(), "tracking2019_model.npz");
}

#[test]
fn parity_of_every_array_of_go_to_target() {
    assert_every_array_equal(|_| comparison::go_to_target_model().unwrap(), "go_to_target_model.npz");
}

fn corridor(model: &Path) -> MjModel {
    let name = model.file_name().unwrap().to_string_lossy().replace("_model.npz", "_arena.json");
    let recorded = RecordedArena::read(&model.with_file_name(name)).unwrap();
    comparison::corridor_model(recorded.length, recorded.width, &recorded.platforms, &recorded.walls).unwrap()
}

#[test]
fn parity_of_every_array_of_the_gaps() {
    assert_every_array_equal(corridor, "gaps_model.npz");
}

#[test]
fn parity_of_every_array_of_the_walls() {
    assert_every_array_equal(corridor, "walls_model.npz");
}
