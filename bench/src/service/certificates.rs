//! Certificates for a measurement, removed at its end.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};

/// A directory with an authority, a server's certificate and a token.
#[derive(Debug)]
pub(super) struct Certificates {
    directory: PathBuf,
    name: String,
}

impl Certificates {
    /// Makes them with the program `comic-learner` in the directory of this one.
    pub(super) fn new() -> Result<Self> {
        let directory = std::env::temp_dir().join(format!("comic-bench-{}", std::process::id()));
        let name = directory.to_str().context("the name of the temporary directory is not UTF-8")?.to_owned();
        let own = std::env::current_exe().context("cannot find the path of this program")?;
        let learner = own.with_file_name("comic-learner");
        let made = Command::new(&learner).args(["certs", "--token", "--out", &name]).stdout(Stdio::null()).status();
        let made = made.with_context(|| format!("cannot start {}: `cargo build --release`", learner.display()))?;
        ensure!(made.success(), "`comic-learner certs` made no certificates in {name}");
        Ok(Self { directory, name })
    }

    /// The option of host and crowd.
    pub(super) fn option(&self) -> [&str; 2] {
        ["--tls", &self.name]
    }
}

impl Drop for Certificates {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.directory);
    }
}
