//! Liveness: a file that is written while environments are stepped, and `comic-actor health`, which reads its age.

use std::fs;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use clap::Args;

use crate::Error;
use crate::worker::Progress;

/// How often the steps are checked.
const EVERY: Duration = Duration::from_secs(2);

/// Checks whether an actor steps environments: exits with 0 if it did lately, and with 1 if not. An actor that waits for
/// its learner takes no steps either.
#[derive(Clone, Debug, Args)]
pub struct Health {
    /// The file that the actor was given as --liveness.
    #[arg(long, value_name = "FILE", env = "COMIC_LIVENESS")]
    pub liveness: PathBuf,
    /// Seconds within which an environment must have been stepped.
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(5..=86_400))]
    pub within: u64,
}

impl Health {
    /// Checks the file's age and prints the result on stdout.
    ///
    /// # Errors
    /// No step was taken yet, or none lately.
    pub fn run(&self) -> Result<()> {
        let file = self.liveness.display();
        let written = match fs::metadata(&self.liveness) {
            Ok(found) => found.modified().with_context(|| format!("{file} has no modification time"))?,
            Err(error) if error.kind() == ErrorKind::NotFound => bail!("no environment was stepped yet"),
            Err(error) => return Err(error).with_context(|| format!("cannot read {file}")),
        };
        // If the clock was set back, the file counts as new.
        let age = written.elapsed().unwrap_or_default();
        if age > Duration::from_secs(self.within) {
            bail!("no environment was stepped for {} s", age.as_secs());
        }
        // Standard output may be closed.
        let _ = writeln!(std::io::stdout(), "acting");
        Ok(())
    }
}

/// The liveness file of an actor process.
#[derive(Debug)]
pub(crate) struct Liveness {
    file: PathBuf,
    /// Steps of the process at the last check.
    steps: u64,
}

impl Liveness {
    /// Removes the file of an earlier process. The file comes back with the first step.
    ///
    /// # Errors
    /// [`Error::Usage`] when the file cannot be written.
    pub(crate) fn new(file: &Path) -> Result<Self, Error> {
        let usable = fs::write(file, "").and_then(|()| fs::remove_file(file));
        let unusable = |error| Error::Usage(format!("--liveness {}: it cannot be written: {error}", file.display()));
        usable.map_err(unusable).map(|()| Self { file: file.to_owned(), steps: 0 })
    }

    /// Writes the file again and again.
    pub(crate) async fn keep_up(mut self, progress: Arc<Progress>) {
        loop {
            self.update(progress.steps.load(Ordering::Relaxed));
            tokio::time::sleep(EVERY).await;
        }
    }

    /// Writes the file if environments were stepped since the last time.
    fn update(&mut self, steps: u64) {
        if steps == self.steps {
            return;
        }
        self.steps = steps;
        if let Err(error) = fs::write(&self.file, format!("{steps}\n")) {
            tracing::warn!(file = %self.file.display(), %error, "the liveness file could not be written");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn health(liveness: &Path) -> Result<()> {
        Health { liveness: liveness.into(), within: 60 }.run()
    }

    #[test]
    fn the_file_of_an_earlier_process_is_removed() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("liveness");
        fs::write(&file, "1000\n").unwrap();
        assert!(health(&file).is_ok());
        Liveness::new(&file).unwrap();
        assert!(health(&file).unwrap_err().to_string().contains("yet"));
        assert!(matches!(Liveness::new(&directory.path().join("nowhere/liveness")), Err(Error::Usage(_))));
    }

    #[test]
    fn an_actor_without_steps_is_not_healthy() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let ago = std::time::SystemTime::now() - Duration::from_secs(90);
        file.as_file().set_modified(ago).unwrap();
        assert!(health(file.path()).unwrap_err().to_string().contains("for 9"));
    }

    #[test]
    fn the_file_is_written_while_steps_are_taken() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("liveness");
        let mut liveness = Liveness::new(&file).unwrap();
        liveness.update(0);
        assert!(!file.exists(), "no step was taken");
        liveness.update(7);
        assert_eq!(fs::read_to_string(&file).unwrap(), "7\n");
        fs::remove_file(&file).unwrap();
        liveness.update(7);
        assert!(!file.exists(), "no step was taken since");
    }
}
