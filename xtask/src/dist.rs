//! `cargo xtask dist`: the files of a release. Archives of both programs that run from any directory, the Python package,
//! bills of materials, the release notes, and checksums of all of them.
//!
//! # Layout
//! - [`tree`] builds the programs and makes the directory of each; [`libraries`] are the native libraries in it.
//! - [`sbom`] lists what a program contains, and [`licences`] collects the texts.
//! - [`archive`] packs a directory, always with the same bytes, and computes checksums.
//! - [`notes`] takes the version's section from the changelog; [`images`] makes images of the directories.

mod archive;
mod images;
mod libraries;
mod licences;
mod notes;
mod sbom;
mod tree;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};

use crate::{wheel, workspace};

const PROGRAMS: [&str; 2] = ["comic-learner", "comic-actor"];
/// Every crate of the workspace has this version.
const VERSION: &str = env!("CARGO_PKG_VERSION");
const TARGET: &str = "x86_64-unknown-linux-gnu";
const NOTES: &str = "RELEASE_NOTES.md";
const CHECKSUMS: &str = "SHA256SUMS";

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Directory for the files [default: the repository's target/dist]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Also make the images comic-learner and comic-actor, which contain the same files
    #[arg(long)]
    images: bool,
}

/// Builds, packs, and writes the checksums last.
pub(crate) fn run(options: &Options) -> Result<()> {
    let changelog = fs::read_to_string(workspace::root().join("CHANGELOG.md")).context("cannot read CHANGELOG.md")?;
    let notes = notes::section(&changelog, VERSION)?;
    let date = date()?;
    licences::check(&PROGRAMS)?;
    warn_of_changes();
    // A relative directory is the user's, who may be in another one than the repository's.
    let out = match &options.out {
        Some(out) => std::path::absolute(out).with_context(|| format!("cannot find {}", out.display()))?,
        None => workspace::root().join("target/dist"),
    };
    prepare(&out)?;
    let built = tree::build()?;
    let parent = directory().join("trees");
    let trees = PROGRAMS.map(|program| tree::make(program, &built, &parent));
    let trees = trees.into_iter().collect::<Result<Vec<_>>>()?;
    let mut files = Vec::new();
    let bills = sbom::bills(&PROGRAMS, &trees, date)?;
    for ((program, tree), bill) in PROGRAMS.iter().zip(&trees).zip(bills) {
        let bill_path = out.join(format!("{program}-{VERSION}.cdx.json"));
        write(&bill_path, &(serde_json::to_string_pretty(&bill)? + "\n"))?;
        document(program, tree, &bill_path, &sbom::crates(&bill))?;
        let archive = out.join(archive_name(program));
        eprintln!("packing {}", archive.display());
        archive::pack(tree, &archive, date)?;
        files.extend([archive, bill_path]);
    }
    let wheel = wheel::build_with(&[("SOURCE_DATE_EPOCH", date.to_string())])?;
    let shipped = out.join(wheel.file_name().context("a wheel without a name")?);
    fs::copy(&wheel, &shipped).with_context(|| format!("cannot copy {} to {}", wheel.display(), out.display()))?;
    write(&out.join(NOTES), &notes)?;
    files.extend([shipped, out.join(NOTES)]);
    files.sort();
    write(&out.join(CHECKSUMS), &archive::checksums(&files)?)?;
    if options.images {
        images::make(&trees)?;
    }
    println!("{}", out.display());
    Ok(())
}

/// Where programs for releases are built.
fn directory() -> PathBuf {
    workspace::root().join("target/relocatable")
}

fn archive_name(program: &str) -> String {
    format!("{program}-{VERSION}-{TARGET}.tar.gz")
}

/// The time of everything in a release, seconds since 1970: SOURCE_DATE_EPOCH, or when the last commit was made.
fn date() -> Result<u64> {
    let text = match std::env::var("SOURCE_DATE_EPOCH") {
        Ok(text) => text,
        Err(_) => git(&["log", "-1", "--format=%ct"]).context("SOURCE_DATE_EPOCH can name the time of the release")?,
    };
    text.trim().parse().with_context(|| format!("SOURCE_DATE_EPOCH={text} is no number of seconds"))
}

/// What git says about this repository.
fn git(arguments: &[&str]) -> Result<String> {
    let output = Command::new("git").args(arguments).current_dir(workspace::root()).output();
    let output = output.context("cannot start git")?;
    ensure!(output.status.success(), "git: {}", String::from_utf8_lossy(&output.stderr).trim());
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// Says that the release is not what a commit has.
fn warn_of_changes() {
    if git(&["status", "--porcelain"]).is_ok_and(|changes| !changes.is_empty()) {
        eprintln!("warning: files of the repository differ from the last commit: do not publish this release");
    }
}

/// Makes `out`, in which only files of an earlier try at this release may be, and removes them: another wheel among them would be
/// published, too.
fn prepare(out: &Path) -> Result<()> {
    fs::create_dir_all(out).with_context(|| format!("cannot make {}", out.display()))?;
    let entries = fs::read_dir(out).with_context(|| format!("cannot list {}", out.display()))?;
    let paths = entries.map(|entry| Ok(entry?.path())).collect::<Result<Vec<_>>>()?;
    for path in &paths {
        ensure!(
            path.file_name().is_some_and(|name| belongs(&name.to_string_lossy())),
            "{} is not a file of this release: remove it, or choose another directory with --out",
            path.display()
        );
    }
    for path in paths {
        fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
    }
    Ok(())
}

/// Whether this release has a file with this name.
fn belongs(name: &str) -> bool {
    let of_program = |program: &&str| name == archive_name(program) || name == format!("{program}-{VERSION}.cdx.json");
    let wheel = name.starts_with(&format!("comic_rl-{VERSION}-")) && name.ends_with(".whl");
    wheel || [NOTES, CHECKSUMS].contains(&name) || PROGRAMS.iter().any(of_program)
}

/// Writes `share/doc/PROGRAM`: a short introduction, the bill of materials and the licences.
fn document(program: &str, tree: &Path, bill: &Path, crates: &BTreeSet<String>) -> Result<()> {
    let documents = tree.join("share/doc").join(program);
    fs::create_dir_all(&documents).with_context(|| format!("cannot make {}", documents.display()))?;
    let graphics = " Pictures need `libegl1` and `libgl1-mesa-dri`, too.";
    let graphics = if program == "comic-actor" { graphics } else { "" };
    let readme = include_str!("dist/readme.md").replace("{program}", program).replace("{version}", VERSION);
    let readme = readme.replace("{glibc}", &tree::oldest_glibc(tree)?).replace("{graphics}", graphics);
    write(&documents.join("README.md"), &readme)?;
    let copied = fs::copy(bill, documents.join(format!("{program}.cdx.json")));
    copied.with_context(|| format!("cannot copy {}", bill.display()))?;
    licences::write(program, crates, &documents)
}

fn write(path: &Path, text: &str) -> Result<()> {
    fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_with_other_files_is_refused_so_that_nothing_else_is_published() {
        let out = tempfile::tempdir().unwrap();
        let ours = [archive_name("comic-actor"), format!("comic_rl-{VERSION}-cp310-abi3-linux.whl"), CHECKSUMS.into()];
        ours.iter().for_each(|name| fs::write(out.path().join(name), "").unwrap());
        prepare(out.path()).unwrap();
        assert_eq!(fs::read_dir(out.path()).unwrap().count(), 0, "files of an earlier try are kept");
        fs::write(out.path().join(&ours[0]), "").unwrap();
        fs::write(out.path().join("comic-actor-0.0.1-x86_64-unknown-linux-gnu.tar.gz"), "").unwrap();
        let error = prepare(out.path()).unwrap_err().to_string();
        assert!(error.contains("comic-actor-0.0.1") && error.contains("--out"), "{error}");
        assert!(out.path().join(&ours[0]).exists());
    }
}
