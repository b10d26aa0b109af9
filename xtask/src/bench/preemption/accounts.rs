//! Where a run's unrolls went, by the learner's accounting and by the actors' own logs.

use std::collections::BTreeMap;
use std::fs;

use anyhow::{Context, Result, bail};
use serde::Deserialize;
use serde_json::json;

use super::logs::{self, Process};
use crate::metrics::{self, Accounting};
use crate::train::Job;

/// The unrolls of a finished run.
#[derive(Debug, Default)]
pub(super) struct Unrolls {
    /// Lines of metrics.
    lines: usize,
    /// What contradicts the accounting.
    faults: Vec<String>,
    /// The accounting of the last checkpoint.
    last: Accounting,
    /// Unrolls that the learner counted as produced when it ended: some arrive after the last checkpoint.
    at_end: u64,
    /// Actor processes that made an unroll.
    processes: usize,
    /// Unrolls that the actors made.
    made: u64,
    /// Not in the last checkpoint, but acknowledged to an actor that was not killed: the run was over.
    late: u64,
    /// Not in the last checkpoint, but acknowledged to an actor that was killed. If the learner was killed, too, and the actor
    /// before it had joined again, nobody could tell the new learner about them.
    forgotten: u64,
    /// Neither in the last checkpoint nor acknowledged: only the actor knew about them when it ended.
    unheard: u64,
}

/// `accounting.json` of a checkpoint.
#[derive(Deserialize)]
struct Ledger {
    accounting: Accounting,
    accounts: Vec<Account>,
}

/// What the learner knows of one actor process.
#[derive(Deserialize)]
struct Account {
    incarnation: u64,
    /// The number of its unrolls that are accounted for.
    next_sequence: u64,
}

impl Unrolls {
    /// Reads what a finished run has left.
    ///
    /// # Errors
    /// A file that is missing or cannot be read.
    pub(super) fn of(job: &Job) -> Result<Self> {
        let accountings = metrics::read(&job.metrics())?.into_iter().map(|line| line.accounting).collect::<Vec<_>>();
        let path = job.newest_checkpoint().context("the run has no checkpoint")?.join("accounting.json");
        let text = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let ledger = serde_json::from_slice(&text).with_context(|| path.display().to_string())?;
        let log = fs::read_to_string(job.learner_log()).context("cannot read the learner's log")?;
        let at_end = produced_at_end(&log).context("the learner's log has no accounting of its end")?;
        let mut processes = Vec::new();
        for log in job.actor_logs() {
            processes.extend(logs::processes(&log)?);
        }
        Ok(Self::count(&accountings, ledger, at_end, &processes))
    }

    /// Compares the accounting of each line of metrics and that of the last checkpoint with the actors' processes.
    fn count(lines: &[Option<Accounting>], ledger: Ledger, at_end: u64, processes: &[Process]) -> Self {
        let Ledger { accounting: last, accounts } = ledger;
        let mut unrolls = Self { lines: lines.len(), at_end, processes: processes.len(), last, ..Self::default() };
        for (number, accounting) in (1..).zip(lines) {
            match accounting {
                Some(accounting) if accounting.balances() => {}
                other => unrolls.faults.push(format!("line {number} of metrics.jsonl does not balance: {other:?}")),
            }
        }
        let (last, sum) = (&unrolls.last, accounts.iter().map(|account| account.next_sequence).sum::<u64>());
        let faults = [
            (!last.balances()).then(|| format!("the last checkpoint does not balance: {last:?}")),
            (sum != last.produced).then(|| format!("the accounts have {sum} unrolls in all, and the sum is {last:?}")),
        ];
        unrolls.faults.extend(faults.into_iter().flatten());
        let mut accounts: BTreeMap<u64, u64> =
            accounts.into_iter().map(|account| (account.incarnation, account.next_sequence)).collect();
        for process in processes {
            let counted = accounts.remove(&process.incarnation).unwrap_or_default();
            unrolls.add(process, counted);
        }
        for (incarnation, counted) in accounts.into_iter().filter(|(_, counted)| *counted > 0) {
            unrolls.faults.push(format!("{counted} unrolls are of the actor {incarnation:016x}, which has no log"));
        }
        unrolls
    }

    /// Adds the unrolls of a process of which the learner has counted so many.
    fn add(&mut self, process: &Process, counted: u64) {
        let Process { incarnation, made, acknowledged, exited } = *process;
        if counted > made {
            self.faults.push(format!("actor {incarnation:016x} made {made} unrolls, and {counted} are counted"));
        }
        self.made += made;
        let uncounted = acknowledged.saturating_sub(counted);
        *if exited { &mut self.late } else { &mut self.forgotten } += uncounted;
        self.unheard += made.saturating_sub(acknowledged.max(counted));
    }

    /// Prints a figure for what the accounting says, one for what was lost, and one for what it cannot know.
    pub(super) fn print(&self) {
        let Self { lines, last, at_end, processes, made, late, forgotten, unheard, .. } = self;
        let lost = last.dropped.get("lost_at_restart").copied().unwrap_or_default();
        let figures = [
            json!({
                "figure": "preemption.produced", "value": last.produced, "unit": "unrolls", "trained": last.trained,
                "dropped": last.dropped, "in_flight": last.in_flight, "lines_of_metrics": lines, "at_end": at_end,
            }),
            json!({ "figure": "preemption.lost_at_restart", "value": lost, "unit": "unrolls" }),
            json!({
                "figure": "preemption.made", "value": made, "unit": "unrolls", "processes": processes,
                "produced": last.produced, "late": late, "forgotten": forgotten, "unheard": unheard,
            }),
        ];
        figures.iter().for_each(|figure| println!("{figure}"));
    }

    /// Fails if an unroll is missing without a reason.
    ///
    /// # Errors
    /// What contradicts the accounting.
    pub(super) fn check(&self, learner_killed: bool) -> Result<()> {
        let mut faults = self.faults.clone();
        // A learner that lived through the run has an account of every actor.
        let acknowledged = self.late + if learner_killed { 0 } else { self.forgotten };
        let arrived = self.at_end.saturating_sub(self.last.produced);
        if acknowledged > arrived {
            faults.push(format!(
                "{acknowledged} unrolls were acknowledged and are not in the last checkpoint, and only {arrived} came after it"
            ));
        }
        if !faults.is_empty() {
            bail!("the accounting does not name every unroll:\n  {}", faults.join("\n  "));
        }
        Ok(())
    }
}

/// The unrolls that the learner counted when it ended, from its log.
fn produced_at_end(log: &str) -> Option<u64> {
    let (_, rest) = log.rsplit_once("the budget is used up accounting=Accounting { produced: ")?;
    rest.split(',').next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `produced` unrolls, of which ten are in flight and the others trained on.
    fn accounting(produced: u64) -> Accounting {
        Accounting { produced, trained: produced - 10, in_flight: 10, ..Accounting::default() }
    }

    fn ledger(accounts: &[(u64, u64)]) -> Ledger {
        let of = |&(incarnation, next_sequence): &(u64, u64)| Account { incarnation, next_sequence };
        let produced = accounts.iter().map(|(_, next)| next).sum();
        Ledger { accounting: accounting(produced), accounts: accounts.iter().map(of).collect() }
    }

    const KILLED: Process = Process { incarnation: 1, made: 50, acknowledged: 46, exited: false };
    const EXITED: Process = Process { incarnation: 2, made: 70, acknowledged: 69, exited: true };

    fn faults(unrolls: &Unrolls, learner_killed: bool) -> String {
        unrolls.check(learner_killed).err().map_or_else(String::new, |error| error.to_string())
    }

    #[test]
    fn every_unroll_that_was_made_is_counted_once() {
        // The learner has counted 47 unrolls of the killed one, whose last acknowledgement was lost, and 67 of the other.
        let found = Unrolls::count(&[Some(accounting(60))], ledger(&[(1, 47), (2, 67)]), 116, &[KILLED, EXITED]);
        assert_eq!((found.made, found.late, found.forgotten, found.unheard), (120, 2, 0, 4));
        assert_eq!(found.made, found.last.produced + found.late + found.forgotten + found.unheard);
        assert_eq!(faults(&found, false), "");
    }

    #[test]
    fn an_acknowledged_unroll_that_no_learner_has_counted_is_a_fault() {
        let found = Unrolls::count(&[], ledger(&[(1, 47), (2, 67)]), 115, &[KILLED, EXITED]);
        assert!(faults(&found, true).contains("2 unrolls were acknowledged"), "{found:?}");
    }

    #[test]
    fn what_a_killed_learner_acknowledged_to_a_killed_actor_is_forgotten_and_only_then() {
        let found = Unrolls::count(&[], ledger(&[(1, 40), (2, 69)]), 109, &[KILLED, EXITED]);
        assert_eq!((found.forgotten, found.unheard), (6, 5));
        assert_eq!(faults(&found, true), "");
        assert!(faults(&found, false).contains("6 unrolls were acknowledged"), "{found:?}");
    }

    #[test]
    fn accounts_that_contradict_themselves_or_the_actors_are_faults() {
        let unbalanced = Accounting { produced: 61, ..accounting(60) };
        let found = Unrolls::count(&[Some(unbalanced), None], ledger(&[(1, 47), (2, 67)]), 116, &[KILLED, EXITED]);
        assert!(faults(&found, false).contains("line 1 of metrics.jsonl"), "{found:?}");
        assert!(faults(&found, false).contains("line 2 of metrics.jsonl"), "{found:?}");
        let found = Unrolls::count(&[], ledger(&[(1, 51), (3, 9)]), 60, &[KILLED]);
        assert!(faults(&found, false).contains("made 50 unrolls, and 51 are counted"), "{found:?}");
        assert!(faults(&found, false).contains("0000000000000003, which has no log"), "{found:?}");
        let wrong_sum = Ledger { accounting: accounting(60), ..ledger(&[(1, 47)]) };
        assert!(faults(&Unrolls::count(&[], wrong_sum, 60, &[KILLED]), false).contains("47 unrolls in all"));
    }

    #[test]
    fn the_learners_last_line_says_what_it_counted() {
        let log = "2026-01-01T00:00:00Z  INFO comic_learner::run: the budget is used up accounting=Accounting { produced: 520, \
                   trained: 256 }\n";
        assert_eq!(produced_at_end(log), Some(520));
        assert_eq!(produced_at_end("stopped"), None);
    }
}
