//! Readers of parameters that stop reading.

use std::time::Instant;

use anyhow::Result;
use clap::Args;
use serde_json::json;

use super::figure::MEGABYTE;
use super::paper::PATIENCE;
use super::process::Process;
use crate::median::median;

/// Measure the learner's memory while readers stop in different versions and one reader continues
#[derive(Debug, Args)]
pub struct Stalled {
    /// Number of connections
    #[arg(long, value_name = "N", default_value_t = 1000)]
    connections: usize,
    /// Bytes of a version
    #[arg(long, value_name = "BYTES", default_value_t = 5_000_000, value_parser = clap::value_parser!(u64).range(1..))]
    parameters: u64,
}

/// Versions in which readers stop, each reader in one of them.
const VERSIONS: usize = 8;
/// The memory that all of them together may cost, megabytes.
const BOUND: f64 = 60.0;

impl Stalled {
    pub(super) fn new(connections: usize, parameters: u64) -> Self {
        Self { connections, parameters }
    }

    /// Measures and prints.
    ///
    /// # Errors
    /// A process of the measurement that fails.
    pub fn run(&self) -> Result<()> {
        let (connections, size) = (self.connections.to_string(), self.parameters.to_string());
        let mut host = Process::host(&["--kind", "learner", "--parameters", &size])?;
        let versions = VERSIONS.to_string();
        let stops = ["--actors", &connections, "--watch", "--stall-within", &versions];
        let mut crowd = Process::crowd(&host, &stops)?;
        let mut healthy = Process::crowd(&host, &["--actors", "1", "--watch"])?;
        crowd.wait_for("connected", self.connections as f64, PATIENCE)?;
        healthy.wait_for("connected", 1.0, PATIENCE)?;
        let before = host.usage()?;
        let mut times = Vec::new();
        for version in 1..=6 * VERSIONS {
            host.ask("publish")?;
            let start = Instant::now();
            healthy.wait_for("versions", version as f64, PATIENCE)?;
            times.push(start.elapsed().as_secs_f64());
            let stopped = (0..self.connections).filter(|actor| actor % VERSIONS < version).count();
            crowd.wait_for("stalled", stopped as f64, PATIENCE)?;
        }
        let after = host.usage()?;
        let growth = (after.peak - before.resident) / MEGABYTE;
        let line = json!({
            "figure": "publish.stalled", "value": growth, "unit": "MB", "bound": BOUND, "of_bound": growth / BOUND,
            "stalled": crowd.number("stalled")?,
            "resident_growth_mb": (after.resident - before.resident) / MEGABYTE,
            "a_healthy_reader_waits_s": median(times.split_off(VERSIONS)),
        });
        println!("{line}");
        Ok(())
    }
}
