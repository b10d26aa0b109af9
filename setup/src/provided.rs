//! Libraries that the user provides, named by LIBTORCH, MUJOCO_DYNAMIC_LINK_DIR or COMIC_DM_CONTROL_DIR.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

use crate::wheel::Part;

/// The directory that the user provides for `part`, checked. `None` when set-up must provide it.
///
/// `.cargo/config.toml` sets the same variables to paths inside `dependencies` unless they are set. So only a path outside
/// it is the user's.
pub(crate) fn directory(
    part: Part,
    dependencies: &Path,
    variable: impl Fn(&str) -> Option<PathBuf>,
) -> Result<Option<PathBuf>> {
    let name = match part {
        Part::Mujoco => "MUJOCO_DYNAMIC_LINK_DIR",
        Part::Libtorch => "LIBTORCH",
        Part::DmControl => "COMIC_DM_CONTROL_DIR",
        // Only the pinned torch_xla was built for the pinned libtorch.
        Part::Python => return Ok(None),
    };
    let Some(directory) = variable(name).filter(|directory| !directory.as_os_str().is_empty()) else { return Ok(None) };
    if absolute(&directory).starts_with(absolute(dependencies)) {
        return Ok(None);
    }
    if let Err(problem) = match part {
        Part::Mujoco => check_mujoco(&directory),
        Part::Libtorch => check_libtorch(&directory),
        // The compiler would look for it from another directory.
        Part::DmControl if directory.is_relative() => Err("it must be an absolute path".into()),
        Part::DmControl => require(&directory, &["humanoid_CMU_V2020.xml", "humanoid_CMU_V2019.xml", "arena.xml"]),
        Part::Python => Ok(()),
    } {
        bail!("{name}={}: {problem}; correct it, or unset {name} and set-up provides its own", directory.display());
    }
    Ok(Some(directory))
}

fn absolute(path: &Path) -> PathBuf {
    fs::canonicalize(path).or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.to_path_buf())
}

fn require(directory: &Path, files: &[&str]) -> Result<(), String> {
    match files.iter().find(|file| !directory.join(file).exists()) {
        Some(missing) => Err(format!("it has no {missing}")),
        None => Ok(()),
    }
}

fn check_mujoco(directory: &Path) -> Result<(), String> {
    require(directory, &["libmujoco.so"])?;
    let real = absolute(&directory.join("libmujoco.so"));
    let name = real.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    match name.strip_prefix("libmujoco.so.") {
        Some(version) if version != "3.17.0" => Err(format!("it has MuJoCo {version}; 3.17.0 is needed")),
        _ => Ok(()),
    }
}

fn check_libtorch(directory: &Path) -> Result<(), String> {
    require(directory, &["lib/libtorch_cpu.so", "lib/libc10.so", "lib/libtorch.so", "include/torch"])?;
    // The zip archive has `build-version`; a wheel and an installed package have `version.py`.
    let record = fs::read_to_string(directory.join("build-version"))
        .or_else(|_| fs::read_to_string(directory.join("version.py")))
        .unwrap_or_default();
    let version = record.lines().find_map(|line| match line.split_once("__version__ = ") {
        Some((_, quoted)) => Some(quoted.trim_matches(['\'', '"']).to_owned()),
        None => line.starts_with(|first: char| first.is_ascii_digit()).then(|| line.to_owned()),
    });
    match version {
        Some(version) if !version.starts_with("2.9.") => Err(format!("it has libtorch {version}; 2.9 is needed")),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(path: &Path, content: &str) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }

    fn libtorch(version: &str) -> tempfile::TempDir {
        let directory = tempfile::tempdir().unwrap();
        for file in ["lib/libtorch_cpu.so", "lib/libc10.so", "lib/libtorch.so", "include/torch/script.h"] {
            touch(&directory.path().join(file), "");
        }
        touch(&directory.path().join("build-version"), version);
        directory
    }

    #[test]
    fn a_directory_that_cargos_configuration_sets_is_not_the_users() {
        let root = tempfile::tempdir().unwrap();
        let dependencies = root.path().join(".deps");
        let set = dependencies.join("libtorch");
        assert_eq!(directory(Part::Libtorch, &dependencies, |_| Some(set.clone())).unwrap(), None);
        assert_eq!(directory(Part::Libtorch, &dependencies, |_| None).unwrap(), None);
    }

    #[test]
    fn a_users_libtorch_of_the_right_version_is_used() {
        let own = libtorch("2.9.0+cpu\n");
        let found = directory(Part::Libtorch, Path::new(".deps"), |_| Some(own.path().into())).unwrap();
        assert_eq!(found.as_deref(), Some(own.path()));
    }

    #[test]
    fn a_users_libtorch_of_another_version_is_refused_with_its_variable() {
        let own = libtorch("2.4.1+cpu\n");
        let error = directory(Part::Libtorch, Path::new(".deps"), |_| Some(own.path().into())).unwrap_err().to_string();
        assert!(error.contains("LIBTORCH=") && error.contains("2.4.1"), "{error}");
    }

    #[test]
    fn a_users_directory_without_the_library_is_refused_with_its_variable() {
        let own = tempfile::tempdir().unwrap();
        let relative = |_: &str| Some("own/dm_control".into());
        let error = directory(Part::DmControl, Path::new(".deps"), relative).unwrap_err().to_string();
        assert!(error.contains("COMIC_DM_CONTROL_DIR=own/dm_control: it must be an absolute path"), "{error}");
        let error = directory(Part::Mujoco, Path::new(".deps"), |_| Some(own.path().into())).unwrap_err().to_string();
        assert!(error.contains("MUJOCO_DYNAMIC_LINK_DIR=") && error.contains("libmujoco.so"), "{error}");
    }
}
