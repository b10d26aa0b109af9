//! Finds the fixtures, and opens them.
#![allow(dead_code, reason = "no test uses all of it")]
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

pub(crate) mod bvh;
pub(crate) mod humanoid;

use std::path::{Path, PathBuf};

use comic_clips::import::{Constants, Floor, Take};
use comic_clips::retarget::Recorded;
use comic_clips::spatial::{Quaternion, Vector, add, multiply, rotated};
use comic_clips::{Catalogue, Error};
use comic_experiment::ClipSource;

/// Settings of every property test: a failing case is printed, not kept in a file.
pub(crate) fn law() -> proptest::test_runner::Config {
    proptest::test_runner::Config { failure_persistence: None, ..Default::default() }
}

pub(crate) fn tiny() -> String {
    fixture("tiny.h5")
}

/// A recording of the CMU database: a run of subject 2.
pub(crate) fn run_take() -> Take {
    let constants =
        Constants { sole_degrees: Some([13.5, 12.0]), floor: Some(Floor::DRIFTING), ..Constants::default() };
    Take { name: "CMU_002_03".into(), asf: recordings("02.asf"), amc: recordings("02_03.amc"), constants }
}

pub(crate) fn defects() -> String {
    fixture("defects.h5")
}

fn fixture(name: &str) -> String {
    path(["tests", "data", name]).display().to_string()
}

/// A file beside the recordings, for instance `clips.h5`: the clips that MuJoCo and dm_control made of them.
pub(crate) fn recordings(name: &str) -> PathBuf {
    path(["tests", "data", "cmu", name])
}

/// Numbers that dm_control computed.
pub(crate) fn golden(name: &str) -> PathBuf {
    path(["..", "tests", "fixtures", "golden", name])
}

/// dm_control's own test clips, from its wheel.
pub(crate) fn wheel_clips() -> PathBuf {
    let workspace = path([".."]);
    let folder = std::env::var_os("COMIC_DM_CONTROL_DIR").unwrap_or_else(|| ".deps/dm_control".into());
    let file = workspace.join(folder).join("test_trajectories.h5");
    assert!(file.is_file(), "no file {}; run `cargo xtask setup`", file.display());
    file
}

fn path<const N: usize>(parts: [&str; N]) -> PathBuf {
    std::iter::once(env!("CARGO_MANIFEST_DIR")).chain(parts).collect()
}

pub(crate) fn whole(source: impl AsRef<Path>) -> ClipSource {
    ClipSource::whole(source.as_ref().display().to_string())
}

pub(crate) fn with_ids(source: impl AsRef<Path>, ids: &[&str]) -> ClipSource {
    ClipSource { ids: ids.iter().map(|id| id.to_string()).collect(), ..whole(source) }
}

pub(crate) fn names(catalogue: &Catalogue) -> Vec<&str> {
    catalogue.entries().iter().map(|entry| entry.name.as_str()).collect()
}

/// The message of the error that opening gives.
pub(crate) fn refused(source: ClipSource) -> String {
    Catalogue::open(&[source]).expect_err("must be refused").to_string()
}

/// Opens a file and loads one clip.
pub(crate) fn load_one(file: &str, name: &str) -> Result<comic_clips::Clip, Error> {
    Catalogue::open(&[with_ids(file, &[name])])?.load(0)
}

/// The places of all joints of a recording in the world, in its unit.
pub(crate) fn places(recorded: &Recorded, frame: usize) -> Vec<Vector> {
    let pose = &recorded.frames[frame];
    let mut placed: Vec<(Vector, Quaternion)> = Vec::new();
    for (bone, rotation) in recorded.bones.iter().zip(&pose.rotations) {
        placed.push(match bone.parent {
            None => (pose.position, *rotation),
            Some(parent) => {
                let (place, outer) = placed[parent];
                (add(place, rotated(outer, bone.offset)), multiply(outer, *rotation))
            }
        });
    }
    placed.into_iter().map(|(place, _)| place).collect()
}
