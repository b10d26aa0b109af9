//! Paths in this repository, and how cargo and other programs are started.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};

/// The repository's root.
pub(crate) fn root() -> PathBuf {
    // Cargo sets the variable when it starts this program. A copied program knows only the path at compile time.
    let package =
        std::env::var_os("CARGO_MANIFEST_DIR").map_or_else(|| env!("CARGO_MANIFEST_DIR").into(), PathBuf::from);
    package.parent().map_or_else(|| PathBuf::from("."), Path::to_path_buf)
}

/// The directory that set-up fills.
pub(crate) fn dependencies() -> PathBuf {
    root().join(".deps")
}

/// The cargo that runs this program, with the environment that a shell gives it: ring's build script depends on variables that
/// cargo sets for this program, so `cargo build` and `cargo xtask test` in turn would each build half of the workspace again.
pub(crate) fn cargo() -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if text.starts_with("CARGO_PKG_") || text.starts_with("CARGO_MANIFEST_") {
            command.env_remove(name);
        }
    }
    command.current_dir(root());
    command
}

/// Whether cargo has the subcommand `name`.
pub(crate) fn cargo_has(name: &str) -> bool {
    cargo().args([name, "--version"]).output().is_ok_and(|output| output.status.success())
}

/// Whether `program` can be started with these arguments and ends well. Its output is discarded.
pub(crate) fn answers(program: &str, arguments: &[&str]) -> bool {
    let status = Command::new(program).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).status();
    status.is_ok_and(|status| status.success())
}

/// Runs `command` to its end with this program's own input and output.
pub(crate) fn run(command: &mut Command) -> Result<()> {
    let status = command.status().with_context(|| format!("cannot start {}", describe(command)))?;
    if !status.success() {
        bail!("{} ended with {status}", describe(command));
    }
    Ok(())
}

/// A command as a person would type it.
pub(crate) fn describe(command: &Command) -> String {
    let program = Path::new(command.get_program()).file_name().unwrap_or(command.get_program());
    std::iter::once(program).chain(command.get_args()).map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ")
}

/// The crates that are built and tested together. The Python package is not among them: [`crate::wheel`] builds it, and without
/// maturin its linker would look for a libpython, which not every Python has.
pub(crate) const CRATES: [&str; 3] = ["--workspace", "--exclude", "comic-python"];

/// The packages of the programs that train and evaluate.
pub(crate) const PROGRAMS: [&str; 2] = ["comic-learner", "comic-actor"];
/// The packages of the benchmarks, which start `comic-learner` for its certificates.
pub(crate) const BENCHMARKS: [&str; 2] = ["comic-bench", "comic-learner"];

/// Builds the programs of these packages in the release profile, and nothing else.
pub(crate) fn build(packages: &[&str]) -> Result<()> {
    let packages = packages.iter().flat_map(|package| ["--package", package]);
    run(cargo().args(["build", "--release", "--bins"]).args(packages))
}

/// Builds every program and every test at once. The tests' dependencies add features to shared crates, so a build of the
/// programs alone would compile our crates a second time.
pub(crate) fn build_with_tests() -> Result<()> {
    run(cargo().args(["build", "--release", "--bins", "--tests"]).args(CRATES))
}

/// The path of a program in the release profile. This program's profile is another one, beside it.
pub(crate) fn program(name: &str) -> Result<PathBuf> {
    let own = std::env::current_exe().context("cannot find the path of this program")?;
    let target = own.ancestors().nth(2).with_context(|| format!("{} lies in no target directory", own.display()))?;
    Ok(target.join("release").join(format!("{name}{}", std::env::consts::EXE_SUFFIX)))
}
