//! `cargo xtask test` and `cargo xtask lint`.

use std::process::{Command, Stdio};

use anyhow::Result;

use crate::workspace::{cargo, cargo_has, run};
use crate::{python, setup, workspace};

#[derive(clap::Args)]
pub(crate) struct TestOptions {
    /// Arguments for the test runner, for instance a part of a test's name
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<String>,
}

/// Sets up and runs every test: by cargo-nextest where it is installed, else by cargo itself.
pub(crate) fn test(options: &TestOptions) -> Result<()> {
    setup::run(&setup::Options::default())?;
    // Files written here are read by dm_control's own loader, and policies act in its own environment.
    python::prepare_tests()?;
    // The whole-system tests start the programs, so these are built first.
    workspace::build()?;
    let mut command = cargo();
    let nextest = cargo_has("nextest");
    if nextest {
        command.args(["nextest", "run", "--no-fail-fast"]);
    } else {
        eprintln!("cargo-nextest is not installed: running the tests with `cargo test`");
        command.arg("test");
    }
    command.args(["--release", "--workspace"]).args(&options.arguments);
    if !makes_hosts() {
        eprintln!("NOT RUN: tests/tests/partition.rs, which cuts networks: that takes root and iproute2");
        command.args(if nextest { ["--filterset", "not binary(partition)"] } else { ["--", "--skip=a_network_that"] });
    }
    eprintln!("running `{}`", workspace::describe(&command));
    run(&mut command)
}

/// Whether network namespaces can be made here.
fn makes_hosts() -> bool {
    let name = format!("comic-probe-{}", std::process::id());
    let ip = |action| Command::new("ip").args(["netns", action, &name]).stderr(Stdio::null()).status();
    ip("add").is_ok_and(|made| made.success()) && ip("delete").is_ok_and(|gone| gone.success())
}

/// Formatting and clippy, as far as the toolchain has them.
pub(crate) fn lint() -> Result<()> {
    setup::run(&setup::Options::default())?;
    if cargo_has("fmt") {
        run(cargo().args(["fmt", "--all", "--check"]))?;
    } else {
        eprintln!("formatting is not checked: `rustup component add rustfmt`");
    }
    if cargo_has("clippy") {
        run(cargo().args(["clippy", "--release", "--workspace", "--all-targets", "--", "--deny", "warnings"]))?;
    } else {
        eprintln!("clippy is not run: `rustup component add clippy`");
    }
    Ok(())
}
