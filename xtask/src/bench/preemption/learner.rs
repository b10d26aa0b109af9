//! What the learner says in its log about its starts, its checkpoints and the actors that join.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
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
    /// When the snapshot of that checkpoint was taken: it has every unroll that was acknowledged earlier.
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
        // Of each checkpoint the time of its snapshot.
        let mut taken: BTreeMap<&str, &str> = BTreeMap::new();
        for line in log.lines() {
            let read = || format!("the learner's log: {line}");
            if let Some((_, name)) = line.split_once(" taking a snapshot checkpoint=") {
                taken.insert(name, time(line).with_context(read)?);
            } else if let Some((_, resumed)) = line.split_once(" resuming checkpoint=") {
                let resumed = PathBuf::from(resumed);
                let name = resumed.file_name().and_then(OsStr::to_str).unwrap_or_default();
                learner.covered = Some((*taken.get(name).with_context(read)?).to_owned());
                learner.resumed = Some(resumed);
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
            line(1, "taking a snapshot checkpoint=initial"),
            line(2, "actor joined actor=0 incarnation=00000000000000ff peer=None"),
            line(3, "taking a snapshot checkpoint=checkpoint-0000000001"),
            line(6, "taking a snapshot checkpoint=checkpoint-0000000002"),
            line(7, "written checkpoint=/r/checkpoints/checkpoint-0000000002"),
            line(9, "taking a snapshot checkpoint=checkpoint-0000000003"),
            line(12, "resuming checkpoint=/r/checkpoints/checkpoint-0000000002"),
            line(13, "serving address=127.0.0.1:7070 epoch=2 rank=0 run=/r"),
            line(14, "actor joined actor=1 incarnation=9a1b620ae24aa948 peer=Some(127.0.0.1:9)"),
            line(15, "taking a snapshot checkpoint=checkpoint-0000000003"),
            line(20, END),
        ];
        let found = Learner::of(&log.concat()).unwrap();
        let expected = Learner {
            starts: 2,
            epoch: 2,
            resumed: Some("/r/checkpoints/checkpoint-0000000002".into()),
            covered: Some("2026-01-01T00:00:06.000000Z".into()),
            joined: [0x9a1b_620a_e24a_a948].into(),
            at_end: 520,
        };
        assert_eq!(found, expected);
    }

    #[test]
    fn a_log_without_its_end_or_with_a_line_of_another_kind_is_refused() {
        let error = Learner::of(&line(0, "serving address=127.0.0.1:7070 epoch=1")).unwrap_err().to_string();
        assert!(error.contains("no accounting of its end"), "{error}");
        for wrong in [
            "serving address=127.0.0.1:7070",
            "actor joined actor=0",
            "actor joined actor=0 incarnation=z",
            "resuming checkpoint=/r/checkpoints/never-taken",
        ] {
            let error = Learner::of(&[line(0, wrong), line(1, END)].concat()).unwrap_err().to_string();
            assert!(error.contains(wrong), "{error}");
        }
        let error =
            Learner::of(&format!("now taking a snapshot checkpoint=a\n{}", line(1, END))).unwrap_err().to_string();
        assert!(error.contains("checkpoint=a"), "{error}");
    }
}
