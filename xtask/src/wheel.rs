//! `cargo xtask wheel`: the Python package as a wheel in `target/wheels`.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use crate::{python, setup, workspace};

const REQUIREMENTS: &str = "requirements-wheel.txt";
/// The wheel holds them, and maturin takes them from the package's directory alone.
const LICENCES: [&str; 3] = ["LICENSE-APACHE", "LICENSE-MIT", "NOTICE"];

/// Builds the wheel and returns its path. Its tag says the oldest libc that it runs with: the build machine decides.
pub(crate) fn build() -> Result<PathBuf> {
    build_with(&[])
}

/// The same with these variables of the environment. With `SOURCE_DATE_EPOCH` equal sources give equal bytes.
pub(crate) fn build_with(variables: &[(&str, String)]) -> Result<PathBuf> {
    let variables = || variables.iter().map(|(name, value)| (name, value));
    setup::run(&setup::Options::default())?;
    let wheels = workspace::root().join("target/wheels");
    let built = wheels.join("built");
    for directory in [&wheels, &built] {
        remove_wheels(directory)?;
    }
    for name in LICENCES {
        let copied = fs::copy(workspace::root().join(name), workspace::root().join("python").join(name));
        copied.with_context(|| format!("cannot copy {name} to python/"))?;
    }
    let mut maturin = python::tool("maturin", REQUIREMENTS)?;
    maturin.args(["build", "--release", "--locked", "--auditwheel", "skip", "--manifest-path", "python/Cargo.toml"]);
    workspace::run(maturin.arg("--out").arg(&built).envs(variables()))?;
    // libmujoco comes from the package `mujoco`.
    let mut auditwheel = python::tool("auditwheel", REQUIREMENTS)?;
    auditwheel.args(["repair", "--exclude", "libmujoco.so*", "--wheel-dir"]).arg(&wheels);
    workspace::run(auditwheel.arg(only_wheel(&built)?).envs(variables()))?;
    only_wheel(&wheels)
}

fn wheels_in(directory: &Path) -> Result<Vec<PathBuf>> {
    let entries = match fs::read_dir(directory) {
        Ok(entries) => entries,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error).with_context(|| format!("cannot read {}", directory.display())),
    };
    let paths = entries.map(|entry| Ok(entry?.path())).collect::<Result<Vec<_>>>()?;
    Ok(paths.into_iter().filter(|path| path.extension().is_some_and(|extension| extension == "whl")).collect())
}

/// A wheel of another version would be taken for the new one.
fn remove_wheels(directory: &Path) -> Result<()> {
    wheels_in(directory)?
        .iter()
        .try_for_each(|path| fs::remove_file(path).with_context(|| format!("cannot remove {}", path.display())))
}

fn only_wheel(directory: &Path) -> Result<PathBuf> {
    let mut wheels = wheels_in(directory)?;
    match (wheels.pop(), wheels.is_empty()) {
        (Some(wheel), true) => Ok(wheel),
        _ => bail!("{} should have one wheel", directory.display()),
    }
}
