//! `cargo xtask test` and `cargo xtask lint`.

use std::fs;
use std::process::Command;

use anyhow::{Result, ensure};

use crate::durations::Durations;
use crate::workspace::{answers, cargo, cargo_has, run};
use crate::{images, python, setup, wheel, workspace};

#[derive(clap::Args)]
pub(crate) struct TestOptions {
    /// Also build the images and test the containers; needs a Docker engine, and on two cores 15 minutes the first time
    #[arg(long)]
    docker: bool,
    /// Test the update on XLA instead, on the device that PJRT_DEVICE names or on a CPU; needs torch_xla
    #[arg(long, conflicts_with = "docker")]
    xla: bool,
    /// Run the long tests of the Python package instead: an algorithm learns on it, the notebooks run, trackers and Optuna
    /// follow real runs; 20 minutes
    #[arg(long, conflicts_with_all = ["docker", "xla"])]
    python_full: bool,
    /// Arguments for the test runner, for instance a part of a test's name
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<String>,
}

/// Tests that not every machine can run.
struct Demanding {
    /// The prefix of the names of these tests, and of no others.
    prefix: &'static str,
    /// What the tests do, and what they need.
    what: &'static str,
    /// Whether this machine has what they need.
    possible: bool,
}

/// Sets up and runs every test, by cargo-nextest where it is installed, otherwise by cargo itself.
pub(crate) fn test(options: &TestOptions) -> Result<()> {
    if options.xla {
        return test_xla(&options.arguments);
    }
    if options.python_full {
        return test_python(&options.arguments);
    }
    let mut durations = Durations::default();
    durations.of("set-up", || {
        setup::run(&setup::Options::default())?;
        // dm_control's own loader and TensorBoard read files of these programs, policies act in dm_control's environment,
        // and kubectl renders the manifests.
        python::prepare_tests()
    })?;
    // The whole-system tests start the programs.
    durations.of("build", workspace::build_with_tests)?;
    durations.of("wheel", || python::install_for_tests(&wheel::build()?))?;
    if options.docker {
        durations.of("images", images::build)?;
    }
    let mut command = cargo();
    let nextest = cargo_has("nextest");
    if nextest {
        command.args(["nextest", "run", "--no-fail-fast"]);
    } else {
        eprintln!("cargo-nextest is not installed: running the tests with `cargo test`");
        command.arg("test");
    }
    command.arg("--release").args(workspace::CRATES).args(&options.arguments);
    let mut left_out = demanding(options);
    left_out.retain(|tests| !tests.possible);
    for Demanding { prefix, what, .. } in &left_out {
        eprintln!("NOT RUN: the tests {prefix}…, which {what}");
    }
    if nextest && !left_out.is_empty() {
        let names: Vec<_> = left_out.iter().map(|tests| format!("not test(/(^|::){}/)", tests.prefix)).collect();
        command.args(["--filterset", &names.join(" and ")]);
    } else if !left_out.is_empty() {
        command.arg("--").args(left_out.iter().map(|tests| format!("--skip={}", tests.prefix)));
    }
    eprintln!("running `{}`", workspace::describe(&command));
    let report = workspace::root().join("target/nextest/default/junit.xml");
    let _ = fs::remove_file(&report);
    let ended = durations.of("tests", || run(&mut command));
    if let Ok(report) = fs::read_to_string(report) {
        durations.read_tests(&report);
    }
    eprint!("{durations}");
    if !left_out.is_empty() {
        let names: Vec<_> = left_out.iter().map(|tests| tests.prefix).collect();
        eprintln!("NOT RUN: {} groups of tests ({}), as explained above", names.len(), names.join(", "));
    }
    ended
}

/// The tests of devices, of the learner's modules and of its program, built with XLA in a directory of their own.
fn test_xla(arguments: &[String]) -> Result<()> {
    setup::run(&setup::Options::xla())?;
    let mut command = cargo();
    match cargo_has("nextest") {
        true => command.args(["nextest", "run", "--no-fail-fast"]),
        false => command.arg("test"),
    };
    command.args(["--release", "--package", "comic-learner", "--features", "xla", "--target-dir", "target/xla"]);
    command.args(["--lib", "--test", "devices", "--test", "xla"]).args(arguments);
    // Under `cargo test` the tests are threads of one process, and the end of a step is the end of every thread's step.
    command.env("RUST_TEST_THREADS", "1");
    if std::env::var_os("PJRT_DEVICE").is_none() {
        command.env("PJRT_DEVICE", "CPU");
    }
    eprintln!("running `{}`", workspace::describe(&command));
    run(&mut command)
}

/// The long tests of the Python package.
fn test_python(arguments: &[String]) -> Result<()> {
    setup::run(&setup::Options::default())?;
    workspace::build(&workspace::PROGRAMS)?;
    python::install(&wheel::build()?, python::FULL)?;
    let mut pytest = python::tool("pytest", python::FULL)?;
    // Beside python/comic, which has no native module.
    pytest
        .args(["-m", "full", "--capture", "no", "."])
        .args(arguments)
        .current_dir(workspace::root().join("python/tests"));
    run(pytest.env("COMIC_BIN", workspace::program("comic-learner")?.with_file_name("")))
}

fn demanding(options: &TestOptions) -> Vec<Demanding> {
    vec![
        Demanding {
            prefix: "a_network_that_",
            what: "cut networks: they need root and iproute2",
            possible: can_make_namespaces(),
        },
        Demanding {
            prefix: "opengl_",
            what: "draw pictures: they need OpenGL, for instance Debian's libegl1 and libgl1-mesa-dri",
            possible: can_draw(),
        },
        Demanding {
            prefix: "on_a_full_disk_",
            what: "fill a disk of their own: they need root and util-linux",
            // A mount that this process alone sees.
            possible: answers("unshare", &["--mount", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]),
        },
        Demanding {
            prefix: "promtool_",
            what: "evaluate the alert rules: they need promtool, for instance Debian's package prometheus",
            possible: answers("promtool", &["--version"]),
        },
        Demanding {
            prefix: "containers_",
            what: "run the images: they need `cargo xtask test --docker`",
            possible: options.docker,
        },
    ]
}

/// Whether the actor finds OpenGL. The tests report every other error.
fn can_draw() -> bool {
    let film = std::env::temp_dir().join(format!("comic-probe-{}.gif", std::process::id()));
    let Ok(actor) = workspace::program("comic-actor") else { return true };
    let arguments = ["render", "--task", "get-up", "--seconds", "0.03", "--size", "16x16", "--out"];
    let asked = Command::new(actor).args(arguments).arg(&film).output();
    let _ = fs::remove_file(film);
    !asked.is_ok_and(|output| String::from_utf8_lossy(&output.stderr).contains("no OpenGL"))
}

/// Whether this machine allows network namespaces.
fn can_make_namespaces() -> bool {
    let name = format!("comic-probe-{}", std::process::id());
    answers("ip", &["netns", "add", &name]) && answers("ip", &["netns", "delete", &name])
}

/// Checks formatting and code, and, where cargo-deny is installed, the licences and sources of dependencies.
///
/// # Errors
/// What the tools find, and a toolchain without clippy or rustfmt: what was not checked must not pass.
pub(crate) fn lint() -> Result<()> {
    // By the names of the subcommand and of rustup's component.
    let mut missing = vec![("clippy", "clippy"), ("fmt", "rustfmt")];
    missing.retain(|(subcommand, _)| !cargo_has(subcommand));
    let missing: Vec<_> = missing.into_iter().map(|(_, component)| component).collect();
    ensure!(missing.is_empty(), "lint needs {}: `rustup component add clippy rustfmt`", missing.join(" and "));
    setup::run(&setup::Options::default())?;
    run(cargo().args(["fmt", "--all", "--check"]))?;
    run(cargo().args(["clippy", "--release", "--workspace", "--all-targets", "--", "--deny", "warnings"]))?;
    if cargo_has("deny") {
        run(cargo().args(["deny", "check", "licenses", "bans", "sources"]))?;
    } else {
        eprintln!("NOT RUN: the check of licences, of banned crates and of sources: `cargo install cargo-deny`");
    }
    Ok(())
}
