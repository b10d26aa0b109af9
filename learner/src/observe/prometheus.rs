//! Every counter, gauge and histogram that `/metrics` shows, each with its name and meaning.
//!
//! One registration gives the metric, its help text and its line of `docs/metrics.md` (`comic-learner metrics` prints
//! that page). Counters begin at 0 when the process starts, except those of the accounting, which continue over the whole run.

use std::fmt::Write as _;
use std::sync::atomic::Ordering;
use std::time::Duration;

use comic_replay::AccountingByTask;
use parking_lot::Mutex;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};

use crate::algorithm::replay::ReplayReport;
use crate::error::{Error, Result};
use crate::observe::catalogue::{Catalogue, Description, Labelled, TASKS};
use crate::observe::metrics_file::Waited;
use crate::observe::window::Rows;

/// How many versions old the unrolls of the newest update were.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Ages {
    pub(crate) median: u64,
    pub(crate) p99: u64,
    pub(crate) max: u64,
}

/// The metrics of one learner process.
#[derive(Debug)]
pub struct Prometheus {
    catalogue: Catalogue,
    ages: Mutex<Ages>,
    pub(crate) updates: Counter,
    pub(crate) updates_skipped: Counter,
    pub(crate) restores: Counter,
    pub(crate) gradient_steps: Counter,
    waited: Labelled<Gauge>,
    replay: ReplayGauges,
    compilations: Counter,
    pub(crate) update_seconds: Histogram,
    pub(crate) unroll_age: Histogram,
    pub(crate) unroll_bytes: Histogram,
    pub(crate) unrolls_late: Counter,
    environment_steps: Counter,
    task_steps: Labelled<Counter>,
    task_rows: Labelled<Counter>,
    task_padding: Labelled<Counter>,
    pub(crate) episodes_diverged: Counter,
    pub(crate) evaluations: Counter,
    pub(crate) checkpoints: Labelled<Counter>,
    pub(crate) joins: Labelled<Counter>,
    pub(crate) rank: Gauge,
    pub(crate) connections: Gauge,
    pub(crate) connections_refused: Labelled<Counter>,
    pub(crate) requests: Gauge,
    pub(crate) requests_refused: Labelled<Counter>,
    pub(crate) quarantined: Labelled<Counter>,
    sampled: Sampled,
}

/// Metrics that are counted elsewhere and read for each request.
#[derive(Debug)]
struct Sampled {
    produced: Counter,
    trained: Counter,
    dropped: Labelled<Counter>,
    duplicates: Counter,
    unattributed: Counter,
    in_flight: Gauge,
    capacity: Gauge,
    waiting: Gauge,
    ingest: Gauge,
    actors: Labelled<Gauge>,
    version: Gauge,
    epoch: Gauge,
    silence: Gauge,
    memory: Gauge,
    tasks: SampledTasks,
}

/// The state of a replay.
#[derive(Debug)]
struct ReplayGauges {
    size: Gauge,
    inserted: Gauge,
    sampled: Gauge,
    evicted: Gauge,
    age: Gauge,
}

/// The accounting of each task.
#[derive(Debug)]
struct SampledTasks {
    produced: Labelled<Counter>,
    trained: Labelled<Counter>,
    dropped: Labelled<Counter>,
    in_flight: Labelled<Gauge>,
}

impl Sampled {
    fn new(catalogue: &mut Catalogue) -> Self {
        Self {
            produced: catalogue.counter("comic_unrolls_produced", "Unrolls that the actors made, by their sequence numbers, over the whole run"),
            trained: catalogue.counter("comic_unrolls_trained", "Unrolls trained on, over the whole run"),
            dropped: catalogue.labelled(
                "counter",
                ("comic_unrolls_dropped", "reason"),
                &["stale", "invalid", "superseded", "lost_at_restart"],
                "Unrolls that will never be trained on, over the whole run",
            ),
            duplicates: catalogue.counter("comic_unrolls_duplicate", "Messages that repeated an unroll already accounted for, over the whole run"),
            unattributed: catalogue.counter("comic_unrolls_unattributed", "Messages refused that belong to no account, over the whole run"),
            in_flight: catalogue.gauge("comic_unrolls_in_flight", "Unrolls in a batch that is open, full, or being trained on"),
            capacity: catalogue.gauge("comic_unrolls_capacity", "Unrolls that the batches have room for"),
            waiting: catalogue.gauge("comic_unrolls_waiting", "Unrolls that wait for a place in a batch. Above 0, the learner is slower than its actors"),
            ingest: catalogue.gauge("comic_ingest_bytes", "Bytes of messages that were read and are not in a batch yet, at most --max-ingest-bytes"),
            actors: catalogue.labelled(
                "gauge",
                ("comic_actors", "state"),
                &["alive", "slow", "lost"],
                "Actors: connected; connected and silent for a minute while the learner waits; gone within the last ten minutes",
            ),
            version: catalogue.gauge("comic_parameters_version", "Newest published version of the parameters"),
            epoch: catalogue.gauge("comic_learner_epoch", "How often the learner was started for this run"),
            silence: catalogue.gauge("comic_trainer_silent_seconds", "Seconds since the trainer last moved: a gradient step, or the look for a batch. Above 900, /healthz fails"),
            memory: catalogue.gauge("process_resident_memory_bytes", "Resident memory of the learner process in bytes"),
            tasks: SampledTasks {
                produced: catalogue.of_tasks("counter", "comic_task_unrolls_produced", "Unrolls of the task that were accepted or dropped, over the whole run"),
                trained: catalogue.of_tasks("counter", "comic_task_unrolls_trained", "Unrolls of the task trained on, over the whole run"),
                dropped: catalogue.of_tasks("counter", "comic_task_unrolls_dropped", "Unrolls of the task that will never be trained on, over the whole run; unrolls without a known task are only in comic_unrolls_dropped"),
                in_flight: catalogue.of_tasks("gauge", "comic_task_unrolls_in_flight", "Unrolls of the task in a batch that is open, full, or being trained on"),
            },
        }
    }
}

/// The values that [`Prometheus::page`] gets from other modules.
#[derive(Debug)]
pub(crate) struct Sample {
    pub(crate) accounting: AccountingByTask,
    pub(crate) capacity: u64,
    pub(crate) waiting: u64,
    pub(crate) ingest: u64,
    pub(crate) actors: [(&'static str, u64); 3],
    pub(crate) version: u64,
    pub(crate) epoch: u64,
    pub(crate) silence: Duration,
}

impl Default for Prometheus {
    fn default() -> Self {
        let mut catalogue = Catalogue::default();
        let all = &mut catalogue;
        Self {
            updates: all.counter("comic_updates", "Batches that were trained on, or inserted into a replay"),
            updates_skipped: all.counter(
                "comic_updates_skipped",
                "Gradient steps that changed nothing, because a loss or gradient was not finite",
            ),
            restores: all.counter(
                "comic_restores",
                "Returns to the last good state, after learner.restore_after skipped gradient steps in a row",
            ),
            gradient_steps: all.counter("comic_gradient_steps", "Gradient steps, those that were skipped included"),
            waited: all.labelled(
                "gauge",
                ("comic_waited_seconds", "side"),
                &["learner", "unrolls"],
                "Seconds since the start in which the trainer waited for unrolls, and unrolls for a place in a batch, each for itself",
            ),
            replay: ReplayGauges {
                size: all.gauge("comic_replay_size", "Unrolls in the replay's table; 0 without a replay, as the next four"),
                inserted: all.gauge("comic_replay_inserted", "Unrolls inserted into the table"),
                sampled: all.gauge("comic_replay_sampled", "Unrolls sampled from the table; one counts each time"),
                evicted: all.gauge("comic_replay_evicted", "Unrolls that left the table because it was full, the oldest first"),
                age: all.gauge("comic_replay_sample_age", "Mean number of unrolls inserted after one that is sampled"),
            },
            compilations: all.counter(
                "comic_compilations",
                "Programs that XLA compiled. It stops growing when every shape was seen, and is 0 on other devices",
            ),
            update_seconds: all.histogram(
                "comic_update_seconds",
                "Seconds of an update: tensors, gradient steps, publication",
                exponential_buckets(0.001, 2.0, 18),
            ),
            unroll_age: all.histogram(
                "comic_unroll_age_versions",
                "Versions that were published after the one an unroll was made with, when it is trained on",
                [0.0, 1.0, 2.0, 3.0, 5.0, 8.0, 13.0, 21.0, 34.0, 55.0, 89.0, 144.0],
            ),
            unroll_bytes: all.histogram(
                "comic_unroll_bytes",
                "Bytes of an unroll's payload, refused ones included",
                exponential_buckets(1024.0, 4.0, 9),
            ),
            unrolls_late: all.counter(
                "comic_unrolls_late",
                "Unrolls that were given up because they were not complete ten seconds after they began and others waited for their room",
            ),
            environment_steps: all.counter("comic_environment_steps", "Environment steps trained on"),
            task_steps: all.of_tasks("counter", "comic_task_environment_steps", "Environment steps of the task trained on"),
            task_rows: all.of_tasks("counter", "comic_task_rows", "Rows of the task's unrolls that were trained on"),
            task_padding: all.of_tasks("counter", "comic_task_padding_rows", "Rows of these unrolls that are padding, because the next episode belongs to another task"),
            episodes_diverged: all.counter(
                "comic_episodes_diverged",
                "Episodes trained on that ended because the simulation diverged; see comic-actor --dump-diverged",
            ),
            evaluations: all.counter("comic_evaluations", "Evaluations that actors reported"),
            checkpoints: all.labelled(
                "counter",
                ("comic_checkpoints", "result"),
                &["written", "failed"],
                "Checkpoints by result. After a failure training continues, and the next checkpoint is tried",
            ),
            joins: all.labelled(
                "counter",
                ("comic_joins", "result"),
                &["joined", "elsewhere", "full", "draining", "limited", "refused"],
                "Attempts to join, reconnections included: accepted, sent to another learner of the run, refused because --max-actors are present, because the \
                 learner is going down or because the name joins too often, refused for good",
            ),
            rank: all.gauge("comic_rank", "Which of the learners of its run this is. Rank 0 writes the checkpoints"),
            connections: all.gauge("comic_connections", "Connections that are open"),
            connections_refused: all.labelled(
                "counter",
                ("comic_connections_refused", "reason"),
                &["per_address", "total", "tls", "unauthenticated"],
                "Connections closed: at once beyond --max-connections-per-address, beyond the limit on all connections or without \
                 agreement on TLS; and without an accepted call within --authentication-timeout",
            ),
            requests: all.gauge("comic_requests", "Calls in flight, streams included"),
            requests_refused: all.labelled(
                "counter",
                ("comic_requests_refused", "reason"),
                &["unauthenticated", "overloaded"],
                "Calls refused: no accepted token, or --max-requests in flight",
            ),
            quarantined: all.labelled(
                "counter",
                ("comic_quarantined", "result"),
                &["kept", "full", "busy", "failed"],
                "Invalid unrolls with --quarantine, by result: on disk, beyond --quarantine-bytes, too many at once, not written",
            ),
            sampled: Sampled::new(all),
            catalogue,
            ages: Mutex::default(),
        }
    }
}

impl Prometheus {
    /// Counts an update that took `duration` on unrolls of these ages.
    pub fn count_update(&self, duration: Duration, mut ages: Vec<u64>) {
        self.updates.inc();
        self.update_seconds.observe(duration.as_secs_f64());
        for age in &ages {
            self.unroll_age.observe(*age as f64);
        }
        ages.sort_unstable();
        let at = |percent: usize| ages.get(ages.len().saturating_sub(1) * percent / 100).copied().unwrap_or_default();
        *self.ages.lock() = Ages { median: at(50), p99: at(99), max: at(100) };
    }

    /// Counts the rows of a task that were trained on.
    pub(crate) fn count_rows(&self, task: &str, counted: Rows) {
        self.environment_steps.inc_by(counted.environment_steps);
        if let Some(task) = TASKS.iter().find(|name| **name == task) {
            self.task_steps.of(task).inc_by(counted.environment_steps);
            self.task_rows.of(task).inc_by(counted.rows);
            self.task_padding.of(task).inc_by(counted.padding);
        }
    }

    /// Shows the state of the replay.
    pub(crate) fn set_replay(&self, report: &ReplayReport) {
        let ReplayGauges { size, inserted, sampled, evicted, age } = &self.replay;
        for (gauge, value) in [
            (size, report.size),
            (inserted, report.inserted),
            (sampled, report.sampled),
            (evicted, report.evicted),
            (age, report.sample_age.unwrap_or_default() as u64),
        ] {
            gauge.set(value as i64);
        }
    }

    /// Shows how long each side has waited.
    pub(crate) fn set_waited(&self, waited: Waited) {
        self.waited.of("learner").set(waited.learner as i64);
        self.waited.of("unrolls").set(waited.unrolls as i64);
    }

    /// Sets the number of compiled programs.
    pub(crate) fn count_compilations(&self, compiled: u64) {
        self.compilations.inc_by(compiled.saturating_sub(self.compilations.get()));
    }

    /// The ages of the newest update's unrolls.
    pub(crate) fn ages(&self) -> Ages {
        *self.ages.lock()
    }

    /// The page for Prometheus, in the OpenMetrics text format.
    pub(crate) fn page(&self, sample: &Sample) -> String {
        let Sampled { produced, trained, dropped, duplicates, unattributed, in_flight, .. } = &self.sampled;
        let accounting = sample.accounting.all;
        for (counter, value) in [
            (produced, accounting.produced),
            (trained, accounting.trained),
            (duplicates, accounting.duplicates),
            (unattributed, accounting.unattributed),
            (&dropped.of("stale"), accounting.dropped.stale),
            (&dropped.of("invalid"), accounting.dropped.invalid),
            (&dropped.of("superseded"), accounting.dropped.superseded),
            (&dropped.of("lost_at_restart"), accounting.dropped.lost_at_restart),
        ] {
            counter.inner().store(value, Ordering::Relaxed);
        }
        for (gauge, value) in [
            (in_flight, accounting.in_flight),
            (&self.sampled.capacity, sample.capacity),
            (&self.sampled.waiting, sample.waiting),
            (&self.sampled.ingest, sample.ingest),
            (&self.sampled.version, sample.version),
            (&self.sampled.epoch, sample.epoch),
            (&self.sampled.silence, sample.silence.as_secs()),
            (&self.sampled.memory, resident_bytes()),
        ] {
            gauge.set(value as i64);
        }
        for (task, accounting) in TASKS.iter().filter_map(|task| Some((task, sample.accounting.tasks.get(*task)?))) {
            let SampledTasks { produced, trained, dropped, in_flight } = &self.sampled.tasks;
            for (counter, value) in
                [(produced, accounting.produced), (trained, accounting.trained), (dropped, accounting.dropped.total())]
            {
                counter.of(task).inner().store(value, Ordering::Relaxed);
            }
            in_flight.of(task).set(accounting.in_flight as i64);
        }
        for (state, actors) in sample.actors {
            self.sampled.actors.of(state).set(actors as i64);
        }
        let mut page = String::new();
        // Writing to a string cannot fail.
        let _ = encode(&mut page, &self.catalogue.registry);
        page
    }

    /// Every name that `/metrics` shows.
    pub fn names(&self) -> Vec<String> {
        let expand = |metric: &Description| match metric.kind {
            "counter" => vec![format!("{}_total", metric.name)],
            "histogram" => ["bucket", "sum", "count"].map(|part| format!("{}_{part}", metric.name)).into(),
            _ => vec![metric.name.to_owned()],
        };
        self.catalogue.descriptions.iter().flat_map(expand).collect()
    }

    /// The reference page, in Markdown.
    pub fn reference(&self) -> String {
        let mut page = String::from(REFERENCE);
        for Description { name, kind, label, values, help } in &self.catalogue.descriptions {
            let name = if *kind == "counter" { format!("{name}_total") } else { (*name).to_owned() };
            let label = label.map_or_else(String::new, |label| format!("`{label}`: {}", values.join(", ")));
            let _ = writeln!(page, "| `{name}` | {kind} | {label} | {help} |");
        }
        page
    }
}

const REFERENCE: &str = "\
# Metrics

The metrics that `comic-learner --metrics-port PORT` shows at `/metrics`, in the OpenMetrics text format. This page is the output of
`comic-learner metrics > docs/metrics.md`, and a test compares the two. Counters begin at 0 when the process starts, unless
their meaning says \"over the whole run\". A histogram `NAME` is `NAME_bucket`, `NAME_sum` and `NAME_count`.

| name | kind | label | meaning |
| --- | --- | --- | --- |
";

/// The resident memory of this process as Linux reports it; 0 on other systems.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
    kilobytes.unwrap_or_default() * 1024
}

/// Prints [`Prometheus::reference`].
///
/// # Errors
/// When stdout refuses.
pub fn print_reference() -> Result<()> {
    let page = Prometheus::default().reference();
    let written = std::io::Write::write_all(&mut std::io::stdout(), page.as_bytes());
    written.map_err(Error::system("cannot write to stdout"))
}
