//! Any bytes give a catalogue or an error.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::path::Path;

use comic_clips::Catalogue;
use proptest::prelude::*;
use support::{defects, tiny, whole, with_ids};

/// Opens the bytes as a file and reads everything in it.
fn read_everything(bytes: &[u8]) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hostile.h5");
    std::fs::write(&path, bytes).unwrap();
    let Ok(catalogue) = Catalogue::open(&[whole(&path)]) else {
        read_known_clips(&path);
        return;
    };
    for index in 0..catalogue.entries().len() {
        if let Ok(clip) = catalogue.load(index) {
            assert!(clip.motion.joints.iter().flatten().all(|angle| angle.is_finite()));
        }
    }
    let _ = catalogue.mean_action();
}

/// Reads clips one by one, since one damaged clip makes the whole catalogue an error.
fn read_known_clips(path: &Path) {
    for name in ["TINY_001_01", "TINY_001_02", "sound", "sound_2019"] {
        if let Ok(catalogue) = Catalogue::open(&[with_ids(path, &[name])]) {
            let _ = catalogue.load(0);
        }
    }
}

fn sound_file() -> impl Strategy<Value = Vec<u8>> {
    prop_oneof![Just(tiny()), Just(defects())].prop_map(|path| std::fs::read(path).unwrap())
}

proptest! {
    #![proptest_config(support::law())]

    #[test]
    fn changed_bytes_never_panic(
        mut bytes in sound_file(),
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..40),
    ) {
        for (place, value) in changes {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        read_everything(&bytes);
    }

    /// HDF5's metadata is clustered, so a burst of changes damages one structure in many places.
    #[test]
    fn a_burst_of_changed_bytes_never_panics(
        mut bytes in sound_file(),
        place in any::<prop::sample::Index>(),
        burst in proptest::collection::vec(prop_oneof![Just(0), Just(0xff), any::<u8>()], 1..64),
    ) {
        let place = place.index(bytes.len());
        for (byte, value) in bytes[place..].iter_mut().zip(burst) {
            *byte = value;
        }
        read_everything(&bytes);
    }

    #[test]
    fn a_cut_file_never_panics(bytes in sound_file(), length in any::<prop::sample::Index>()) {
        read_everything(&bytes[..length.index(bytes.len())]);
    }

    #[test]
    fn any_bytes_behind_the_magic_never_panic(tail in proptest::collection::vec(any::<u8>(), 0..512)) {
        read_everything(&[b"\x89HDF\r\n\x1a\n".as_slice(), &tail].concat());
    }
}
