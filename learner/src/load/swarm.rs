//! As many actors as the paper has, for as long as somebody wants to wait.

use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use clap::Args;
use serde_json::{Value, json};

use super::process::Process;
use super::{MEGABYTE, PATIENCE};

/// How often memory is looked at.
const GLANCE: Duration = Duration::from_secs(2);
/// Seconds without an acknowledgement, or a version, that no actor is to see.
const STARVED: f64 = 30.0;

/// How many actors, and how they live.
#[derive(Clone, Debug, Args)]
pub(super) struct Options {
    /// Actors.
    #[arg(long, default_value_t = 4000)]
    actors: usize,
    /// Minutes, a tenth of which are warm-up.
    #[arg(long, default_value_t = 20.0, value_parser = super::positive)]
    minutes: f64,
    /// Bytes of a version of the parameters.
    #[arg(long, value_name = "BYTES", default_value_t = 5_000_000)]
    parameters: usize,
    /// Batches that the stand-in for the device takes in a second.
    #[arg(long, default_value_t = 10.0, value_parser = super::positive)]
    batches: f64,
    /// Batches between versions.
    #[arg(long, default_value_t = 100)]
    target_period: u64,
    /// Mean seconds of an actor's life, and between its stalls of 5 to 60 s.
    #[arg(long, default_value_t = 300.0, value_parser = super::positive)]
    churn: f64,
}

impl Options {
    pub(super) fn run(&self) -> Result<()> {
        let text = |number: f64| number.to_string();
        let (parameters, update) = (self.parameters.to_string(), text(1.0 / self.batches));
        let period = self.target_period.to_string();
        let mut host = Process::host(&[
            "--kind",
            "learner",
            "--parameters",
            &parameters,
            "--update",
            &update,
            "--target-period",
            &period,
        ])?;
        let (actors, churn) = (self.actors.to_string(), text(self.churn));
        let mut crowd = Process::crowd(&host, &["--actors", &actors, "--window", "1", "--watch", "--churn", &churn])?;
        // Lives, not connections: some have ended again.
        crowd.wait_for("lives", self.actors as f64, 5 * PATIENCE)?;
        let (start, length) = (Instant::now(), Duration::from_secs_f64(60.0 * self.minutes));
        let (mut samples, mut warm) = (Vec::new(), None);
        while start.elapsed() < length {
            sleep(GLANCE);
            let usage = host.usage()?;
            if start.elapsed() < length / 10 {
                continue;
            }
            if warm.is_none() {
                crowd.ask("forget")?;
                warm = Some((Instant::now(), usage.cpu_seconds, host.number("trained")?, crowd.number("bytes")?));
            }
            samples.push((start.elapsed().as_secs_f64() / 60.0, usage.resident / MEGABYTE));
        }
        let (usage, state, stats) = (host.usage()?, host.ask("stats")?, crowd.ask("stats")?);
        let Some((since, cpu, trained, bytes)) = warm else { anyhow::bail!("--minutes is too short to measure") };
        let seconds = since.elapsed().as_secs_f64();
        let per_second = |now: &Value, then: f64| (now.as_f64().unwrap_or_default() - then) / seconds;
        ensure!(state["balanced"] == true, "the accounting do not balance: {state}");
        let rest = json!({
            "actors": self.actors, "minutes": self.minutes, "unrolls_per_s": per_second(&state["trained"], trained),
            "parameters_mb_per_s": per_second(&stats["bytes"], bytes) / MEGABYTE,
            "cores": (usage.cpu_seconds - cpu) / seconds, "crowd": stats, "accounting": state["accounting"],
        });
        let slope = slope(&samples);
        println!("{}", json!({ "figure": "swarm.rss_slope", "value": slope, "unit": "MB/min" }));
        let peak = usage.peak / MEGABYTE;
        let bound = 2048.0 * 1.048_576;
        let mut line = json!({
            "figure": "swarm.rss_peak", "value": peak, "unit": "MB", "bound": bound, "of_bound": peak / bound,
        });
        if let (Some(line), Value::Object(rest)) = (line.as_object_mut(), rest) {
            line.extend(rest);
        }
        println!("{line}");
        keeps_its_promises(&line)
    }
}

/// What is promised of memory and patience held, by the figure's line.
fn keeps_its_promises(line: &Value) -> Result<()> {
    let of_bound = line["of_bound"].as_f64().unwrap_or(f64::INFINITY);
    ensure!(of_bound <= 1.0, "the learner had more memory than it may have: {of_bound:.2} of its bound");
    for promise in ["longest_without_an_acknowledgement", "longest_without_a_version"] {
        let seconds = line["crowd"][promise].as_f64().unwrap_or(f64::INFINITY);
        ensure!(seconds <= STARVED, "an actor was starved: {promise}, {seconds:.1} s");
    }
    Ok(())
}

/// Least squares.
fn slope(points: &[(f64, f64)]) -> f64 {
    let count = points.len() as f64;
    let mean = |part: fn(&(f64, f64)) -> f64| points.iter().map(part).sum::<f64>() / count;
    let (x, y) = (mean(|point| point.0), mean(|point| point.1));
    let covariance: f64 = points.iter().map(|point| (point.0 - x) * (point.1 - y)).sum();
    covariance / points.iter().map(|point| (point.0 - x).powi(2)).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_starved_actor_too_much_memory_or_nothing_measured_fails() {
        let line = |of_bound: f64, acknowledgement: f64, version: f64| {
            let waits =
                json!({ "longest_without_an_acknowledgement": acknowledgement, "longest_without_a_version": version });
            json!({ "of_bound": of_bound, "crowd": waits })
        };
        keeps_its_promises(&line(0.7, 8.5, 24.0)).unwrap();
        for broken in [line(1.01, 8.5, 24.0), line(0.7, 30.1, 24.0), line(0.7, 8.5, 30.1), json!({ "of_bound": 0.7 })] {
            assert!(keeps_its_promises(&broken).is_err(), "{broken}");
        }
    }

    #[test]
    fn the_slope_of_a_line_is_its_own() {
        let line: Vec<_> = (0..10).map(|x| (f64::from(x), 3.0 - 0.5 * f64::from(x))).collect();
        assert!((slope(&line) + 0.5).abs() < 1e-12);
    }
}
