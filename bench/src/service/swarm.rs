//! As many actors as in the paper, for a long time, with restarts and stalls.

use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use clap::Args;
use serde_json::{Value, json};

use super::certificates::Certificates;
use super::figure::{MEGABYTE, extended};
use super::paper::{PATIENCE, positive};
use super::process::Process;

/// Time between two samples of the memory.
const SAMPLE: Duration = Duration::from_secs(2);
/// The longest time that an actor may be without an acknowledgement or a version, seconds.
const STARVED: f64 = 30.0;

/// Measure thousands of actors for minutes, with joins, restarts and stalls
#[derive(Clone, Debug, Args)]
pub struct Swarm {
    /// Number of actors
    #[arg(long, default_value_t = 4000)]
    actors: usize,
    /// Minutes; the first tenth is warm-up
    #[arg(long, default_value_t = 20.0, value_parser = positive)]
    minutes: f64,
    /// Bytes of a version of the parameters
    #[arg(long, value_name = "BYTES", default_value_t = 5_000_000)]
    parameters: usize,
    /// Batches that the stand-in for the trainer takes in a second
    #[arg(long, default_value_t = 10.0, value_parser = positive)]
    batches: f64,
    /// Batches between versions
    #[arg(long, default_value_t = 100)]
    target_period: u64,
    /// Mean seconds between an actor's restarts, and between its stalls of 5 to 60 s
    #[arg(long, default_value_t = 300.0, value_parser = positive)]
    churn: f64,
    /// Connect by TLS and with a token
    #[arg(long)]
    tls: bool,
}

impl Swarm {
    /// Measures and prints.
    ///
    /// # Errors
    /// A process of the measurement that fails; a bound that is not kept.
    pub fn run(&self) -> Result<()> {
        let certificates = self.tls.then(Certificates::new).transpose()?;
        let access: Vec<&str> = certificates.iter().flat_map(Certificates::option).collect();
        let (mut host, mut crowd) = self.start(&access)?;
        // Connections made so far, not those of now: some actors have restarted already.
        crowd.wait_for("connections", self.actors as f64, 5 * PATIENCE)?;
        let (start, length) = (Instant::now(), Duration::from_secs_f64(60.0 * self.minutes));
        let (mut samples, mut warmed_up) = (Vec::new(), None);
        while start.elapsed() < length {
            sleep(SAMPLE);
            let usage = host.usage()?;
            if start.elapsed() < length / 10 {
                continue;
            }
            if warmed_up.is_none() {
                crowd.ask("reset")?;
                warmed_up = Some((Instant::now(), usage.cpu_seconds, host.number("trained")?, crowd.number("bytes")?));
            }
            samples.push((start.elapsed().as_secs_f64() / 60.0, usage.resident / MEGABYTE));
        }
        let (usage, state, stats) = (host.usage()?, host.ask("stats")?, crowd.ask("stats")?);
        let Some((since, cpu, trained, bytes)) = warmed_up else { anyhow::bail!("--minutes is too short to measure") };
        let seconds = since.elapsed().as_secs_f64();
        let per_second = |now: &Value, then: f64| (now.as_f64().unwrap_or_default() - then) / seconds;
        ensure!(state["balanced"] == true, "the accounting does not balance: {state}");
        let rest = json!({
            "actors": self.actors, "tls": self.tls, "minutes": self.minutes, "unrolls_per_s": per_second(&state["trained"], trained),
            "parameters_mb_per_s": per_second(&stats["bytes"], bytes) / MEGABYTE,
            "cores": (usage.cpu_seconds - cpu) / seconds, "crowd": stats, "accounting": state["accounting"],
        });
        println!("{}", json!({ "figure": "swarm.rss_slope", "value": slope(&samples), "unit": "MB/min" }));
        let peak = usage.peak / MEGABYTE;
        let bound = 2048.0 * 1.048_576;
        let line = json!({
            "figure": "swarm.rss_peak", "value": peak, "unit": "MB", "bound": bound, "of_bound": peak / bound,
        });
        let line = extended(line, rest);
        println!("{line}");
        check_bounds(&line)
    }

    /// `access` is the option of host and crowd.
    fn start(&self, access: &[&str]) -> Result<(Process, Process)> {
        let (parameters, update) = (self.parameters.to_string(), (1.0 / self.batches).to_string());
        let period = self.target_period.to_string();
        let trainer = ["--update", &update, "--target-period", &period];
        let host =
            Process::host(&[&["--kind", "learner", "--parameters", &parameters], &trainer[..], access].concat())?;
        let (actors, churn) = (self.actors.to_string(), self.churn.to_string());
        let options = ["--actors", &actors, "--window", "1", "--watch", "--churn", &churn];
        let crowd = Process::crowd(&host, &[&options[..], access].concat())?;
        Ok((host, crowd))
    }
}

/// Fails where the line of the figure shows too much memory or an actor that waited too long.
fn check_bounds(line: &Value) -> Result<()> {
    let of_bound = line["of_bound"].as_f64().unwrap_or(f64::INFINITY);
    ensure!(of_bound <= 1.0, "the learner used {of_bound:.2} of the memory that it may use");
    for wait in ["longest_without_an_acknowledgement", "longest_without_a_version"] {
        let seconds = line["crowd"][wait].as_f64().unwrap_or(f64::INFINITY);
        ensure!(seconds <= STARVED, "an actor was starved: {wait}, {seconds:.1} s");
    }
    Ok(())
}

/// The slope of the least-squares line.
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
    fn a_starved_actor_or_too_much_memory_or_a_missing_number_fails() {
        let line = |of_bound: f64, acknowledgement: f64, version: f64| {
            let waits =
                json!({ "longest_without_an_acknowledgement": acknowledgement, "longest_without_a_version": version });
            json!({ "of_bound": of_bound, "crowd": waits })
        };
        check_bounds(&line(0.7, 8.5, 24.0)).unwrap();
        for broken in [line(1.01, 8.5, 24.0), line(0.7, 30.1, 24.0), line(0.7, 8.5, 30.1), json!({ "of_bound": 0.7 })] {
            assert!(check_bounds(&broken).is_err(), "{broken}");
        }
    }

    #[test]
    fn points_on_a_line_have_its_slope() {
        let line: Vec<_> = (0..10).map(|x| (f64::from(x), 3.0 - 0.5 * f64::from(x))).collect();
        assert!((slope(&line) + 0.5).abs() < 1e-12);
    }
}
