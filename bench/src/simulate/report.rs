//! The figures of a simulation, one JSON line each.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::observed::{Dropped, Observed};
use super::settings::Settings;

const MEGABYTE: f64 = 1e6;
/// Processor seconds of the service for a gigabyte in and out (docs/benchmarks.md: `ingest.1000`, and `publish.1000` decoded).
const CPU_PER_GIGABYTE: [f64; 2] = [0.39, 0.30];
/// Bytes of a connection that reads versions (docs/benchmarks.md: 71 MB for 1000).
const CONNECTION: f64 = 71_000.0;
/// Bytes of messages that a learner has read and that wait (`--max-ingest-bytes`).
const ROOM: f64 = 268_435_456.0;
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
        "links_bound": settings.link_bound(),
    });
    let age = |percent| aged(ages, percent);
    let Dropped { arriving, waiting, in_a_batch } = *dropped;
    let offered = (unrolls + dropped.all()) as f64;
    let share = |count: u64| if offered > 0.0 { count as f64 / offered } else { 0.0 };
    let busy = acting / (settings.workers() as f64 * seconds);
    let publications = observed.publications();
    let complete: Option<Vec<f64>> = publications.iter().copied().collect();
    let complete = complete.unwrap_or_default();
    let [bytes_in, bytes_out] = bytes.map(|bytes| bytes / seconds);
    let cores = [bytes_in, bytes_out].iter().zip(CPU_PER_GIGABYTE).map(|(bytes, cpu)| bytes / 1e9 * cpu).sum();
    let memory = Memory::new(settings, observed);
    vec![
        line("steps", Some((*unrolls as usize * settings.length) as f64 / seconds), "steps/s", bounds),
        line(
            "busy",
            Some(learning / seconds),
            "share of the learners' time",
            json!({ "all_reduce_s": settings.all_reduce() }),
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
            quantile(&complete, 50),
            "s until the last actor has a version",
            json!({
                "max": quantile(&complete, 100), "versions": publications.len(), "cut_off": observed.cut_off,
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
    parameters: f64,
    connections: f64,
}

impl Memory {
    fn new(settings: &Settings, observed: &Observed) -> Self {
        let Settings { actors, learners, batch, ahead, unroll_bytes, parameter_bytes, .. } = *settings;
        Self {
            batches: ((ahead + 1) * batch / learners) as f64 * unroll_bytes,
            messages: (observed.most_waiting as f64 * unroll_bytes).min(ROOM),
            parameters: (observed.most_held + MAKING) as f64 * parameter_bytes,
            connections: actors.div_ceil(learners) as f64 * CONNECTION,
        }
    }

    fn sum(self) -> f64 {
        self.batches + self.messages + self.parameters + self.connections
    }

    fn parts(self) -> Value {
        let Self { batches, messages, parameters, connections } = self;
        let [batches, messages, parameters, connections] =
            [batches, messages, parameters, connections].map(|bytes| bytes / MEGABYTE);
        json!({ "batches": batches, "messages": messages, "parameters": parameters, "connections": connections })
    }
}

fn mean(ages: &BTreeMap<u64, u64>) -> Option<f64> {
    let all: u64 = ages.values().sum();
    let sum: u64 = ages.iter().map(|(age, count)| age * count).sum();
    (all > 0).then(|| sum as f64 / all as f64)
}

/// The age that `percent` of the unrolls do not exceed.
fn aged(ages: &BTreeMap<u64, u64>, percent: u64) -> Option<f64> {
    let all: u64 = ages.values().sum();
    let mut left = (all * percent).div_ceil(100).max(1);
    let found = ages.iter().find(|(_, count)| {
        let reached = **count >= left;
        left = left.saturating_sub(**count);
        reached
    });
    found.map(|(age, _)| *age as f64)
}

fn quantiles(values: &[f64]) -> Value {
    json!({ "p50": quantile(values, 50), "p99": quantile(values, 99), "max": quantile(values, 100) })
}

fn quantile(values: &[f64], percent: usize) -> Option<f64> {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    values.get(values.len().saturating_sub(1) * percent / 100).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_age_at_a_percentage_is_that_of_a_sorted_list() {
        let ages = [(0, 60), (2, 39), (7, 1)].into();
        assert_eq!([50, 60, 61, 99, 100].map(|percent| aged(&ages, percent)), [0.0, 0.0, 2.0, 2.0, 7.0].map(Some));
        assert_eq!(aged(&[].into(), 50), None);
    }
}
