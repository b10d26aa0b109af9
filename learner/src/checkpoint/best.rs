//! Which checkpoint was evaluated best.

use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::checkpoint::name::Name;
use crate::checkpoint::snapshot::PROGRESS;
use crate::checkpoint::steps::{Step, carry_out, hidden, put, replace};
use crate::error::{Error, Result};

const LINK: &str = "best";
const RECORD: &str = "best.json";

/// The checkpoint that an evaluation is about, as its report names it, and how good it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evaluated {
    /// The run.
    pub run: u64,
    /// The learner epoch.
    pub epoch: u64,
    /// Updates until then.
    pub updates: u64,
    /// Mean over the episodes of return / largest possible return.
    pub normalised_reward: f64,
}

/// The result of comparing an evaluated checkpoint with the best one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Judgement {
    /// None was better: this one is kept from now on.
    Best(Name),
    /// A better one is kept already.
    NotBetter,
    /// It does not exist any more.
    Gone,
}

/// `best.json`.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Best {
    /// The number of updates, by which checkpoints are named.
    updates: u64,
    learner_epoch: u64,
    version: u64,
    normalised_reward: f64,
}

impl Best {
    /// The name of the best checkpoint.
    pub(super) fn name(self) -> Name {
        Name::Updates(self.updates)
    }

    /// Keeps the checkpoint of `directory` that was evaluated, if none was better.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(super) fn judge(directory: &Path, evaluated: Evaluated) -> Result<Judgement> {
        let Evaluated { run, epoch: learner_epoch, updates, normalised_reward } = evaluated;
        // Another run, or an earlier epoch of this one, may have left a checkpoint of the same name.
        let same = |found: &Position| found.epoch == learner_epoch && found.run == Some(run);
        let position = Position::read(&Name::Updates(updates).within(directory));
        let Some(Position { version, .. }) = position.filter(same) else {
            return Ok(Judgement::Gone);
        };
        if Self::read(directory).is_some_and(|best| best.normalised_reward >= normalised_reward) {
            return Ok(Judgement::NotBetter);
        }
        let best = Self { updates, learner_epoch, version, normalised_reward };
        let record = serde_json::to_vec_pretty(&best).map_err(Error::json(RECORD))?;
        carry_out(&replace(&directory.join(RECORD), record))?;
        best.link(directory)?;
        Ok(Judgement::Best(best.name()))
    }

    /// What `best.json` says. A damaged one is logged, and the next evaluation replaces it.
    pub(super) fn read(directory: &Path) -> Option<Self> {
        let path = directory.join(RECORD);
        let text = match fs::read(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => return None,
            Err(error) => {
                tracing::warn!("{} cannot be read and is ignored: {error}", path.display());
                return None;
            }
        };
        match serde_json::from_slice::<Self>(&text) {
            Ok(best) if best.name().within(directory).is_dir() => Some(best),
            Ok(best) => {
                tracing::warn!("{} names {}, which does not exist, and is ignored", path.display(), best.name());
                None
            }
            Err(error) => {
                tracing::warn!("{} is damaged and is ignored: {error}", path.display());
                None
            }
        }
    }

    /// Points the link `best` to this checkpoint.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(super) fn link(self, directory: &Path) -> Result<()> {
        let link = directory.join(LINK);
        let target = self.name().to_string();
        if fs::read_link(&link).is_ok_and(|found| found == Path::new(&target)) {
            return Ok(());
        }
        let temporary = hidden("", &link);
        carry_out(&[Step::Remove(temporary.clone()), Step::Link(temporary.clone(), target)])?;
        carry_out(&put(temporary, &link))
    }
}

/// The part of a checkpoint's progress that an evaluation is compared with.
#[derive(Deserialize)]
struct Position {
    /// Absent from checkpoints of learners that did not number runs.
    run: Option<u64>,
    epoch: u64,
    version: u64,
}

impl Position {
    fn read(checkpoint: &Path) -> Option<Self> {
        serde_json::from_slice(&fs::read(checkpoint.join(PROGRESS)).ok()?).ok()
    }
}
