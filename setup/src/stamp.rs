//! Stamps, which tell a complete wheel from an incomplete one.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

/// The record of one wheel, written after all of its files. A wheel is complete if its stamp exists and agrees with the
/// files.
#[derive(Serialize, Deserialize)]
pub(crate) struct Stamp {
    /// SHA-256 of the wheel.
    pub(crate) sha256: String,
    /// Whether all of its files were taken (`--cuda`, `--xla`).
    pub(crate) cuda: bool,
    /// Every file, relative to `.deps`, with its size in bytes.
    pub(crate) files: BTreeMap<PathBuf, u64>,
}

impl Stamp {
    fn path(dependencies: &Path, wheel: &str) -> PathBuf {
        dependencies.join("stamps").join(format!("{wheel}.json"))
    }

    /// The stamp of `wheel`, if a readable one exists.
    pub(crate) fn read(dependencies: &Path, wheel: &str) -> Option<Self> {
        serde_json::from_str(&fs::read_to_string(Self::path(dependencies, wheel)).ok()?).ok()
    }

    /// Whether every file exists with its size.
    pub(crate) fn agrees(&self, dependencies: &Path) -> bool {
        self.files
            .iter()
            .all(|(file, size)| fs::metadata(dependencies.join(file)).is_ok_and(|found| found.len() == *size))
    }

    /// Writes the stamp, which makes the wheel complete.
    pub(crate) fn write(&self, dependencies: &Path, wheel: &str) -> Result<()> {
        let path = Self::path(dependencies, wheel);
        let unfinished = path.with_extension("unfinished");
        fs::create_dir_all(dependencies.join("stamps")).context("cannot make the directory of stamps")?;
        fs::write(&unfinished, serde_json::to_vec(self)?)
            .with_context(|| format!("cannot write {}", unfinished.display()))?;
        crate::extract::rename(&unfinished, &path)
    }

    /// Removes the wheel's stamp, then its files.
    pub(crate) fn remove(self, dependencies: &Path, wheel: &str) -> Result<()> {
        let path = Self::path(dependencies, wheel);
        fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
        for file in self.files.keys() {
            let _ = fs::remove_file(dependencies.join(file));
        }
        Ok(())
    }
}
