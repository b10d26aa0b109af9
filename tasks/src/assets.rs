//! Finds dm_control's XML files.

use std::path::{Path, PathBuf};

use crate::error::Error;

const VARIABLE: &str = "COMIC_DM_CONTROL_DIR";

/// The directory of dm_control's XML files. It is the value of the environment variable `COMIC_DM_CONTROL_DIR` now, else
/// its value when the program was built, else `.deps/dm_control`.
pub(crate) fn directory() -> Result<PathBuf, Error> {
    let candidates = [
        std::env::var_os(VARIABLE).map(PathBuf::from),
        option_env!("COMIC_DM_CONTROL_DIR").map(PathBuf::from),
        Some(PathBuf::from(".deps/dm_control")),
    ];
    let mut tried = Vec::new();
    for candidate in candidates.into_iter().flatten() {
        if candidate.join("arena.xml").is_file() {
            return Ok(candidate);
        }
        tried.push(candidate.display().to_string());
    }
    tried.dedup();
    Err(Error::Asset { file: "arena.xml".into(), tried: tried.join(", ") })
}

/// The path of a file in this directory.
pub(crate) fn file(directory: &Path, name: &str) -> Result<PathBuf, Error> {
    let path = directory.join(name);
    if path.is_file() {
        Ok(path)
    } else {
        Err(Error::Asset { file: name.into(), tried: directory.display().to_string() })
    }
}
