//! Certificates for a measurement, gone when it is over.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};

/// A directory with an authority and a server's certificate, as `comic-learner certs` makes them.
#[derive(Debug)]
pub(super) struct Certificates {
    directory: PathBuf,
    shown: String,
}

impl Certificates {
    pub(super) fn new() -> Result<Self> {
        let directory = std::env::temp_dir().join(format!("comic-load-{}", std::process::id()));
        let shown = directory.to_str().context("the temporary directory's name is not UTF-8")?.to_owned();
        let program = std::env::current_exe().context("cannot tell where this program lies")?;
        let made = Command::new(program).args(["certs", "--out", &shown]).stdout(Stdio::null()).status();
        ensure!(made.context("cannot start `comic-learner certs`")?.success(), "no certificates in {shown}");
        Ok(Self { directory, shown })
    }

    /// What host and crowd are told.
    pub(super) fn option(&self) -> [&str; 2] {
        ["--tls", &self.shown]
    }
}

impl Drop for Certificates {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.directory);
    }
}
