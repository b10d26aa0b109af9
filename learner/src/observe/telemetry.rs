//! Every counter, gauge and histogram that `/metrics` shows, each with its name and what it means.
//!
//! One registration gives the metric, its help text and its line of `docs/metrics.md` (`comic-learner metrics` prints
//! that page). Counters begin at 0 when the process starts, except those of the accounting, which go on with the run.

use std::fmt::Write as _;
use std::sync::atomic::Ordering;
use std::time::Duration;

use comic_experiment::TaskName;
use comic_replay::AccountingByTask;
use parking_lot::Mutex;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{Metric, Registry};

use crate::error::{Error, Result};
use crate::observe::metrics::Rows;

/// One label and its value.
type Label = [(&'static str, &'static str); 1];

/// What is known about a metric.
#[derive(Debug)]
struct Description {
    name: &'static str,
    kind: &'static str,
    label: Option<&'static str>,
    values: &'static [&'static str],
    help: &'static str,
}

#[derive(Debug, Default)]
struct Catalogue {
    registry: Registry,
    descriptions: Vec<Description>,
}

impl Catalogue {
    fn add<M: Metric + Clone>(&mut self, kind: &'static str, name: &'static str, help: &'static str, metric: M) -> M {
        self.registry.register(name, help, metric.clone());
        self.descriptions.push(Description { name, kind, label: None, values: &[], help });
        metric
    }

    fn counter(&mut self, name: &'static str, help: &'static str) -> Counter {
        self.add("counter", name, help, Counter::default())
    }

    fn gauge(&mut self, name: &'static str, help: &'static str) -> Gauge {
        self.add("gauge", name, help, Gauge::default())
    }

    fn histogram(
        &mut self,
        name: &'static str,
        help: &'static str,
        buckets: impl IntoIterator<Item = f64>,
    ) -> Histogram {
        self.add("histogram", name, help, Histogram::new(buckets))
    }

    /// One metric for each value of a label; all of them are there from the beginning.
    fn labelled<M: Metric + Clone + Default>(
        &mut self,
        kind: &'static str,
        (name, label): (&'static str, &'static str),
        values: &'static [&'static str],
        help: &'static str,
    ) -> Labelled<M>
    where
        Family<Label, M>: Metric,
    {
        let family = Family::<Label, M>::default();
        for value in values {
            drop(family.get_or_create(&[(label, *value)]));
        }
        self.registry.register(name, help, family.clone());
        self.descriptions.push(Description { name, kind, label: Some(label), values, help });
        Labelled { family, label }
    }

    /// One metric for each task that there is, learnt or not.
    fn of_tasks<M: Metric + Clone + Default>(
        &mut self,
        kind: &'static str,
        name: &'static str,
        help: &'static str,
    ) -> Labelled<M>
    where
        Family<Label, M>: Metric,
    {
        self.labelled(kind, (name, "task"), &TASKS, help)
    }
}

/// Every task's name.
static TASKS: [&str; TaskName::ALL.len()] = {
    let (mut names, mut at) = ([""; TaskName::ALL.len()], 0);
    while at < names.len() {
        names[at] = TaskName::ALL[at].name();
        at += 1;
    }
    names
};

/// A metric with one label.
#[derive(Clone, Debug)]
pub(crate) struct Labelled<M> {
    family: Family<Label, M>,
    label: &'static str,
}

impl<M: Clone + Default> Labelled<M> {
    pub(crate) fn of(&self, value: &'static str) -> M {
        self.family.get_or_create_owned(&[(self.label, value)])
    }
}

/// How many versions old the unrolls of the newest update were.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Ages {
    pub(crate) median: u64,
    pub(crate) p99: u64,
    pub(crate) max: u64,
}

/// The metrics of one learner process.
#[derive(Debug)]
pub struct Telemetry {
    catalogue: Catalogue,
    ages: Mutex<Ages>,
    pub(crate) updates: Counter,
    pub(crate) updates_skipped: Counter,
    pub(crate) restores: Counter,
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
    pub(crate) connections: Gauge,
    pub(crate) connections_refused: Labelled<Counter>,
    pub(crate) requests: Gauge,
    pub(crate) requests_refused: Labelled<Counter>,
    pub(crate) quarantined: Labelled<Counter>,
    sampled: Sampled,
}

/// What is counted elsewhere and read when somebody asks.
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
    memory: Gauge,
    tasks: SampledTasks,
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
            produced: catalogue.counter("comic_unrolls_produced", "Unrolls that the actors made, by their sequence numbers, over the run's whole life"),
            trained: catalogue.counter("comic_unrolls_trained", "Unrolls trained on, over the run's whole life"),
            dropped: catalogue.labelled(
                "counter",
                ("comic_unrolls_dropped", "reason"),
                &["stale", "invalid", "superseded", "lost_at_restart"],
                "Unrolls that will never be trained on, over the run's whole life",
            ),
            duplicates: catalogue.counter("comic_unrolls_duplicate", "Messages that repeated an unroll already accounted for, over the run's whole life"),
            unattributed: catalogue.counter("comic_unrolls_unattributed", "Messages refused without an account to charge, over the run's whole life"),
            in_flight: catalogue.gauge("comic_unrolls_in_flight", "Unrolls in a batch that is open, full, or being trained on"),
            capacity: catalogue.gauge("comic_unrolls_capacity", "Unrolls that the batches have room for"),
            waiting: catalogue.gauge("comic_unrolls_waiting", "Unrolls that wait for a place in a batch: above 0, the learner is slower than its actors"),
            ingest: catalogue.gauge("comic_ingest_bytes", "Room that messages have which were read and are not in a batch: at most --max-ingest-bytes"),
            actors: catalogue.labelled(
                "gauge",
                ("comic_actors", "state"),
                &["alive", "slow", "lost"],
                "Actors: connected; connected and silent for a minute while the learner waits; gone within the last ten minutes",
            ),
            version: catalogue.gauge("comic_parameters_version", "Newest published version of the parameters"),
            epoch: catalogue.gauge("comic_learner_epoch", "Which life of the learner this is; grows by one at every start of the run"),
            memory: catalogue.gauge("process_resident_memory_bytes", "Resident memory of the learner process in bytes"),
            tasks: SampledTasks {
                produced: catalogue.of_tasks("counter", "comic_task_unrolls_produced", "Unrolls of the task that were decided about, over the run's whole life"),
                trained: catalogue.of_tasks("counter", "comic_task_unrolls_trained", "Unrolls of the task trained on, over the run's whole life"),
                dropped: catalogue.of_tasks("counter", "comic_task_unrolls_dropped", "Unrolls of the task that will never be trained on, over the run's whole life; those of no known task are in comic_unrolls_dropped alone"),
                in_flight: catalogue.of_tasks("gauge", "comic_task_unrolls_in_flight", "Unrolls of the task in a batch that is open, full, or being trained on"),
            },
        }
    }
}

/// What [`Telemetry::page`] cannot know by itself.
#[derive(Debug)]
pub(crate) struct Sample {
    pub(crate) accounting: AccountingByTask,
    pub(crate) capacity: u64,
    pub(crate) waiting: u64,
    pub(crate) ingest: u64,
    pub(crate) actors: [(&'static str, u64); 3],
    pub(crate) version: u64,
    pub(crate) epoch: u64,
}

impl Default for Telemetry {
    fn default() -> Self {
        let mut catalogue = Catalogue::default();
        let all = &mut catalogue;
        Self {
            updates: all.counter("comic_updates", "Batches that V-MPO trained on"),
            updates_skipped: all.counter(
                "comic_updates_skipped",
                "Gradient steps that changed nothing, since a loss or gradient was not finite",
            ),
            restores: all.counter(
                "comic_restores",
                "Returns to the last good state, after learner.restore_after skipped gradient steps in a row",
            ),
            compilations: all.counter(
                "comic_compilations",
                "Programs that XLA compiled; it grows no more once every shape was seen. 0 on other devices",
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
                "Unrolls that were given up since they were not whole ten seconds after they began and others waited for their room",
            ),
            environment_steps: all.counter("comic_environment_steps", "Environment steps trained on"),
            task_steps: all.of_tasks("counter", "comic_task_environment_steps", "Environment steps of the task trained on"),
            task_rows: all.of_tasks("counter", "comic_task_rows", "Rows of the task's unrolls that were trained on"),
            task_padding: all.of_tasks("counter", "comic_task_padding_rows", "Those of them that are padding, since the next episode was of another task"),
            episodes_diverged: all.counter(
                "comic_episodes_diverged",
                "Episodes trained on that ended since the simulation diverged; see comic-actor --dump-diverged",
            ),
            evaluations: all.counter("comic_evaluations", "Evaluations that actors reported"),
            checkpoints: all.labelled(
                "counter",
                ("comic_checkpoints", "result"),
                &["written", "failed"],
                "Checkpoints by what became of them: one that fails is tried again with the next, training goes on",
            ),
            joins: all.labelled(
                "counter",
                ("comic_joins", "result"),
                &["joined", "full", "draining", "refused"],
                "Attempts to join, reconnections included: taken, refused since --max-actors are there or since the learner \
                 goes down, refused for good",
            ),
            connections: all.gauge("comic_connections", "Connections that are open"),
            connections_refused: all.labelled(
                "counter",
                ("comic_connections_refused", "reason"),
                &["per_address", "in_all", "tls"],
                "Connections closed at once: --max-connections-per-address, those in all, or no agreement on TLS",
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
                "Invalid unrolls by what became of them with --quarantine: on disk, beyond --quarantine-bytes, too many at once, not written",
            ),
            sampled: Sampled::new(all),
            catalogue,
            ages: Mutex::default(),
        }
    }
}

impl Telemetry {
    /// Counts an update that took so long on unrolls of these ages.
    pub fn count_update(&self, took: Duration, mut ages: Vec<u64>) {
        self.updates.inc();
        self.update_seconds.observe(took.as_secs_f64());
        for age in &ages {
            self.unroll_age.observe(*age as f64);
        }
        ages.sort_unstable();
        let at = |share: usize| ages.get(ages.len().saturating_sub(1) * share / 100).copied().unwrap_or_default();
        *self.ages.lock() = Ages { median: at(50), p99: at(99), max: at(100) };
    }

    /// Counts what was trained on of a task.
    pub(crate) fn count_rows(&self, task: &str, counted: Rows) {
        self.environment_steps.inc_by(counted.environment_steps);
        if let Some(task) = TASKS.iter().find(|name| **name == task) {
            self.task_steps.of(task).inc_by(counted.environment_steps);
            self.task_rows.of(task).inc_by(counted.rows);
            self.task_padding.of(task).inc_by(counted.padding);
        }
    }

    /// So many in all.
    pub(crate) fn count_compilations(&self, compiled: u64) {
        self.compilations.inc_by(compiled.saturating_sub(self.compilations.get()));
    }

    /// Of the newest update.
    pub(crate) fn ages(&self) -> Ages {
        *self.ages.lock()
    }

    /// The page that Prometheus reads, in the OpenMetrics text format.
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

    /// The reference page, Markdown.
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

What `comic-learner --metrics-port PORT` shows at `/metrics`, in the OpenMetrics text format. This page is made by
`comic-learner metrics > docs/metrics.md`, and a test compares the two. Counters begin at 0 when the process starts, unless
they speak of the run's whole life. A histogram `NAME` is `NAME_bucket`, `NAME_sum` and `NAME_count`.

| name | kind | label | meaning |
| --- | --- | --- | --- |
";

/// Of this process, as Linux tells it; 0 where it does not.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
    kilobytes.unwrap_or_default() * 1024
}

/// Prints [`Telemetry::reference`].
///
/// # Errors
/// When stdout refuses.
pub fn print_reference() -> Result<()> {
    let page = Telemetry::default().reference();
    let written = std::io::Write::write_all(&mut std::io::stdout(), page.as_bytes());
    written.map_err(Error::system("cannot write to stdout"))
}
