//! `cargo xtask lint` fails where it cannot check what it promises.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::process::{Command, Output};

/// Runs lint with a cargo that has these subcommands, each of which succeeds, and no other one.
fn lint_with(subcommands: &str) -> Output {
    let directory = tempfile::tempdir().unwrap();
    let cargo = directory.path().join("cargo");
    fs::write(&cargo, format!("#!/bin/sh\ncase \" {subcommands} \" in *\" $1 \"*) exit 0;; esac\nexit 101\n")).unwrap();
    fs::set_permissions(&cargo, fs::Permissions::from_mode(0o755)).unwrap();
    Command::new(env!("CARGO_BIN_EXE_xtask")).arg("lint").env("CARGO", cargo).output().unwrap()
}

#[test]
fn without_clippy_or_rustfmt_it_fails_and_names_the_remedy() {
    for (there, missing) in [("clippy deny", "rustfmt"), ("fmt deny", "clippy"), ("deny", "clippy and rustfmt")] {
        let output = lint_with(there);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success(), "without {missing} it passes: {said}");
        assert!(said.contains(missing) && said.contains("rustup component add clippy rustfmt"), "{said}");
    }
}
