//! The figures of a simulation, one JSON line each.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::distribution::{self, Distribution};
use super::observed::{Dropped, Observed};
use super::settings::Settings;

const MEGABYTE: f64 = 1e6;
/// Processor seconds of the service for a gigabyte in and out (docs/benchmarks.md: `ingest.1000`, and `publish.1000` decoded).
const CPU_PER_GIGABYTE: [f64; 2] = [0.39, 0.30];
/// Bytes of a connection that reads versions (docs/benchmarks.md: 71 MB for 1000).
const CONNECTION: f64 = 71_000.0;
/// Bytes of messages that a learner has read and that wait (`--max-ingest-bytes`).
const ROOM: f64 = 268_435_456.0;
/// Versions that a simulation must have measured: with fewer its figures may be those of the start.
const ENOUGH_VERSIONS: u64 = 10;
/// Versions beside those that are held: the one that is made, and the parameters that it is made from.
const MAKING: usize = 2;

/// The figures, in the order in which they are printed.
pub(super) fn figures(settings: &Settings, observed: &Observed) -> Vec<Value> {
    let Observed { seconds, unrolls, dropped, ages, learning, acting, bytes, .. } = observed;
    let line = |figure: &str, value: Option<f64>, unit: &str, rest: Value| {
        let mut line = json!({ "figure": format!("simulate.{figure}"), "value": value, "unit": unit });
        if let (Some(line), Value::Object(rest)) = (line.as_object_mut(), rest) {
            line.extend(rest);
            line.insert("settings".into(), json!(settings));
        }
        line
    };
    let bounds = json!({
        "actors_bound": settings.actor_bound(), "learners_bound": settings.learner_bound(),
        "links_bound": settings.link_bound(), "measured_s": seconds, "few_versions": observed.versions < ENOUGH_VERSIONS,
    });
    let age = |percent| distribution::quantile(ages, percent).map(|age| age as f64);
    let Dropped { arriving, waiting, in_a_batch } = *dropped;
    let offered = (unrolls + dropped.all()) as f64;
    let share = |count: u64| if offered > 0.0 { count as f64 / offered } else { 0.0 };
    let busy = acting / (settings.workers() as f64 * seconds);
    let publication = |percent| observed.publications()?.quantile(percent);
    let [bytes_in, bytes_out] = bytes.map(|bytes| bytes / seconds);
    let cores = [bytes_in, bytes_out].iter().zip(CPU_PER_GIGABYTE).map(|(bytes, cpu)| bytes / 1e9 * cpu).sum();
    let memory = Memory::new(settings, observed);
    vec![
        line("steps", Some((*unrolls as usize * settings.length) as f64 / seconds), "steps/s", bounds),
        line(
            "busy",
            Some(learning / seconds),
            "share of the learners' time",
            json!({ "exchanges_s": settings.exchanges() }),
        ),
        line("age", age(50), "versions", json!({ "mean": mean(ages), "p99": age(99), "max": age(100) })),
        line(
            "dropped",
            Some(share(dropped.all())),
            "share of the unrolls",
            json!({ "stale": { "arriving": share(arriving), "waiting": share(waiting), "in_a_batch": share(in_a_batch) } }),
        ),
        line(
            "waiting",
            Some((1.0 - busy).max(0.0)),
            "share of the actors' time",
            json!({
                "acknowledgements_s": quantiles(&observed.waits_for_acknowledgements),
                "versions_s": quantiles(&observed.waits_for_versions),
            }),
        ),
        line(
            "publication",
            publication(50),
            "s until the last actor has a version",
            json!({
                "max": publication(100), "versions": observed.versions, "cut_off": observed.cut_off,
                "lag_seconds": quantiles(&observed.reads), "lag_versions": quantiles(&observed.late),
            }),
        ),
        line("start", observed.start(), "s until the last actor acts", json!({})),
        line("bytes_in", Some(bytes_in / MEGABYTE), "MB/s", of_links(settings, bytes_in)),
        line("bytes_out", Some(bytes_out / MEGABYTE), "MB/s", of_links(settings, bytes_out)),
        line("service_cores", Some(cores), "cores of all learners", json!({})),
        line("memory", Some(memory.sum() / MEGABYTE), "MB of each learner's buffers", memory.parts()),
    ]
}

fn of_links(settings: &Settings, bytes: f64) -> Value {
    json!({ "of_links": bytes / (settings.learners as f64 * settings.bytes_per_second()) })
}

/// The memory of the buffers of the learner that used most; its networks and libtorch are not in it.
#[derive(Clone, Copy, Debug)]
struct Memory {
    batches: f64,
    messages: f64,
    /// Unrolls for which messages have no room: they wait in the windows of their connections.
    windows: f64,
    parameters: f64,
    connections: f64,
}

impl Memory {
    fn new(settings: &Settings, observed: &Observed) -> Self {
        let Settings { actors, learners, batch, ahead, unroll_bytes, parameter_bytes, .. } = *settings;
        let waiting = observed.most_waiting as f64 * unroll_bytes;
        Self {
            batches: ((ahead + 1) * batch / learners) as f64 * unroll_bytes,
            messages: waiting.min(ROOM),
            windows: (waiting - ROOM).max(0.0),
            parameters: (observed.most_held + MAKING) as f64 * parameter_bytes,
            connections: actors.div_ceil(learners) as f64 * CONNECTION,
        }
    }

    fn sum(self) -> f64 {
        self.batches + self.messages + self.windows + self.parameters + self.connections
    }

    fn parts(self) -> Value {
        let Self { batches, messages, windows, parameters, connections } = self;
        let [batches, messages, windows, parameters, connections] =
            [batches, messages, windows, parameters, connections].map(|bytes| bytes / MEGABYTE);
        json!({
            "batches": batches, "messages": messages, "windows": windows, "parameters": parameters,
            "connections": connections,
        })
    }
}

fn mean(ages: &BTreeMap<u64, u64>) -> Option<f64> {
    let all: u64 = ages.values().sum();
    let sum: u64 = ages.iter().map(|(age, count)| age * count).sum();
    (all > 0).then(|| sum as f64 / all as f64)
}

fn quantiles(values: &Distribution) -> Value {
    json!({ "p50": values.quantile(50), "p99": values.quantile(99), "max": values.quantile(100) })
}
