//! Files of motion capture: dm_control's HDF5, or the CMU database's text. The text is a skeleton and a recording, separated
//! by a zero byte.

#![no_main]

use std::cell::RefCell;
use std::fs;
use std::path::Path;

use comic_clips::import::{Constants, Take, import};
use comic_clips::{Catalogue, check};
use comic_experiment::ClipSource;
use comic_fuzz::seed;
use libfuzzer_sys::fuzz_target;
use tempfile::TempDir;

const HDF5: &[u8] = b"\x89HDF";

thread_local! {
    static DIRECTORY: RefCell<TempDir> = RefCell::new(tempfile::tempdir().expect("a temporary directory"));
}

fuzz_target!(init: {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../clips/tests/data");
    let file = |name: &str| fs::read(data.join(name)).expect("a fixture of the crate comic-clips");
    for name in ["tiny.h5", "defects.h5"] {
        seed(name, &file(name));
    }
    // A few frames are enough, since all frames are read in the same way.
    let recording = file("cmu/02_03.amc");
    seed("take", &[&file("cmu/02.asf")[..], &[0], &recording[..recording.len().min(20_000)]].concat());
}, |bytes: &[u8]| {
    DIRECTORY.with_borrow(|directory| match bytes.iter().position(|byte| *byte == 0) {
        _ if bytes.starts_with(HDF5) => hdf5(directory.path(), bytes),
        Some(end) => text(directory.path(), &bytes[..end], &bytes[end + 1..]),
        None => {}
    });
});

fn hdf5(directory: &Path, bytes: &[u8]) {
    let path = directory.join("clips.h5");
    fs::write(&path, bytes).expect("space on the disk");
    let _ = check::check(&path, &[]);
    let Ok(catalogue) = Catalogue::open(&[ClipSource::whole(path.display().to_string())]) else { return };
    for index in 0..catalogue.entries().len() {
        if let Ok(clip) = catalogue.load(index) {
            assert!(clip.motion.joints.iter().flatten().all(|angle| angle.is_finite()));
        }
    }
    let _ = catalogue.mean_action();
}

fn text(directory: &Path, skeleton: &[u8], recording: &[u8]) {
    let (asf, amc) = (directory.join("take.asf"), directory.join("take.amc"));
    fs::write(&asf, skeleton).expect("space on the disk");
    fs::write(&amc, recording).expect("space on the disk");
    let take = Take { name: "take".into(), asf, amc, constants: Constants::default() };
    if let Ok((clip, _)) = import(&take) {
        assert!(clip.motion.joints_velocity.iter().flatten().all(|speed| speed.is_finite()));
    }
}
