//! Evaluations between the actors that report them and the trainer.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use comic_proto::v1::EvaluationReport;
use parking_lot::Mutex;
use serde_json::Value;
use tonic::Status;

use crate::observe::evaluation::Evaluation;
use crate::quota::Quota;

/// Evaluations that may wait for the trainer. Each is at most as large as a message.
const CAPACITY: usize = 4;

/// Evaluations that are accepted at once, and then one in each interval. An evaluation takes an evaluator at least as long, and
/// a run has a few evaluators. Each evaluation adds up to a message to the run's directory.
const AT_ONCE: u32 = 32;
/// See [`AT_ONCE`].
const INTERVAL: Duration = Duration::from_secs(5);
/// What rounding may add to a mean.
const ROUNDING: f64 = 1e-6;

/// A bounded queue of evaluations; a handle that can be cloned.
#[derive(Clone, Debug)]
pub struct Evaluations {
    /// The run that they must be of.
    run: u64,
    waiting: Arc<Mutex<VecDeque<Evaluation>>>,
    quota: Arc<Quota<()>>,
}

impl Evaluations {
    /// An empty queue of this run.
    pub(super) fn new(run: u64) -> Self {
        Self { run, waiting: Arc::default(), quota: Arc::new(Quota::new(AT_ONCE, INTERVAL)) }
    }

    /// Adds an evaluation that an actor reports.
    ///
    /// # Errors
    /// A report that is wrong, or one too many; nothing is added then.
    pub fn report(&self, report: EvaluationReport) -> Result<(), Status> {
        let EvaluationReport { learner_epoch: epoch, version, updates, json, run, environment_steps, seconds, film } =
            report;
        if run != Some(self.run) {
            let status = "the evaluation is not of this run: evaluate a checkpoint that this run has written";
            return Err(Status::invalid_argument(status));
        }
        check_reward(&json)?;
        let mut waiting = self.waiting.lock();
        if waiting.len() >= CAPACITY {
            let status = "too many evaluations wait for the trainer: report this one later";
            return Err(Status::resource_exhausted(status));
        }
        if !self.quota.take(()) {
            let per_minute = 60 / INTERVAL.as_secs();
            let status = format!("more than {per_minute} evaluations a minute were reported: report this one later");
            return Err(Status::resource_exhausted(status));
        }
        waiting.push_back(Evaluation {
            run: self.run,
            epoch,
            version,
            updates,
            environment_steps,
            seconds,
            json,
            film,
        });
        Ok(())
    }

    /// Takes all evaluations that wait, oldest first.
    pub fn take(&self) -> Vec<Evaluation> {
        self.waiting.lock().drain(..).collect()
    }
}

/// A normalised reward is a share of what the task can pay at most. A larger one would keep its checkpoint the best for ever.
fn check_reward(json: &str) -> Result<(), Status> {
    let report: Value = serde_json::from_str(json)
        .map_err(|error| Status::invalid_argument(format!("the report is no JSON: {error}")))?;
    match &report["overall"]["normalised_reward"] {
        // The report of no episode has none.
        Value::Null => Ok(()),
        reward if reward.as_f64().is_some_and(|reward| reward <= 1.0 + ROUNDING) => Ok(()),
        reward => Err(Status::invalid_argument(format!(
            "overall.normalised_reward is {reward}, but no task pays more than 1: run actor and learner from the same release"
        ))),
    }
}
