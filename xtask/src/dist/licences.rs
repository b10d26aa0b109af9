//! The texts of the licences of everything that a program contains. Most licences ask for their text beside the program.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use serde::Deserialize;

use super::{TARGET, libraries};
use crate::workspace::{cargo, root};

/// Our own licences and notices.
const OWN: [&str; 3] = ["LICENSE-APACHE", "LICENSE-MIT", "NOTICE"];
/// Where the text is of the licence of the humanoid, which every simulating program contains.
const HUMANOID: &str = ".deps/licences/dm_control";
const SEPARATOR: &str = "\n================================================================================\n";

/// Writes into `directory` our own licences, those of the native libraries, and `crates.txt` with those of the crates.
///
/// # Errors
/// A text that is missing.
pub(super) fn write(program: &str, crates: &BTreeSet<String>, directory: &Path) -> Result<()> {
    for name in OWN {
        copy(&root().join(name), &directory.join(name))?;
    }
    let others = directory.join("licences");
    let native = libraries::of(program).map(|library| (library.name, library.texts));
    for (name, texts) in native.chain([("dm_control", HUMANOID)]) {
        copy_directory(&root().join(texts), &others.join(name))?;
    }
    let texts = of_crates(crates)?;
    fs::write(others.join("crates.txt"), texts).with_context(|| format!("cannot write {}", others.display()))
}

/// Fails if libraries are there without the texts of their licences: set-up did not keep them in earlier releases. Where there are no
/// libraries yet, set-up fetches both.
pub(super) fn check(programs: &[&str]) -> Result<()> {
    if !root().join(".deps/stamps").exists() {
        return Ok(());
    }
    let native = programs.iter().flat_map(|program| libraries::of(program)).map(|library| library.texts);
    native.chain([HUMANOID]).try_for_each(|texts| list(&root().join(texts)).map(drop))
}

fn copy_directory(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir_all(to).with_context(|| format!("cannot make {}", to.display()))?;
    list(from)?.iter().try_for_each(|file| copy(file, &to.join(file.file_name().unwrap_or_default())))
}

/// The files of a directory with a licence, which has at least one.
fn list(directory: &Path) -> Result<Vec<PathBuf>> {
    let entries = fs::read_dir(directory).and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect());
    let files: Vec<PathBuf> = entries.unwrap_or_default();
    ensure!(
        !files.is_empty(),
        "{} with a licence is missing: remove .deps/stamps, and `cargo xtask setup` fetches it with the libraries (1 GB)",
        directory.display()
    );
    Ok(files)
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    fs::copy(from, to).map(drop).with_context(|| format!("cannot copy {} to {}", from.display(), to.display()))
}

#[derive(Deserialize)]
struct Metadata {
    packages: Vec<Package>,
}

/// What cargo says about a crate.
#[derive(Deserialize)]
struct Package {
    id: String,
    name: String,
    version: String,
    license: Option<String>,
    /// `None` for a crate of this workspace.
    source: Option<String>,
    manifest_path: PathBuf,
}

/// The licences of the crates with these identities: every text once, below the names of the crates that have it.
fn of_crates(crates: &BTreeSet<String>) -> Result<String> {
    let mut metadata = cargo();
    metadata.args(["metadata", "--locked", "--format-version=1", "--filter-platform", TARGET]);
    let output = metadata.output().context("cannot start cargo")?;
    ensure!(output.status.success(), "cargo metadata: {}", String::from_utf8_lossy(&output.stderr).trim());
    let Metadata { packages } = serde_json::from_slice(&output.stdout).context("cargo metadata wrote no such JSON")?;
    let listed: Vec<Package> = packages.into_iter().filter(|package| crates.contains(&package.id)).collect();
    let known: BTreeSet<&str> = listed.iter().map(|package| package.id.as_str()).collect();
    let unknown: Vec<&String> = crates.iter().filter(|identity| !known.contains(identity.as_str())).collect();
    ensure!(unknown.is_empty(), "the bill of materials lists crates that cargo does not know: {unknown:?}");
    concatenate(listed.into_iter().filter(|package| package.source.is_some()).collect())
}

fn concatenate(packages: Vec<Package>) -> Result<String> {
    let mut holders: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for package in packages {
        let Package { name, version, license, .. } = &package;
        let holder = format!("{name} {version}: {}", license.as_deref().unwrap_or("see below"));
        let texts = texts(package.manifest_path.parent().unwrap_or(Path::new("")))?;
        if texts.is_empty() {
            holders.entry("The crate has no file with the text.".into()).or_default().push(holder.clone());
        }
        for text in texts {
            holders.entry(text).or_default().push(holder.clone());
        }
    }
    let mut by_crate: Vec<_> = holders.into_iter().map(|(text, crates)| (crates.join("\n"), text)).collect();
    by_crate.sort();
    Ok(by_crate.into_iter().map(|(crates, text)| format!("{crates}\n\n{text}\n{SEPARATOR}")).collect())
}

/// The licences and notices in the directory of a crate, sorted by the names of their files.
fn texts(directory: &Path) -> Result<Vec<String>> {
    let entries = fs::read_dir(directory).with_context(|| format!("cannot list {}", directory.display()))?;
    let mut files = Vec::new();
    for entry in entries {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().to_uppercase();
        let legal = ["LICENSE", "LICENCE", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE"];
        if path.is_file() && legal.iter().any(|start| name.starts_with(start)) {
            files.push(path);
        }
    }
    files.sort();
    let read = |path: PathBuf| {
        let bytes = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(String::from_utf8_lossy(&bytes).replace("\r\n", "\n").trim_end().to_owned())
    };
    files.into_iter().map(read).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A crate with these files.
    fn package(directory: &Path, name: &str, files: &[(&str, &str)]) -> Package {
        let directory = directory.join(name);
        fs::create_dir(&directory).unwrap();
        files.iter().for_each(|(file, text)| fs::write(directory.join(file), text).unwrap());
        Package {
            id: name.into(),
            name: name.into(),
            version: "1.0.0".into(),
            license: Some("MIT".into()),
            source: Some("registry".into()),
            manifest_path: directory.join("Cargo.toml"),
        }
    }

    #[test]
    fn equal_licences_appear_once_with_every_crate_that_has_them() {
        let directory = tempfile::tempdir().unwrap();
        let package = |name, files| package(directory.path(), name, files);
        let packages = vec![
            package("a", &[("LICENSE-MIT", "be kind\n"), ("lib.rs", "code")]),
            package("b", &[("license.txt", "be kind\r\n")]),
            package("c", &[("COPYING", "be careful")]),
            package("d", &[]),
        ];
        let expected = [
            "a 1.0.0: MIT\nb 1.0.0: MIT\n\nbe kind",
            "c 1.0.0: MIT\n\nbe careful",
            "d 1.0.0: MIT\n\nThe crate has no file with the text.",
        ];
        assert_eq!(concatenate(packages).unwrap(), expected.map(|part| format!("{part}\n{SEPARATOR}")).concat());
    }
}
