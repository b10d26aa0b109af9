//! What checkpoints are called, and which of them lie in a directory.

use std::fs;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// What a checkpoint is called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Name {
    /// Before any learning; kept.
    Initial,
    /// After so many updates; the newest few are kept.
    Updates(u64),
}

impl Name {
    /// The name that is spelt like this, if it is one.
    pub(super) fn parse(text: &str) -> Option<Self> {
        match text {
            "initial" => Some(Self::Initial),
            _ => {
                let digits = text.strip_prefix("checkpoint-")?;
                let well_formed = digits.len() == 10 && digits.bytes().all(|byte| byte.is_ascii_digit());
                well_formed.then(|| digits.parse().ok().map(Self::Updates)).flatten()
            }
        }
    }

    /// The checkpoint of this name in a directory of checkpoints.
    pub(super) fn within(self, directory: &Path) -> PathBuf {
        directory.join(self.to_string())
    }
}

impl std::fmt::Display for Name {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Initial => f.write_str("initial"),
            Self::Updates(updates) => write!(f, "checkpoint-{updates:010}"),
        }
    }
}

/// What lies in a directory.
///
/// # Errors
/// When it cannot be listed.
pub(super) fn entries(directory: &Path) -> Result<Vec<PathBuf>> {
    let listed = || fs::read_dir(directory)?.map(|entry| entry.map(|entry| entry.path())).collect();
    std::io::Result::map_err(listed(), Error::file("list", directory))
}

/// Numbered checkpoints and their numbers, oldest first.
///
/// # Errors
/// When the directory cannot be listed.
pub(super) fn numbered(directory: &Path) -> Result<Vec<(u64, PathBuf)>> {
    let mut found = Vec::new();
    for path in entries(directory)? {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if let Some(Name::Updates(updates)) = Name::parse(&name)
            && path.is_dir()
        {
            found.push((updates, path));
        }
    }
    found.sort();
    Ok(found)
}
