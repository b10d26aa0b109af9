//! Runs other people's Python code for comparison, in virtual environments in `.deps/python`. Each is made when it is
//! needed first.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};

use crate::workspace;

#[derive(clap::Args)]
pub(crate) struct FixtureOptions {
    /// Seed of the scripts' random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write below this directory instead of tests/fixtures
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// The scripts that make fixtures: the script and its requirements in `tests/python`, and the directory in
/// `tests/fixtures`.
const FIXTURES: [(&str, &str, &str); 5] = [
    ("make_tracking_fixtures.py", "requirements-tracking.txt", "golden"),
    ("make_task_fixtures.py", "requirements-tracking.txt", "golden"),
    ("make_vmpo_fixtures.py", "requirements-vmpo.txt", "vmpo"),
    ("make_distribution_fixtures.py", "requirements-vmpo.txt", "vmpo"),
    ("make_svg0_fixtures.py", "requirements-vmpo.txt", "svg0"),
];

/// Makes the tests' fixtures again.
pub(crate) fn fixtures(options: &FixtureOptions) -> Result<()> {
    let tests = workspace::root().join("tests");
    for (script, requirements, name) in FIXTURES {
        let out = options.out.clone().unwrap_or_else(|| tests.join("fixtures")).join(name);
        let out = std::path::absolute(&out).with_context(|| format!("no such path: {}", out.display()))?;
        let mut command = script_command(script, requirements)?;
        workspace::run(command.arg("--seed").arg(options.seed.to_string()).arg("--out").arg(out))?;
    }
    Ok(())
}

/// The environment of the tests, which also gets the wheel of our own package.
pub(crate) const TESTS: &str = "requirements-tests.txt";

/// The packages of the long tests of our package, beside those of [`TESTS`].
pub(crate) const FULL: &str = "requirements-full.txt";

/// Makes the environments in which tests run dm_control, torch and TensorBoard, and kubectl. Takes less than a second if
/// they exist.
pub(crate) fn prepare_tests() -> Result<()> {
    [TESTS, "requirements-kubectl.txt"].iter().try_for_each(|name| python_of(name).map(drop))
}

/// Installs a wheel in the environment of the tests. Its dependencies are there.
pub(crate) fn install_for_tests(wheel: &Path) -> Result<()> {
    install(wheel, TESTS)
}

/// Installs a wheel in an environment that has its dependencies.
pub(crate) fn install(wheel: &Path, requirements: &str) -> Result<()> {
    let mut pip = Command::new(python_of(requirements)?);
    pip.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--force-reinstall"]);
    workspace::run(pip.arg(wheel))
}

/// A program of the environment for `tests/python/REQUIREMENTS`, which also finds the others.
pub(crate) fn tool(name: &str, requirements: &str) -> Result<Command> {
    let programs = python_of(requirements)?.with_file_name("");
    let mut command = Command::new(programs.join(name));
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths([programs].into_iter().chain(std::env::split_paths(&path)))?;
    command.env("PATH", path).current_dir(workspace::root());
    Ok(command)
}

/// The Python of the environment for `tests/python/REQUIREMENTS`. It is made if it does not exist or has other requirements.
fn python_of(requirements: &str) -> Result<PathBuf> {
    let files: &[&str] = if requirements == FULL { &[TESTS, FULL] } else { &[requirements] };
    let mut wanted = String::new();
    for name in files {
        let path = workspace::root().join("tests/python").join(name);
        wanted += &fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    }
    let name = Path::new(requirements).file_stem().unwrap_or_default();
    environment(&workspace::dependencies().join("python").join(name), &wanted)
}

/// A command that runs `tests/python/SCRIPT` with the packages of `tests/python/REQUIREMENTS`.
pub(crate) fn script_command(script: &str, requirements: &str) -> Result<Command> {
    let script = workspace::root().join("tests/python").join(script);
    if !script.exists() {
        bail!("{} does not exist", script.display());
    }
    let mut command = Command::new(python_of(requirements)?);
    command.arg(script).current_dir(workspace::root());
    Ok(command)
}

/// The Python of the environment in `directory` with the packages `wanted`.
fn environment(directory: &Path, wanted: &str) -> Result<PathBuf> {
    let python = directory.join("bin/python");
    let stamp = directory.join("requirements.txt");
    if fs::read_to_string(&stamp).is_ok_and(|made| made == wanted) {
        return Ok(python);
    }
    eprintln!("making a Python environment in {}", directory.display());
    let _ = fs::remove_dir_all(directory);
    let made = workspace::run(Command::new("python3").args(["-m", "venv"]).arg(directory));
    made.context("python3 cannot make environments (Debian and Ubuntu: apt install python3-venv)")?;
    install_packages(&python, directory, wanted)?;
    fs::write(&stamp, wanted).with_context(|| format!("cannot write {}", stamp.display()))?;
    Ok(python)
}

/// Installs the packages. PyPI's only wheel of torch for Linux is the one for CUDA. It is installed without the gigabytes
/// of NVIDIA's libraries, and `tests/python/bare_torch.py` makes it importable.
fn install_packages(python: &Path, directory: &Path, requirements: &str) -> Result<()> {
    let pip = |arguments: &[&str]| {
        let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
        workspace::run(Command::new(python).args(pip).args(arguments))
    };
    let needs_torch = |line: &&str| line.starts_with("stable_baselines3==");
    let (torch, others): (Vec<&str>, Vec<&str>) = requirements.lines().partition(|line| line.starts_with("torch=="));
    let (upon_torch, others): (Vec<&str>, Vec<&str>) = others.into_iter().partition(needs_torch);
    let list = directory.join("others.txt");
    fs::write(&list, others.join("\n")).with_context(|| format!("cannot write {}", list.display()))?;
    pip(&["--requirement", &list.to_string_lossy()])?;
    let [torch] = torch[..] else { return Ok(()) };
    let nvidia = ["nvidia-cuda-runtime-cu12==12.8.90", "nvidia-cuda-cupti-cu12==12.8.90"];
    pip(&[&["--no-deps", torch], &nvidia[..], &upon_torch].concat())?;
    pip(&["filelock", "typing_extensions", "sympy", "networkx", "jinja2", "fsspec"])?;
    workspace::run(Command::new(python).arg(workspace::root().join("tests/python/bare_torch.py")))
}
