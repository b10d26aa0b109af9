//! What tells a wheel that was taken whole from one that was not.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

/// The record of one wheel: written after everything else, so that where it stands and agrees the wheel is whole.
#[derive(Serialize, Deserialize)]
pub(crate) struct Stamp {
    /// SHA-256 of the wheel.
    pub(crate) sha256: String,
    /// Whether all of it was kept (`--cuda`, `--xla`).
    pub(crate) cuda: bool,
    /// Every file taken, relative to `.deps`, with its size in bytes.
    pub(crate) files: BTreeMap<PathBuf, u64>,
}

impl Stamp {
    fn path(dependencies: &Path, wheel: &str) -> PathBuf {
        dependencies.join("stamps").join(format!("{wheel}.json"))
    }

    /// The stamp of `wheel`, if there is a readable one.
    pub(crate) fn read(dependencies: &Path, wheel: &str) -> Option<Self> {
        serde_json::from_str(&fs::read_to_string(Self::path(dependencies, wheel)).ok()?).ok()
    }

    /// Whether every file still stands there with its size.
    pub(crate) fn agrees(&self, dependencies: &Path) -> bool {
        self.files
            .iter()
            .all(|(file, size)| fs::metadata(dependencies.join(file)).is_ok_and(|found| found.len() == *size))
    }

    /// Writes the stamp; the wheel counts as whole from then on.
    pub(crate) fn write(&self, dependencies: &Path, wheel: &str) -> Result<()> {
        let path = Self::path(dependencies, wheel);
        let unfinished = path.with_extension("unfinished");
        fs::create_dir_all(dependencies.join("stamps")).context("cannot make the directory of stamps")?;
        fs::write(&unfinished, serde_json::to_vec(self)?)
            .with_context(|| format!("cannot write {}", unfinished.display()))?;
        crate::extract::rename(&unfinished, &path)
    }

    /// Takes the wheel's files away, its stamp first.
    pub(crate) fn remove(self, dependencies: &Path, wheel: &str) -> Result<()> {
        let path = Self::path(dependencies, wheel);
        fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
        for file in self.files.keys() {
            let _ = fs::remove_file(dependencies.join(file));
        }
        Ok(())
    }
}
