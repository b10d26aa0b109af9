//! A sign of life: a file that is written while environments are stepped, and `comic-actor health`, which looks at it.

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

/// How often it is looked whether environments were stepped.
const EVERY: Duration = Duration::from_secs(2);

/// Asks whether an actor steps environments: exits with 0 if it did lately, and with 1 if not. An actor whose learner is away
/// or slower than it is stands still, too.
#[derive(Clone, Debug, Args)]
pub struct Health {
    /// What the actor was given as --pulse.
    #[arg(long, value_name = "FILE", env = "COMIC_PULSE")]
    pub pulse: PathBuf,
    /// Seconds within which an environment must have been stepped.
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(5..=86_400))]
    pub within: u64,
}

impl Health {
    /// Looks, and says so on stdout.
    ///
    /// # Errors
    /// An actor that stands still, or has not begun.
    pub fn run(&self) -> Result<()> {
        let file = self.pulse.display();
        let written = match fs::metadata(&self.pulse) {
            Ok(found) => found.modified().with_context(|| format!("{file} has no time"))?,
            Err(error) if error.kind() == ErrorKind::NotFound => bail!("no environment was stepped yet"),
            Err(error) => return Err(error).with_context(|| format!("cannot look at {file}")),
        };
        // A clock that was set back makes it look new, which it then is for as long.
        let age = written.elapsed().unwrap_or_default();
        if age > Duration::from_secs(self.within) {
            bail!("no environment was stepped for {} s", age.as_secs());
        }
        // Nobody has to read it.
        let _ = writeln!(std::io::stdout(), "acting");
        Ok(())
    }
}

/// The file of a process that acts.
#[derive(Debug)]
pub(crate) struct Pulse {
    file: PathBuf,
    /// How many the process had taken when it was last looked.
    steps: u64,
}

impl Pulse {
    /// There is no file until an environment was stepped, so that what a former process left says nothing about this one.
    ///
    /// # Errors
    /// A place where no file can be written.
    pub(crate) fn new(file: &Path) -> Result<Self, Error> {
        let usable = fs::write(file, "").and_then(|()| fs::remove_file(file));
        let unusable = |error| Error::Usage(format!("--pulse {}: it cannot be written: {error}", file.display()));
        usable.map_err(unusable).map(|()| Self { file: file.to_owned(), steps: 0 })
    }

    /// Keeps it up.
    pub(crate) async fn beat(mut self, progress: Arc<Progress>) {
        loop {
            self.look(progress.steps.load(Ordering::Relaxed));
            tokio::time::sleep(EVERY).await;
        }
    }

    /// Writes the file if environments were stepped since the last time.
    fn look(&mut self, steps: u64) {
        if steps == self.steps {
            return;
        }
        self.steps = steps;
        if let Err(error) = fs::write(&self.file, format!("{steps}\n")) {
            tracing::warn!(file = %self.file.display(), %error, "the sign of life could not be written");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn health(pulse: &Path) -> Result<()> {
        Health { pulse: pulse.into(), within: 60 }.run()
    }

    #[test]
    fn what_a_former_process_left_counts_for_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("pulse");
        fs::write(&file, "1000\n").unwrap();
        assert!(health(&file).is_ok());
        Pulse::new(&file).unwrap();
        assert!(health(&file).unwrap_err().to_string().contains("yet"));
        assert!(matches!(Pulse::new(&directory.path().join("nowhere/pulse")), Err(Error::Usage(_))));
    }

    #[test]
    fn an_actor_that_stands_still_is_not_healthy() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let ago = std::time::SystemTime::now() - Duration::from_secs(90);
        file.as_file().set_modified(ago).unwrap();
        assert!(health(file.path()).unwrap_err().to_string().contains("for 9"));
    }

    #[test]
    fn it_is_written_as_long_as_steps_are_taken() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("pulse");
        let mut pulse = Pulse::new(&file).unwrap();
        pulse.look(0);
        assert!(!file.exists(), "no step, no sign");
        pulse.look(7);
        assert_eq!(fs::read_to_string(&file).unwrap(), "7\n");
        fs::remove_file(&file).unwrap();
        pulse.look(7);
        assert!(!file.exists(), "it stands still");
    }
}
