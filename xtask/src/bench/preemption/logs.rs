//! What actors say in their logs about their unrolls.

use std::fs::File;
use std::io::{BufRead as _, BufReader};
use std::path::Path;

use anyhow::{Context, Result};

/// One process of an actor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Process {
    pub(super) incarnation: u64,
    /// Unrolls with a sequence number. It gives them before it sends them.
    pub(super) made: u64,
    /// The unrolls up to the last one that the learner acknowledged.
    pub(super) acknowledged: u64,
    /// Whether it ended by itself, and was not killed.
    pub(super) exited: bool,
}

/// The processes that wrote this log, one after the other. One that made no unroll is left out.
///
/// # Errors
/// The log cannot be read.
pub(super) fn processes(log: &Path) -> Result<Vec<Process>> {
    let file = File::open(log).with_context(|| format!("cannot read {}", log.display()))?;
    let mut processes: Vec<Process> = Vec::new();
    for line in BufReader::new(file).split(b'\n') {
        let line = line.with_context(|| format!("cannot read {}", log.display()))?;
        read_line(&String::from_utf8_lossy(&line), &mut processes);
    }
    processes.retain(|process| process.made > 0);
    Ok(processes)
}

fn read_line(line: &str, processes: &mut Vec<Process>) {
    // Each process says this once, before its first unroll.
    if line.contains(" acting experiment=") {
        processes.push(Process::default());
    }
    let Some(process) = processes.last_mut() else { return };
    if let Some((incarnation, sequence, event)) = unroll(line) {
        process.incarnation = incarnation;
        if event.starts_with("made") {
            process.made = process.made.max(sequence + 1);
        } else if event.starts_with("acknowledged") {
            process.acknowledged = process.acknowledged.max(sequence + 1);
        }
    } else if line.contains(" exiting steps=") {
        process.exited = true;
    }
}

/// Incarnation, sequence number and event of a line such as
/// `… DEBUG unroll{incarnation=9a1b620ae24aa948 sequence=0 version=1 environment=0}: made`.
fn unroll(line: &str) -> Option<(u64, u64, &str)> {
    let (_, rest) = line.split_once(" unroll{incarnation=")?;
    let (incarnation, rest) = rest.split_once(" sequence=")?;
    let (sequence, rest) = rest.split_once(' ')?;
    let (_, event) = rest.split_once("}: ")?;
    Some((u64::from_str_radix(incarnation, 16).ok()?, sequence.parse().ok()?, event))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_has_the_unrolls_of_each_process() {
        let unroll = |incarnation: &str, sequence: u64, event: &str| {
            format!(
                "2026-01-01T00:00:00Z DEBUG unroll{{incarnation={incarnation} sequence={sequence} version=1}}: {event}\n"
            )
        };
        let acting = "2026-01-01T00:00:00Z  INFO acting experiment=\"quickstart\" threads=1\n".to_owned();
        let exiting = "2026-01-01T00:00:00Z  INFO exiting steps=7990 settled=Settled { taken: 0 }\n".to_owned();
        let log = [
            acting.clone(),
            unroll("00000000000000ff", 0, "made"),
            unroll("00000000000000ff", 1, "made"),
            unroll("00000000000000ff", 0, "sent actor=1"),
            unroll("00000000000000ff", 0, "acknowledged verdict=Taken"),
            unroll("00000000000000ff", 0, "close time.busy=1µs time.idle=1ms"),
            acting.clone(),
            unroll("9a1b620ae24aa948", 0, "made"),
            unroll("9a1b620ae24aa948", 0, "acknowledged verdict=Stale"),
            exiting.clone(),
            // It came too late to make an unroll.
            acting,
            exiting,
        ];
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("actor-0.log");
        std::fs::write(&path, log.concat()).unwrap();
        let killed = Process { incarnation: 0xff, made: 2, acknowledged: 1, exited: false };
        let exited = Process { incarnation: 0x9a1b_620a_e24a_a948, made: 1, acknowledged: 1, exited: true };
        assert_eq!(processes(&path).unwrap(), [killed, exited]);
    }
}
