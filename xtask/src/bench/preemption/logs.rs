//! What actors say in their logs about their unrolls.

use std::fs::File;
use std::io::{BufRead as _, BufReader};
use std::ops::Range;
use std::path::Path;

use anyhow::{Context, Result};

use super::learner::Learner;
use super::lines::{incarnation, number, time};

/// One process of an actor.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Process {
    pub(super) incarnation: u64,
    /// Its environments. Each begins a new unroll only when its last one is acknowledged.
    pub(super) environments: u64,
    /// Unrolls with a sequence number. It gives them before it sends them.
    pub(super) made: u64,
    /// One more than the number of the last one that the learner acknowledged.
    pub(super) acknowledged: u64,
    /// The numbers below it without an acknowledgement. The learner answers in the order of the numbers, so there is none.
    pub(super) gaps: Vec<Range<u64>>,
    /// The unrolls up to the last one that was acknowledged before the learner's last start.
    pub(super) by_former: u64,
    /// The unrolls up to the last one that was acknowledged before the snapshot was taken from which the learner was resumed.
    pub(super) covered: u64,
    /// Whether it ended by itself, and was not killed.
    pub(super) exited: bool,
    /// The unrolls that it had without acknowledgement when it ended by itself, as it says.
    pub(super) left: u64,
}

/// The processes that wrote this log, one after the other. One that made no unroll is left out.
///
/// # Errors
/// The log cannot be read.
pub(super) fn processes(log: &Path, learner: &Learner) -> Result<Vec<Process>> {
    let file = File::open(log).with_context(|| format!("cannot read {}", log.display()))?;
    let mut reader = Reader { learner, epoch: None, processes: Vec::new() };
    for line in BufReader::new(file).split(b'\n') {
        let line = line.with_context(|| format!("cannot read {}", log.display()))?;
        reader.read(&String::from_utf8_lossy(&line));
    }
    let mut processes = reader.processes;
    processes.retain(|process| process.made > 0);
    Ok(processes)
}

/// Reads a log line by line.
struct Reader<'a> {
    learner: &'a Learner,
    /// The epoch of the learner that an actor joined last. Each process joins before it makes an unroll.
    epoch: Option<u64>,
    processes: Vec<Process>,
}

impl Reader<'_> {
    fn read(&mut self, line: &str) {
        // Each process says this once, before its first unroll.
        if line.contains(" acting experiment=") {
            let environments = number(line, "environments").unwrap_or_default();
            self.processes.push(Process { environments, ..Process::default() });
        } else if line.contains(" joined the learner ") {
            self.epoch = number(line, "learner_epoch");
        }
        let Some(process) = self.processes.last_mut() else { return };
        if let Some((incarnation, sequence, event)) = unroll(line) {
            process.incarnation = incarnation;
            let end = sequence + 1;
            if event.starts_with("made") {
                process.made = process.made.max(end);
            } else if event.starts_with("acknowledged") {
                if sequence > process.acknowledged {
                    process.gaps.push(process.acknowledged..sequence);
                }
                process.acknowledged = process.acknowledged.max(end);
                if self.epoch.is_some_and(|epoch| epoch < self.learner.epoch) {
                    process.by_former = process.by_former.max(end);
                }
                // Both programs write times of one clock, as texts of one length.
                if let (Some(now), Some(covered)) = (time(line), &self.learner.covered)
                    && now < covered.as_str()
                {
                    process.covered = process.covered.max(end);
                }
            }
        } else if line.contains(" some unrolls were not acknowledged in time ") {
            process.left = number(line, "unrolls").unwrap_or_default();
        } else if line.contains(" exiting steps=") {
            process.exited = true;
        }
    }
}

/// Incarnation, sequence number and event of a line such as
/// `… DEBUG unroll{incarnation=9a1b620ae24aa948 sequence=0 version=1 environment=0}: made`.
fn unroll(line: &str) -> Option<(u64, u64, &str)> {
    let (_, rest) = line.split_once(" unroll{incarnation=")?;
    let (own, rest) = rest.split_once(" sequence=")?;
    let (sequence, rest) = rest.split_once(' ')?;
    let (_, event) = rest.split_once("}: ")?;
    Some((incarnation(own)?, sequence.parse().ok()?, event))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line of an actor's log in this second.
    fn line(second: u64, text: &str) -> String {
        format!("2026-01-01T00:00:{second:02}.000000Z  INFO {text}\n")
    }

    fn unroll(second: u64, incarnation: &str, sequence: u64, event: &str) -> String {
        line(second, &format!("unroll{{incarnation={incarnation} sequence={sequence} version=1}}: {event}"))
    }

    fn read(log: &[String], learner: &Learner) -> Vec<Process> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("actor-0.log");
        std::fs::write(&path, log.concat()).unwrap();
        processes(&path, learner).unwrap()
    }

    const ACTING: &str = "acting experiment=\"quickstart\" threads=1 environments=4 pace=Free";
    const JOINED: &str = "joined the learner actor=0 learner_epoch=1";
    const JOINED_AGAIN: &str = "joined the learner actor=0 learner_epoch=2";
    const EXITING: &str = "exiting steps=7990 settled=Settled { taken: 0 }";

    #[test]
    fn a_log_has_the_unrolls_of_each_process() {
        let (one, other) = ("00000000000000ff", "9a1b620ae24aa948");
        let log = [
            line(0, JOINED),
            line(0, ACTING),
            unroll(0, one, 0, "made"),
            unroll(0, one, 1, "made"),
            unroll(0, one, 0, "sent actor=1"),
            unroll(0, one, 0, "acknowledged verdict=Taken"),
            unroll(0, one, 0, "close time.busy=1µs time.idle=1ms"),
            line(1, JOINED),
            line(1, ACTING),
            unroll(1, other, 0, "made"),
            unroll(1, other, 0, "acknowledged verdict=Stale"),
            unroll(1, other, 1, "made"),
            line(2, "some unrolls were not acknowledged in time unrolls=1"),
            line(2, EXITING),
            // It came too late to make an unroll.
            line(3, JOINED),
            line(3, ACTING),
            line(3, EXITING),
        ];
        let common = Process { environments: 4, made: 2, acknowledged: 1, ..Process::default() };
        let killed = Process { incarnation: 0xff, ..common.clone() };
        let exited = Process { incarnation: 0x9a1b_620a_e24a_a948, exited: true, left: 1, ..common };
        assert_eq!(read(&log, &Learner { epoch: 1, ..Learner::default() }), [killed, exited]);
    }

    #[test]
    fn an_acknowledgement_is_of_the_learner_that_was_joined_last() {
        let (one, other) = ("00000000000000ff", "9a1b620ae24aa948");
        let acknowledged = |second, sequence| unroll(second, one, sequence, "acknowledged verdict=Taken");
        let mut log = vec![line(0, JOINED), line(0, ACTING)];
        log.extend((0..9).map(|sequence| unroll(0, one, sequence, "made")));
        log.extend([acknowledged(1, 0), acknowledged(3, 1), acknowledged(5, 2)]);
        // One that was lost in between would not be seen in the largest number.
        log.extend([line(20, JOINED_AGAIN), acknowledged(21, 3), acknowledged(22, 5)]);
        // The next process joined before it said that it acts.
        log.extend([line(30, JOINED_AGAIN), line(30, ACTING), unroll(31, other, 0, "made")]);
        log.push(unroll(31, other, 0, "acknowledged verdict=Taken"));
        let covered = Some("2026-01-01T00:00:04.000000Z".to_owned());
        let found = read(&log, &Learner { epoch: 2, covered, ..Learner::default() });
        assert_eq!(found[0].acknowledged, 6);
        assert_eq!(found[0].gaps, vec![Range { start: 4, end: 5 }]);
        assert_eq!((found[0].by_former, found[0].covered), (3, 2));
        assert_eq!((found[1].by_former, found[1].covered), (0, 0));
    }
}
