//! `cargo xtask test` and `cargo xtask lint`.

use std::process::{Command, Stdio};

use anyhow::Result;

use crate::workspace::{cargo, cargo_has, run};
use crate::{images, python, setup, workspace};

#[derive(clap::Args)]
pub(crate) struct TestOptions {
    /// Build the images and test the containers, too; that takes a Docker engine, and on two cores a quarter of an hour the first time
    #[arg(long)]
    docker: bool,
    /// Test the update on XLA instead, on what PJRT_DEVICE names or a CPU: torch_xla, and the learner built with it
    #[arg(long, conflicts_with = "docker")]
    xla: bool,
    /// Arguments for the test runner, for instance a part of a test's name
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<String>,
}

/// Tests that not every machine can run.
struct Demanding {
    /// The prefix of the names of these tests, and of no others.
    prefix: &'static str,
    /// What they do, and what that needs.
    what: &'static str,
    /// Whether this machine has it.
    possible: bool,
}

/// Sets up and runs every test: by cargo-nextest where it is installed, else by cargo itself.
pub(crate) fn test(options: &TestOptions) -> Result<()> {
    if options.xla {
        return test_xla(&options.arguments);
    }
    setup::run(&setup::Options::default())?;
    // Files written here are read by dm_control's own loader and by TensorBoard, and policies act in dm_control's environment.
    python::prepare_tests()?;
    // The whole-system tests start the programs, so these are built first.
    workspace::build()?;
    if options.docker {
        images::build()?;
    }
    let mut command = cargo();
    let nextest = cargo_has("nextest");
    if nextest {
        command.args(["nextest", "run", "--no-fail-fast"]);
    } else {
        eprintln!("cargo-nextest is not installed: running the tests with `cargo test`");
        command.arg("test");
    }
    command.args(["--release", "--workspace"]).args(&options.arguments);
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
    run(&mut command)
}

/// The tests of devices, of the learner's parts, and of its program with XLA in it. Built beside everything else, which has
/// none.
fn test_xla(arguments: &[String]) -> Result<()> {
    setup::run(&setup::Options::xla())?;
    let mut command = cargo();
    match cargo_has("nextest") {
        true => command.args(["nextest", "run", "--no-fail-fast"]),
        false => command.arg("test"),
    };
    command.args(["--release", "--package", "comic-learner", "--features", "xla", "--target-dir", "target/xla"]);
    command.args(["--lib", "--test", "devices", "--test", "xla"]).args(arguments);
    // Where tests are threads of one process, a step's end is every test's.
    command.env("RUST_TEST_THREADS", "1");
    if std::env::var_os("PJRT_DEVICE").is_none() {
        command.env("PJRT_DEVICE", "CPU");
    }
    eprintln!("running `{}`", workspace::describe(&command));
    run(&mut command)
}

fn demanding(options: &TestOptions) -> Vec<Demanding> {
    vec![
        Demanding {
            prefix: "a_network_that_",
            what: "cut networks: that takes root and iproute2",
            possible: makes_hosts(),
        },
        Demanding {
            prefix: "opengl_",
            what: "draw: that takes OpenGL, for instance Debian's libegl1 and libgl1-mesa-dri",
            possible: draws(),
        },
        Demanding {
            prefix: "on_a_full_disk_",
            what: "fill a disk of its own: that takes root and util-linux",
            // A disk that this process alone sees.
            possible: answers("unshare", &["--mount", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]),
        },
        Demanding {
            prefix: "containers_",
            what: "run the images: that takes `cargo xtask test --docker`",
            possible: options.docker,
        },
        Demanding {
            prefix: "kustomize_",
            what: "render the Kubernetes manifests a second time: that takes kustomize or kubectl",
            possible: answers("kustomize", &["version"]) || answers("kubectl", &["version", "--client"]),
        },
    ]
}

fn answers(program: &str, arguments: &[&str]) -> bool {
    let asked = Command::new(program).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).status();
    asked.is_ok_and(|status| status.success())
}

/// Whether the actor finds OpenGL. Any other error is for the tests to report.
fn draws() -> bool {
    let film = std::env::temp_dir().join(format!("comic-probe-{}.gif", std::process::id()));
    let Ok(actor) = workspace::program("comic-actor") else { return true };
    let arguments = ["render", "--task", "get-up", "--seconds", "0.03", "--size", "16x16", "--out"];
    let asked = Command::new(actor).args(arguments).arg(&film).output();
    let _ = std::fs::remove_file(film);
    !asked.is_ok_and(|output| String::from_utf8_lossy(&output.stderr).contains("no OpenGL"))
}

/// Whether network namespaces can be made here.
fn makes_hosts() -> bool {
    let name = format!("comic-probe-{}", std::process::id());
    answers("ip", &["netns", "add", &name]) && answers("ip", &["netns", "delete", &name])
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
