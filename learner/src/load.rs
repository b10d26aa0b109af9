//! `comic-learner load`: what the service carries, under actors that are not real.
//!
//! # Layout
//! - `host` is a process with the service in it, or with the floor that it is compared with; a stand-in takes the place of
//!   the device.
//! - `crowd` is a process with many actors in it, each with a connection and an identity (`identity`) of its own, that
//!   send unrolls of the real layout and read parameters; `reader` is one that does the least a reader can do.
//! - `process` starts both and asks them how they are, `usage` is what a process says of itself, `certificates` are for
//!   figures of TLS.
//!
//! A figure is one JSON line: value, floor and ratio, medians of rounds in which service and floor take turns; of memory,
//! value, bound and the share of it that is used.

mod certificates;
mod crowd;
mod host;
mod identity;
mod process;
mod reader;
mod swarm;
mod usage;

use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use clap::{Args, Subcommand};
use comic_experiment::statistics::median;
use comic_experiment::{Experiment, TaskSpec};
use comic_proto::{UnrollLayout, UnrollShape};
use serde_json::json;

use certificates::Certificates;
use process::Process;
use usage::Usage;

/// The paper's tracking: its unrolls are what the crowd sends.
const PRESET: &str = "tracking-mlp";
const MEGABYTE: f64 = 1e6;
/// What is not there after this time will not come.
const PATIENCE: Duration = Duration::from_secs(120);
/// How often a process is asked.
const GLANCE: Duration = Duration::from_millis(20);

/// What is measured.
#[derive(Debug, Args)]
pub struct Load {
    #[command(subcommand)]
    figure: Figure,
}

#[derive(Debug, Subcommand)]
enum Figure {
    /// Unrolls up, validated and laid into batches, against a bare tonic stream that drops what it reads; and by TLS,
    /// against the same without.
    Ingest {
        /// Connections; a figure for each.
        #[arg(long, value_name = "N", num_args = 1.., default_values_t = [32, 1000])]
        connections: Vec<usize>,
        /// Seconds of a round.
        #[arg(long, default_value_t = 5.0, value_parser = positive)]
        seconds: f64,
        /// Rounds.
        #[arg(long, default_value_t = 5)]
        rounds: usize,
    },
    /// Parameters down, against bare sockets; then with new ones all the time, and with readers that stop.
    Publish {
        /// Connections.
        #[arg(long, value_name = "N", default_value_t = 1000)]
        connections: usize,
        /// Bytes of a version.
        #[arg(long, value_name = "BYTES", default_value_t = 5_000_000, value_parser = clap::value_parser!(u64).range(1..))]
        parameters: u64,
        /// Versions a round, and rounds.
        #[arg(long, default_value_t = 3)]
        rounds: usize,
    },
    /// Readers that stop, each in another version, beside one that goes on: what they cost the learner.
    Stalled {
        /// Connections.
        #[arg(long, value_name = "N", default_value_t = 1000)]
        connections: usize,
        /// Bytes of a version.
        #[arg(long, value_name = "BYTES", default_value_t = 5_000_000, value_parser = clap::value_parser!(u64).range(1..))]
        parameters: u64,
    },
    /// Many actors for long, with joins, leaves and stalls.
    Swarm(swarm::Options),
    #[command(hide = true)]
    Host(host::Options),
    #[command(hide = true)]
    Crowd(crowd::Options),
}

impl Load {
    /// Measures and prints.
    ///
    /// # Errors
    /// When one of the processes does not do what it is told.
    pub fn run(&self) -> Result<()> {
        match &self.figure {
            Figure::Ingest { connections, seconds, rounds } => {
                connections.iter().try_for_each(|connections| ingest(*connections, *seconds, *rounds))
            }
            Figure::Publish { connections, parameters, rounds } => {
                publish(*connections, *parameters, *rounds)?;
                for (period, every) in [(1, 0.1), (100, 10.0)] {
                    lag(*connections, *parameters, period, every)?;
                }
                stalled(*connections, *parameters)
            }
            Figure::Stalled { connections, parameters } => stalled(*connections, *parameters),
            Figure::Swarm(options) => options.run(),
            Figure::Host(options) => options.run(),
            Figure::Crowd(options) => options.run(),
        }
    }
}

fn experiment() -> Result<(Experiment, TaskSpec, UnrollLayout)> {
    let experiment = comic_experiment::resolve(PRESET, &[])?;
    let spec =
        TaskSpec::new(&experiment, vec!["clip".into()]).map_err(|name| anyhow::anyhow!("no observation `{name}`"))?;
    let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
    Ok((experiment, spec, layout))
}

/// What a round showed.
#[derive(Clone, Copy, Debug)]
struct Round {
    megabytes_per_second: f64,
    cpu_seconds_per_gigabyte: f64,
    growth: f64,
}

impl Round {
    fn new(before: &Usage, after: &Usage, bytes: f64, took: Duration) -> Self {
        Self {
            megabytes_per_second: bytes / MEGABYTE / took.as_secs_f64(),
            cpu_seconds_per_gigabyte: (after.cpu_seconds - before.cpu_seconds) / (bytes / 1e9),
            growth: (after.peak - before.resident) / MEGABYTE,
        }
    }
}

/// Prints one figure of these rounds and the floor's.
fn show(figure: &str, rounds: &[Round], floors: &[Round], rest: serde_json::Value) {
    let of = |rounds: &[Round], part: fn(&Round) -> f64| median(rounds.iter().map(part).collect()).unwrap_or(f64::NAN);
    let value = of(rounds, |round| round.megabytes_per_second);
    let floor = of(floors, |round| round.megabytes_per_second);
    let mut line = json!({
        "figure": figure, "value": value, "unit": "MB/s", "floor": floor, "ratio": value / floor,
        "cpu_s_per_gb": of(rounds, |round| round.cpu_seconds_per_gigabyte),
        "floor_cpu_s_per_gb": of(floors, |round| round.cpu_seconds_per_gigabyte),
        "peak_growth_mb": of(rounds, |round| round.growth),
        "floor_peak_growth_mb": of(floors, |round| round.growth),
        "rounds": rounds.len(),
    });
    if let (Some(line), serde_json::Value::Object(rest)) = (line.as_object_mut(), rest) {
        line.extend(rest);
    }
    println!("{line}");
}

fn ingest(connections: usize, seconds: f64, rounds: usize) -> Result<()> {
    let bytes = experiment()?.2.size();
    let certificates = Certificates::new()?;
    let tls = certificates.option();
    let kinds = [("learner", "grpc", &[][..]), ("tonic", "bare-grpc", &[]), ("learner", "grpc", &tls)];
    let mut found = [Vec::new(), Vec::new(), Vec::new()];
    for _ in 0..rounds {
        for (kind, found) in kinds.iter().zip(&mut found) {
            found.push(ingest_round(*kind, connections, seconds)?);
        }
    }
    let [ours, floors, by_tls] = &found;
    let rest = json!({ "connections": connections, "unroll_bytes": bytes });
    show(&format!("ingest.{connections}"), ours, floors, rest.clone());
    show(&format!("ingest.{connections}.tls"), by_tls, ours, rest);
    Ok(())
}

fn ingest_round((kind, crowd, tls): (&str, &str, &[&str]), connections: usize, seconds: f64) -> Result<Round> {
    let mut host = Process::host(&[&["--kind", kind], tls].concat())?;
    let before = host.usage()?;
    let connections = connections.to_string();
    let arguments = [&["--kind", crowd, "--actors", &connections, "--window", "4"], tls].concat();
    let mut crowd = Process::crowd(&host, &arguments)?;
    crowd.wait_for("acked", 1000.0, PATIENCE)?;
    let (start, began) = (Instant::now(), (host.usage()?, host.number("bytes")?));
    sleep(Duration::from_secs_f64(seconds));
    let (took, ended) = (start.elapsed(), (host.usage()?, host.number("bytes")?));
    ensure!(crowd.number("failures")? == 0.0, "an actor of the crowd failed: {}", crowd.ask("stats")?);
    let round = Round::new(&began.0, &ended.0, ended.1 - began.1, took);
    Ok(Round { growth: (ended.0.peak - before.resident) / MEGABYTE, ..round })
}

/// The readers of service and floor drop what they read; those of a third kind decode it, as actors do, and those of a
/// fourth decrypt it as well.
fn publish(connections: usize, parameters: u64, rounds: usize) -> Result<()> {
    let certificates = Certificates::new()?;
    let tls = certificates.option();
    let kinds = [
        ("learner", "readers", &[][..]),
        ("sockets", "sockets", &[]),
        ("learner", "grpc", &[]),
        ("learner", "grpc", &tls),
    ];
    let mut found = [Vec::new(), Vec::new(), Vec::new(), Vec::new()];
    for _ in 0..rounds {
        for (kind, found) in kinds.iter().zip(&mut found) {
            found.push(publish_round(*kind, connections, parameters)?);
        }
    }
    let [ours, floors, decoding, by_tls] = &found;
    let rest = json!({ "connections": connections, "parameters_bytes": parameters });
    show(&format!("publish.{connections}"), ours, floors, rest.clone());
    show(&format!("publish.{connections}.decoded"), decoding, floors, rest.clone());
    show(&format!("publish.{connections}.decoded.tls"), by_tls, decoding, rest);
    Ok(())
}

/// Three versions, each to everybody before the next.
fn publish_round((kind, crowd, tls): (&str, &str, &[&str]), connections: usize, parameters: u64) -> Result<Round> {
    const VERSIONS: usize = 3;
    let (everybody, size) = (connections.to_string(), parameters.to_string());
    let mut host = Process::host(&[&["--kind", kind, "--parameters", &size], tls].concat())?;
    let arguments = [&["--kind", crowd, "--actors", &everybody, "--watch", "--parameters", &size], tls].concat();
    let mut crowd = Process::crowd(&host, &arguments)?;
    crowd.wait_for("connected", connections as f64, PATIENCE)?;
    // One to warm up.
    host.ask("publish")?;
    crowd.wait_for("versions", connections as f64, PATIENCE)?;
    let (start, before) = (Instant::now(), host.usage()?);
    for version in 2..=VERSIONS + 1 {
        host.ask("publish")?;
        crowd.wait_for("versions", (version * connections) as f64, PATIENCE)?;
    }
    let bytes = (VERSIONS * connections) as f64 * parameters as f64;
    Ok(Round::new(&before, &host.usage()?, bytes, start.elapsed()))
}

/// New parameters at this pace, whoever has read the last ones.
fn lag(connections: usize, parameters: u64, target_period: usize, every: f64) -> Result<()> {
    const SECONDS: f64 = 40.0;
    let (every, size) = (every.to_string(), parameters.to_string());
    let mut host = Process::host(&["--kind", "learner", "--parameters", &size, "--publish-every", &every])?;
    let before = host.usage()?;
    let everybody = connections.to_string();
    let mut crowd = Process::crowd(&host, &["--actors", &everybody, "--watch"])?;
    crowd.wait_for("versions", connections as f64, PATIENCE)?;
    host.forget_peak();
    let connected = host.usage()?.resident;
    let (start, began, read) = (Instant::now(), host.usage()?, crowd.number("bytes")?);
    crowd.ask("forget")?;
    sleep(Duration::from_secs_f64(SECONDS));
    let stats = crowd.ask("stats")?;
    let bytes = stats["bytes"].as_f64().unwrap_or_default() - read;
    let round = Round::new(&began, &host.usage()?, bytes, start.elapsed());
    println!(
        "{}",
        json!({
            "figure": format!("publish.{connections}.period_{target_period}"), "value": round.megabytes_per_second,
            "unit": "MB/s", "cpu_s_per_gb": round.cpu_seconds_per_gigabyte,
            "peak_growth_mb": (host.usage()?.peak - connected) / MEGABYTE,
            "connections_mb": (connected - before.resident) / MEGABYTE,
            "lag_versions": stats["lag_versions"], "lag_seconds": stats["lag_seconds"],
            "longest_without_a_version_s": stats["longest_without_a_version"],
        })
    );
    Ok(())
}

/// Readers that stop, each in another version, and one among them that goes on.
fn stalled(connections: usize, parameters: u64) -> Result<()> {
    const VERSIONS: usize = 8;
    let size = parameters.to_string();
    let mut host = Process::host(&["--kind", "learner", "--parameters", &size])?;
    let everybody = connections.to_string();
    let versions = VERSIONS.to_string();
    let mut crowd = Process::crowd(&host, &["--actors", &everybody, "--watch", "--stall-within", &versions])?;
    let mut healthy = Process::crowd(&host, &["--actors", "1", "--watch"])?;
    crowd.wait_for("connected", connections as f64, PATIENCE)?;
    healthy.wait_for("connected", 1.0, PATIENCE)?;
    let before = host.usage()?;
    let mut times = Vec::new();
    for version in 1..=6 * VERSIONS {
        host.ask("publish")?;
        let start = Instant::now();
        healthy.wait_for("versions", version as f64, PATIENCE)?;
        times.push(start.elapsed().as_secs_f64());
        let stopped = (0..connections).filter(|actor| actor % VERSIONS < version).count();
        crowd.wait_for("stalled", stopped as f64, PATIENCE)?;
    }
    let after = host.usage()?;
    let stalled = crowd.number("stalled")?;
    println!(
        "{}",
        json!({
            "figure": "publish.stalled", "value": (after.peak - before.resident) / MEGABYTE, "unit": "MB",
            "bound": 60.0, "of_bound": (after.peak - before.resident) / MEGABYTE / 60.0, "stalled": stalled,
            "resident_growth_mb": (after.resident - before.resident) / MEGABYTE,
            "a_healthy_reader_waits_s": median(times.split_off(VERSIONS)),
        })
    );
    Ok(())
}

/// A number of seconds, or the like, that can be waited for.
fn positive(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(number) if (1e-3..=1e6).contains(&number) => Ok(number),
        _ => Err("must be a number from 0.001 to 1000000".into()),
    }
}
