//! `cargo xtask dist` refuses what could not become a release before it builds anything.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// Runs it for a repository with this changelog. Its cargo fails.
fn dist(repository: &Path, changelog: &str, variables: &[(&str, &str)]) -> Output {
    fs::write(repository.join("CHANGELOG.md"), changelog).unwrap();
    let mut dist = Command::new(env!("CARGO_BIN_EXE_xtask"));
    dist.arg("dist").env("CARGO_MANIFEST_DIR", repository.join("xtask")).env("CARGO", "false");
    dist.env("SOURCE_DATE_EPOCH", "1700000000").env_remove("LIBTORCH").env_remove("MUJOCO_DYNAMIC_LINK_DIR");
    dist.envs(variables.iter().copied()).output().unwrap()
}

fn error(output: &Output) -> String {
    assert!(!output.status.success());
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_version_that_the_changelog_does_not_describe_is_refused() {
    let repository = tempfile::tempdir().unwrap();
    let error = error(&dist(repository.path(), "# Changelog\n\n## [Unreleased]\n\n- new\n", &[]));
    let version = env!("CARGO_PKG_VERSION");
    assert!(error.contains(&format!("CHANGELOG.md has no section for {version}")), "{error}");
    assert!(!repository.path().join("target").exists(), "it began to write the release");
}

#[test]
fn a_libtorch_of_ones_own_is_refused() {
    let repository = tempfile::tempdir().unwrap();
    let changelog = format!("## {} - 2026-01-01\n\n- new\n", env!("CARGO_PKG_VERSION"));
    let error = error(&dist(repository.path(), &changelog, &[("LIBTORCH", "/opt/libtorch")]));
    assert!(error.contains("unset LIBTORCH"), "{error}");
    assert!(!repository.path().join(".deps").exists(), "it set up libraries");
}

#[test]
fn libraries_without_their_licences_are_refused_before_anything_is_built() {
    let repository = tempfile::tempdir().unwrap();
    fs::create_dir_all(repository.path().join(".deps/stamps")).unwrap();
    // A directory without a text is none.
    fs::create_dir_all(repository.path().join(".deps/licences/torch")).unwrap();
    let changelog = format!("## {} - 2026-01-01\n\n- new\n", env!("CARGO_PKG_VERSION"));
    let error = error(&dist(repository.path(), &changelog, &[]));
    assert!(error.contains(".deps/licences/torch with a licence is missing"), "{error}");
    assert!(error.contains("remove .deps/stamps"), "{error}");
    assert!(!repository.path().join("target").exists(), "it began to write the release");
}

#[test]
fn a_time_of_the_release_that_is_no_number_is_refused() {
    let repository = tempfile::tempdir().unwrap();
    let changelog = format!("## {} - 2026-01-01\n\n- new\n", env!("CARGO_PKG_VERSION"));
    let error = error(&dist(repository.path(), &changelog, &[("SOURCE_DATE_EPOCH", "yesterday")]));
    assert!(error.contains("SOURCE_DATE_EPOCH=yesterday"), "{error}");
}
