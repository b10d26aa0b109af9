//! Where the fixtures are.
#![allow(dead_code, reason = "no test uses all of it")]
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot go on fails")]

use std::path::{Path, PathBuf};

use comic_clips::import::{Constants, Floor, Take};
use comic_clips::{Catalogue, Error};
use comic_experiment::ClipSource;

/// A failing case is printed, not kept in a file.
pub(crate) fn law() -> proptest::test_runner::Config {
    proptest::test_runner::Config { failure_persistence: None, ..Default::default() }
}

pub(crate) fn tiny() -> String {
    fixture("tiny.h5")
}

/// A recording of the CMU database beside these tests: a run of subject 2.
pub(crate) fn run_take() -> Take {
    let file = |name: &str| path(["tests", "data", "cmu", name]);
    let constants =
        Constants { sole_degrees: Some([13.5, 12.0]), floor: Some(Floor::DRIFTING), ..Constants::default() };
    Take { name: "CMU_002_03".into(), asf: file("02.asf"), amc: file("02_03.amc"), constants }
}

pub(crate) fn defects() -> String {
    fixture("defects.h5")
}

fn fixture(name: &str) -> String {
    path(["tests", "data", name]).display().to_string()
}

/// A file of the folder that lies beside the repository on the machines this was developed on; `None`, saying so,
/// where it does not.
pub(crate) fn shared(file: &str) -> Option<PathBuf> {
    optional(path(["..", "..", "shared", file]))
}

/// The wheel's own test clips, there after `cargo xtask setup`.
pub(crate) fn wheel_clips() -> Option<PathBuf> {
    optional(path(["..", ".deps", "dm_control", "test_trajectories.h5"]))
}

fn path<const N: usize>(parts: [&str; N]) -> PathBuf {
    std::iter::once(env!("CARGO_MANIFEST_DIR")).chain(parts).collect()
}

fn optional(path: PathBuf) -> Option<PathBuf> {
    if path.exists() {
        return Some(path);
    }
    eprintln!("skipped: {} is not here", path.display());
    None
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

/// What opening says.
pub(crate) fn refused(source: ClipSource) -> String {
    Catalogue::open(&[source]).expect_err("must be refused").to_string()
}

/// What opening and loading one clip says.
pub(crate) fn load_one(file: &str, name: &str) -> Result<comic_clips::Clip, Error> {
    Catalogue::open(&[with_ids(file, &[name])])?.load(0)
}
