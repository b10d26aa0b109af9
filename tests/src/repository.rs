//! The workspace's own files and dependencies, for the architecture tests.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};

/// The crates' folders, as the root manifest lists them.
///
/// # Errors
/// When the manifest cannot be read.
pub fn folders() -> Result<Vec<String>> {
    let manifest: toml::Table = fs::read_to_string(root().join("Cargo.toml"))?.parse()?;
    let members = manifest.get("workspace").and_then(|workspace| workspace.get("members")?.as_array());
    let members = members.context("Cargo.toml lists no members")?;
    Ok(members.iter().filter_map(|member| member.as_str().map(str::to_owned)).collect())
}

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
/// When a folder or file cannot be read.
pub fn sources() -> Result<Vec<Source>> {
    let root = root();
    let mut found = Vec::new();
    for folder in folders()? {
        collect(&root, &root.join(folder), &mut found)?;
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
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

/// Names of all crates that `package` is built from, without itself. Its programs link them.
///
/// # Errors
/// When cargo fails.
pub fn dependencies(package: &str) -> Result<BTreeSet<String>> {
    tree(package, &[])
}

/// Names of the direct dependencies of `package`.
///
/// # Errors
/// When cargo fails.
pub fn direct_dependencies(package: &str) -> Result<BTreeSet<String>> {
    tree(package, &["--depth", "1"])
}

fn tree(package: &str, more: &[&str]) -> Result<BTreeSet<String>> {
    let arguments = ["--edges", "normal", "--prefix", "none", "--format", "{p}", "--package", package];
    let text = cargo_tree(&[&arguments, more].concat())?;
    let names = text.lines().filter_map(|line| line.split_whitespace().next()).map(str::to_owned);
    Ok(names.filter(|name| name != package).collect())
}

/// Every crate that a build of these packages compiles, with its version and features.
///
/// # Errors
/// When cargo fails.
pub fn compiled(packages: &[&str]) -> Result<BTreeSet<String>> {
    let arguments = ["--edges", "normal,build", "--prefix", "none", "--format", "{p} {f}"];
    let text = cargo_tree(&[&arguments, packages].concat())?;
    Ok(text.lines().map(|line| line.trim_end_matches(" (*)").to_owned()).collect())
}

fn cargo_tree(arguments: &[&str]) -> Result<String> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(cargo).args(["tree", "--offline"]).args(arguments).current_dir(root()).output();
    let output = output.context("cannot start cargo")?;
    if !output.status.success() {
        bail!("cargo tree {}: {}", arguments.join(" "), String::from_utf8_lossy(&output.stderr));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}
