//! The compiled model against dm_control's: every array, bit for bit.

use std::path::PathBuf;

use comic_clips::WalkerModel;
use comic_tasks::humanoid;

use crate::{model_arrays, npz};

fn golden(name: &str) -> Option<PathBuf> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/golden").join(name);
    if path.is_file() {
        return Some(path);
    }
    eprintln!("skipped: {} is not there", path.display());
    None
}

fn assert_every_array_equal(model: WalkerModel, file: &str) {
    let Some(path) = golden(file) else { return };
    let ours = humanoid::build(model).unwrap();
    let arrays = npz::read(&path).unwrap();
    // Sizes first: they vouch for the lengths of the arrays.
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
    assert_every_array_equal(WalkerModel::Cmu2020, "tracking_model.npz");
}

#[test]
fn parity_of_every_array_of_the_2019_body() {
    assert_every_array_equal(WalkerModel::Cmu2019, "tracking2019_model.npz");
}
