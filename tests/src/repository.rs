//! The workspace's own files and dependencies, for the tests that hold the architecture.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};

/// The crates' folders, as the root manifest lists them.
pub const FOLDERS: [&str; 13] = [
    "experiment",
    "proto",
    "clips",
    "tasks",
    "networks",
    "replay",
    "actor",
    "learner",
    "manual",
    "bench",
    "tests",
    "setup",
    "xtask",
];

/// The repository's root.
pub fn root() -> PathBuf {
    let package = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    package.parent().map_or(package.clone(), Path::to_path_buf)
}

/// A source file: its path relative to the root, and its text.
pub struct Source {
    /// For instance `learner/src/checkpoint.rs`.
    pub path: String,
    /// Its text.
    pub text: String,
}

/// Every Rust file of the workspace's crates.
///
/// # Errors
/// A folder or file that cannot be read.
pub fn sources() -> Result<Vec<Source>> {
    let root = root();
    let mut found = Vec::new();
    for folder in FOLDERS {
        collect(&root, &root.join(folder), &mut found)?;
    }
    Ok(found)
}

fn collect(root: &Path, directory: &Path, found: &mut Vec<Source>) -> Result<()> {
    for entry in fs::read_dir(directory).with_context(|| format!("cannot list {}", directory.display()))? {
        let path = entry?.path();
        if path.is_dir() {
            collect(root, &path, found)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
            let path = path.strip_prefix(root).unwrap_or(&path).display().to_string();
            found.push(Source { path, text });
        }
    }
    Ok(())
}

/// Names of all crates that `package` is built from, itself left out: what its programs link.
///
/// # Errors
/// When cargo does not answer.
pub fn dependencies(package: &str) -> Result<BTreeSet<String>> {
    tree(package, &[])
}

/// Names of the crates that `package` names itself.
///
/// # Errors
/// When cargo does not answer.
pub fn direct_dependencies(package: &str) -> Result<BTreeSet<String>> {
    tree(package, &["--depth", "1"])
}

fn tree(package: &str, more: &[&str]) -> Result<BTreeSet<String>> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let arguments =
        ["tree", "--offline", "--edges", "normal", "--prefix", "none", "--format", "{p}", "--package", package];
    let output = Command::new(cargo).args(arguments).args(more).current_dir(root()).output();
    let output = output.context("cannot start cargo")?;
    if !output.status.success() {
        bail!("cargo tree --package {package}: {}", String::from_utf8_lossy(&output.stderr));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let names = text.lines().filter_map(|line| line.split_whitespace().next()).map(str::to_owned);
    Ok(names.filter(|name| name != package).collect())
}
