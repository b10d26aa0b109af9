//! Where a run's unrolls went, by the learner's accounting and by the actors' own logs.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use anyhow::{Context, Result, bail};
use serde::Deserialize;
use serde_json::json;

use super::learner::Learner;
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
    /// How often the learner was started.
    starts: usize,
    /// The accounting of the last checkpoint.
    last: Accounting,
    /// Unrolls that the learner counted as produced when it ended: some arrive after the last checkpoint.
    at_end: u64,
    /// Actor processes that made an unroll.
    processes: usize,
    /// Unrolls that the actors made.
    made: u64,
    /// Not in the last checkpoint, but acknowledged by a learner that knows the actor process: the run was over.
    late: u64,
    /// Not in the last checkpoint, but acknowledged by the learner that was killed, to an actor process that was killed before
    /// it had joined again. Nobody could tell the new learner about them.
    forgotten: u64,
    /// Neither in the last checkpoint nor acknowledged: only the actor knew about them when it ended.
    unheard: u64,
    /// Lost at restart by what the logs say: the unrolls in flight in the checkpoint from which the learner was resumed, and
    /// those that the killed learner acknowledged after it and that the new one counted.
    explained: u64,
}

/// `accounting.json` of a checkpoint.
#[derive(Default, Deserialize)]
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

impl Ledger {
    fn read(checkpoint: &Path) -> Result<Self> {
        let path = checkpoint.join("accounting.json");
        let text = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
        serde_json::from_slice(&text).with_context(|| path.display().to_string())
    }

    /// The numbers of unrolls that are accounted for, by incarnation.
    fn counted(&self) -> BTreeMap<u64, u64> {
        self.accounts.iter().map(|account| (account.incarnation, account.next_sequence)).collect()
    }
}

fn lost_at_restart(accounting: &Accounting) -> u64 {
    accounting.dropped.get("lost_at_restart").copied().unwrap_or_default()
}

impl Unrolls {
    /// Reads what a finished run has left.
    ///
    /// # Errors
    /// A file that is missing or cannot be read.
    pub(super) fn of(job: &Job) -> Result<Self> {
        let lines = metrics::read(&job.metrics())?;
        let last = Ledger::read(&job.newest_checkpoint().context("the run has no checkpoint")?)?;
        let learner = Learner::of(&fs::read_to_string(job.learner_log()).context("cannot read the learner's log")?)?;
        // A learner that was killed before its first checkpoint has begun anew, with no account.
        let resumed = learner.resumed.as_deref().map(Ledger::read).transpose();
        let resumed = resumed.context("the learner was resumed from this checkpoint, so it has to be kept")?;
        let mut processes = Vec::new();
        for log in job.actor_logs() {
            processes.extend(logs::processes(&log, &learner)?);
        }
        let mut unrolls = Self {
            lines: lines.len(),
            starts: learner.starts,
            at_end: learner.at_end,
            processes: processes.len(),
            ..Self::default()
        };
        for (number, line) in (1..).zip(lines) {
            unrolls.expect_balance(&format!("line {number} of metrics.jsonl"), line.accounting.as_ref());
        }
        unrolls.count(last, resumed.unwrap_or_default(), &learner, &processes);
        Ok(unrolls)
    }

    fn expect_balance(&mut self, what: &str, accounting: Option<&Accounting>) {
        if !accounting.is_some_and(Accounting::balances) {
            self.faults.push(format!("{what} does not balance: {accounting:?}"));
        }
    }

    /// Compares the last checkpoint and the one from which the learner was resumed with the actors' processes.
    fn count(&mut self, last: Ledger, resumed: Ledger, learner: &Learner, processes: &[Process]) {
        self.expect_balance("the last checkpoint", Some(&last.accounting));
        let sum = last.accounts.iter().map(|account| account.next_sequence).sum::<u64>();
        if sum != last.accounting.produced {
            self.faults.push(format!("the accounts have {sum} unrolls in all, and the sum is {:?}", last.accounting));
        }
        match lost_at_restart(&resumed.accounting) {
            0 => {}
            lost => self.faults.push(format!("{lost} unrolls were lost at restart before the learner was killed")),
        }
        // The new learner has no copy of them.
        self.explained = resumed.accounting.in_flight;
        let (mut accounts, former) = (last.counted(), resumed.counted());
        for process in processes {
            let counted = accounts.remove(&process.incarnation).unwrap_or_default();
            let before = former.get(&process.incarnation).copied().unwrap_or_default();
            self.contradictions(process, before, counted);
            self.add(process, before, counted, learner.joined.contains(&process.incarnation));
        }
        for (incarnation, counted) in accounts.into_iter().filter(|(_, counted)| *counted > 0) {
            self.faults.push(format!("{counted} unrolls are of the actor {incarnation:016x}, which has no log"));
        }
        self.last = last.accounting;
    }

    /// Names what cannot be true of a process of which the learner had counted `before` unrolls when it was resumed, and
    /// `counted` in the last checkpoint.
    fn contradictions(&mut self, process: &Process, before: u64, counted: u64) {
        let Process { incarnation, environments, made, acknowledged, ref gaps, covered, exited, left, .. } = *process;
        let mut fault = |text: String| self.faults.push(format!("actor {incarnation:016x} {text}"));
        if counted > made {
            fault(format!("made {made} unrolls, and {counted} are counted"));
        }
        // An actor sends its unrolls in order, also again after a restart, and the learner answers in that order.
        for gap in gaps {
            fault(format!("has later acknowledgements, and none of the unrolls {} to {}", gap.start, gap.end - 1));
        }
        let unanswered = made.saturating_sub(acknowledged);
        if unanswered > environments {
            fault(format!(
                "ended with {unanswered} unrolls without acknowledgement, and has {environments} environments"
            ));
        }
        if exited && unanswered != left {
            fault(format!("ended with {unanswered} unrolls without acknowledgement, and says that there were {left}"));
        }
        if before < covered {
            fault(format!(
                "had {covered} acknowledged unrolls before the snapshot was taken from which the learner was resumed, which has \
                 {before}"
            ));
        }
        if counted < before {
            fault(format!(
                "had {before} unrolls when the learner was resumed, and has {counted} in the last checkpoint"
            ));
        }
    }

    /// Adds the unrolls of a process. `joined` says whether the learner's last process knows it.
    fn add(&mut self, process: &Process, before: u64, counted: u64, joined: bool) {
        let Process { made, acknowledged, by_former, exited, .. } = *process;
        self.made += made;
        // These were not sent again, so the new learner has counted them without having them.
        self.explained += by_former.min(counted).saturating_sub(before);
        let forgettable = if joined || exited { 0 } else { by_former };
        self.forgotten += forgettable.saturating_sub(counted);
        self.late += acknowledged.saturating_sub(counted.max(forgettable));
        self.unheard += made.saturating_sub(acknowledged.max(counted));
    }

    /// Prints a figure for what the accounting says, one for what was lost, and one for what it cannot know.
    pub(super) fn print(&self) {
        let Self { lines, last, at_end, processes, made, late, forgotten, unheard, explained, .. } = self;
        let figures = [
            json!({
                "figure": "preemption.produced", "value": last.produced, "unit": "unrolls", "trained": last.trained,
                "dropped": last.dropped, "in_flight": last.in_flight, "lines_of_metrics": lines, "at_end": at_end,
            }),
            json!({
                "figure": "preemption.lost_at_restart", "value": lost_at_restart(last), "unit": "unrolls",
                "explained": explained,
            }),
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
        let Self { starts, at_end, last, late, explained, .. } = self;
        let mut faults = self.faults.clone();
        if *starts != 1 + usize::from(learner_killed) {
            faults.push(format!("the learner was started {starts} times"));
        }
        let arrived = at_end.saturating_sub(last.produced);
        if *late > arrived {
            faults.push(format!(
                "{late} unrolls were acknowledged and are not in the last checkpoint, and only {arrived} came after it"
            ));
        }
        // The learner counts every number that it never sees as lost at restart, whatever the reason.
        let lost = lost_at_restart(last);
        if lost != *explained {
            faults
                .push(format!("{lost} unrolls are counted as lost at restart, and by the logs there are {explained}"));
        }
        if !faults.is_empty() {
            bail!("the accounting does not name every unroll:\n  {}", faults.join("\n  "));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
