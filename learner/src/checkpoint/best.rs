//! Which checkpoint was evaluated best.

use std::fs;
use std::path::Path;

use anyhow::Result;
use serde::{Deserialize, Serialize};

use super::steps::{Step, carry_out, hidden, put, replace};
use super::{Name, PROGRESS, Store};

const BEST: &str = "best";
const BEST_RECORD: &str = "best.json";

/// The checkpoint that an evaluation is about, as its report names it, and how good it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evaluated {
    /// The run, where the report says which.
    pub run: Option<u64>,
    /// The life of the learner.
    pub epoch: u64,
    /// Updates until then.
    pub updates: u64,
    /// Mean over the episodes of return / the most they could have paid.
    pub normalised_reward: f64,
}

/// What an evaluation says of a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Judgement {
    /// None was better: this one is kept from now on.
    Best(Name),
    /// A better one is kept already.
    NotBetter,
    /// It is not here any more.
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
    pub(super) fn name(self) -> Name {
        Name::Updates(self.updates)
    }
}

impl Store {
    /// Keeps the checkpoint that was evaluated, besides the newest few, if none was better.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn judge(&self, evaluated: Evaluated) -> Result<Judgement> {
        let Evaluated { run, epoch: learner_epoch, updates, normalised_reward } = evaluated;
        let position = position(&self.path(Name::Updates(updates)));
        // Another run, or an earlier life of this one, may have come as far and left another checkpoint of this name.
        let same = |found: &Position| found.epoch == learner_epoch && (run.is_none() || found.run == run);
        let Some(Position { version, .. }) = position.filter(same) else {
            return Ok(Judgement::Gone);
        };
        if self.best().is_some_and(|best| best.normalised_reward >= normalised_reward) {
            return Ok(Judgement::NotBetter);
        }
        let best = Best { updates, learner_epoch, version, normalised_reward };
        carry_out(&replace(&self.directory.join(BEST_RECORD), serde_json::to_vec_pretty(&best)?))?;
        self.lead_to(best.name())?;
        Ok(Judgement::Best(best.name()))
    }

    /// What `best.json` says. A damaged one is complained about, and the next evaluation replaces it.
    pub(super) fn best(&self) -> Option<Best> {
        let path = self.directory.join(BEST_RECORD);
        let text = match fs::read(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return None,
            Err(error) => {
                tracing::warn!("{} cannot be read and is ignored: {error}", path.display());
                return None;
            }
        };
        let best = serde_json::from_slice::<Best>(&text);
        match best {
            Ok(best) if self.has(best.name()) => Some(best),
            Ok(best) => {
                tracing::warn!("{} names {}, which is not there, and is ignored", path.display(), best.name());
                None
            }
            Err(error) => {
                tracing::warn!("{} is damaged and is ignored: {error}", path.display());
                None
            }
        }
    }

    /// Has the link `best` lead to a checkpoint.
    pub(super) fn lead_to(&self, name: Name) -> Result<()> {
        let link = self.directory.join(BEST);
        let target = name.to_string();
        if fs::read_link(&link).is_ok_and(|found| found == Path::new(&target)) {
            return Ok(());
        }
        let temporary = hidden("", &link);
        let made = [Step::Remove(temporary.clone()), Step::Link(temporary.clone(), target)];
        carry_out(&made)?;
        carry_out(&put(temporary, &link))
    }
}

/// Where a run stood when a checkpoint was made.
#[derive(Deserialize)]
struct Position {
    /// Absent from those of learners that did not number runs.
    run: Option<u64>,
    epoch: u64,
    version: u64,
}

fn position(checkpoint: &Path) -> Option<Position> {
    serde_json::from_slice(&fs::read(checkpoint.join(PROGRESS)).ok()?).ok()
}
