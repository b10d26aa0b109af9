//! What the learner says in its log about its starts, its checkpoints and the actors that join.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::{Context, Result};

use super::lines::{field, incarnation, time};

/// A learner that may have been killed and started again.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Learner {
    /// How often it was started.
    pub(super) starts: usize,
    /// The learner epoch of its last start.
    pub(super) epoch: u64,
    /// The checkpoint from which it was resumed.
    pub(super) resumed: Option<PathBuf>,
    /// A time before that checkpoint was made: it has every unroll that was acknowledged earlier.
    pub(super) covered: Option<String>,
    /// The actor processes that have joined since its last start. Joining, an actor says what was acknowledged to it.
    pub(super) joined: BTreeSet<u64>,
    /// The unrolls that it had counted when it ended: some arrive after the last checkpoint.
    pub(super) at_end: u64,
}

impl Learner {
    /// Reads its log.
    ///
    /// # Errors
    /// A log without the accounting of its end, and a line that lacks what such lines have.
    pub(super) fn of(log: &str) -> Result<Self> {
        let (mut learner, mut at_end) = (Self::default(), None);
        // Of each checkpoint when it was on disk.
        let mut written: Vec<(&str, &str)> = Vec::new();
        for line in log.lines() {
            let read = || format!("the learner's log: {line}");
            if let Some((_, path)) = line.split_once(" written checkpoint=") {
                written.push((time(line).with_context(read)?, path));
            } else if let Some((_, resumed)) = line.split_once(" resuming checkpoint=") {
                // A checkpoint is begun when the one before it is on disk. Its own line may be missing: the learner may have been
                // killed before it wrote that.
                let before = written.iter().rev().find(|(_, path)| *path != resumed);
                learner.covered = before.map(|(time, _)| (*time).to_owned());
                learner.resumed = Some(PathBuf::from(resumed));
            } else if line.contains(" serving address=") {
                learner.starts += 1;
                learner.epoch = field(line, "epoch").and_then(|epoch| epoch.parse().ok()).with_context(read)?;
                learner.joined.clear();
            } else if line.contains(" actor joined actor=") {
                learner.joined.insert(field(line, "incarnation").and_then(incarnation).with_context(read)?);
            } else if let Some((_, rest)) = line.split_once(" the budget is used up accounting=Accounting { produced: ")
            {
                at_end = rest.split(',').next().and_then(|produced| produced.parse().ok());
            }
        }
        learner.at_end = at_end.context("the learner's log has no accounting of its end")?;
        Ok(learner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line of the learner's log in this second.
    fn line(second: u64, text: &str) -> String {
        format!("2026-01-01T00:00:{second:02}.000000Z  INFO comic_learner: {text}\n")
    }

    const END: &str = "the budget is used up accounting=Accounting { produced: 520, trained: 256 }";

    #[test]
    fn a_log_has_the_last_start_and_what_it_began_with() {
        let log = [
            line(0, "serving address=127.0.0.1:7070 epoch=1 rank=0 run=/r"),
            line(1, "written checkpoint=/r/checkpoints/initial"),
            line(2, "actor joined actor=0 incarnation=00000000000000ff peer=None"),
            line(3, "written checkpoint=/r/checkpoints/checkpoint-0000000001"),
            line(6, "written checkpoint=/r/checkpoints/checkpoint-0000000002"),
            line(12, "resuming checkpoint=/r/checkpoints/checkpoint-0000000002"),
            line(13, "serving address=127.0.0.1:7070 epoch=2 rank=0 run=/r"),
            line(14, "actor joined actor=1 incarnation=9a1b620ae24aa948 peer=Some(127.0.0.1:9)"),
            line(15, "written checkpoint=/r/checkpoints/checkpoint-0000000003"),
            line(20, END),
        ];
        let found = Learner::of(&log.concat()).unwrap();
        let expected = Learner {
            starts: 2,
            epoch: 2,
            resumed: Some("/r/checkpoints/checkpoint-0000000002".into()),
            covered: Some("2026-01-01T00:00:03.000000Z".into()),
            joined: [0x9a1b_620a_e24a_a948].into(),
            at_end: 520,
        };
        assert_eq!(found, expected);
        // It was killed when the checkpoint was on disk, and before it said so.
        let killed_earlier = [&log[..4], &log[5..]].concat();
        assert_eq!(Learner::of(&killed_earlier.concat()).unwrap(), expected);
    }

    #[test]
    fn a_log_without_its_end_or_with_a_line_of_another_kind_is_refused() {
        let error = Learner::of(&line(0, "serving address=127.0.0.1:7070 epoch=1")).unwrap_err().to_string();
        assert!(error.contains("no accounting of its end"), "{error}");
        for wrong in ["serving address=127.0.0.1:7070", "actor joined actor=0", "actor joined actor=0 incarnation=z"] {
            let error = Learner::of(&[line(0, wrong), line(1, END)].concat()).unwrap_err().to_string();
            assert!(error.contains(wrong), "{error}");
        }
        let error = Learner::of(&format!("now written checkpoint=/r\n{}", line(1, END))).unwrap_err().to_string();
        assert!(error.contains("written checkpoint=/r"), "{error}");
    }
}
