//! The directory of a run.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use crate::{evaluations, workspace};

/// A run's directory: checkpoints, metrics.jsonl, evaluations.jsonl, the page, tensorboard, logs, the evaluation and
/// the pictures.
pub(super) struct RunDirectory(PathBuf);

impl RunDirectory {
    /// The directory `asked`, or the preset's next one, or for `resume` its newest one.
    pub(super) fn choose(asked: Option<PathBuf>, preset: &str, resume: bool) -> Result<Self> {
        Self::choose_below(&workspace::root().join("runs"), asked, preset, resume)
    }

    fn choose_below(runs: &Path, asked: Option<PathBuf>, preset: &str, resume: bool) -> Result<Self> {
        let numbered = |number: usize| runs.join(format!("{preset}-{number}"));
        let next = (1..).find(|number| !numbered(*number).exists()).unwrap_or(1);
        let directory = match asked {
            Some(path) => std::path::absolute(&path).with_context(|| format!("no such path: {}", path.display()))?,
            None if resume && next == 1 => bail!("{} has no run of {preset} to resume", runs.display()),
            None if resume => numbered(next - 1),
            None => numbered(next),
        };
        let has_run = directory.join("checkpoints").is_dir();
        match (resume, has_run) {
            (true, false) => bail!("{} has no checkpoints, so there is no run to resume", directory.display()),
            (false, true) => {
                bail!("{} has a run already: --resume resumes it, another --run starts a new one", directory.display())
            }
            _ => Ok(Self(directory)),
        }
    }

    pub(super) fn make(&self) -> Result<()> {
        fs::create_dir_all(&self.0).with_context(|| format!("cannot make {}", self.0.display()))
    }

    pub(super) fn path(&self) -> &Path {
        &self.0
    }

    pub(super) fn metrics(&self) -> PathBuf {
        self.0.join("metrics.jsonl")
    }

    pub(super) fn evaluations(&self) -> PathBuf {
        self.0.join(evaluations::FILE)
    }

    /// The page that the learner writes.
    pub(super) fn page(&self) -> PathBuf {
        self.0.join("index.html")
    }

    pub(super) fn log(&self, name: &str) -> PathBuf {
        self.0.join(format!("{name}.log"))
    }

    fn checkpoints(&self) -> PathBuf {
        self.0.join("checkpoints")
    }

    /// The newest checkpoint, without the initial one.
    pub(super) fn newest_checkpoint(&self) -> Option<PathBuf> {
        let paths = fs::read_dir(self.checkpoints()).into_iter().flatten().flatten().map(|entry| entry.path());
        paths
            .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("checkpoint-")))
            .max()
    }

    /// The policies that exist, each with its name.
    pub(super) fn policies(&self) -> Vec<(&'static str, PathBuf)> {
        let mut policies = vec![("untrained", self.checkpoints().join("initial"))];
        policies.extend(self.newest_checkpoint().map(|path| ("trained", path)));
        policies.retain(|(_, path)| path.is_dir());
        policies
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_run_gets_the_next_free_number_and_resuming_takes_the_newest() {
        let runs = tempfile::tempdir().unwrap();
        for number in [1, 2] {
            fs::create_dir_all(runs.path().join(format!("quickstart-{number}/checkpoints"))).unwrap();
        }
        let new = RunDirectory::choose_below(runs.path(), None, "quickstart", false).unwrap();
        assert!(new.path().ends_with("quickstart-3"));
        let resumed = RunDirectory::choose_below(runs.path(), None, "quickstart", true).unwrap();
        assert!(resumed.path().ends_with("quickstart-2"));
    }

    #[test]
    fn a_run_is_not_overwritten_and_only_an_existing_run_is_resumed() {
        let runs = tempfile::tempdir().unwrap();
        let used = runs.path().join("used");
        fs::create_dir_all(used.join("checkpoints")).unwrap();
        assert!(RunDirectory::choose_below(runs.path(), Some(used), "p", false).is_err());
        assert!(RunDirectory::choose_below(runs.path(), Some(runs.path().join("new")), "p", true).is_err());
        assert!(RunDirectory::choose_below(runs.path(), None, "p", true).is_err());
    }

    #[test]
    fn the_trained_policy_is_the_newest_checkpoint() {
        let runs = tempfile::tempdir().unwrap();
        for name in ["initial", "checkpoint-0000000009", "checkpoint-0000000010"] {
            fs::create_dir_all(runs.path().join("checkpoints").join(name)).unwrap();
        }
        let policies = RunDirectory(runs.path().into()).policies();
        assert_eq!(policies.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["untrained", "trained"]);
        assert!(policies[1].1.ends_with("checkpoint-0000000010"));
    }
}
