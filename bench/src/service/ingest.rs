//! Unrolls from many connections into batches.

use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use clap::Args;
use serde_json::json;

use super::certificates::Certificates;
use super::figure::{Round, show};
use super::paper::{PATIENCE, experiment, positive};
use super::process::Process;

/// Measure unrolls that are validated and copied into batches, against a bare tonic stream that drops what it reads, and
/// over TLS against the same without TLS
#[derive(Debug, Args)]
pub struct Ingest {
    /// Numbers of connections; one figure for each
    #[arg(long, value_name = "N", num_args = 1.., default_values_t = [32, 1000])]
    connections: Vec<usize>,
    /// Seconds of a round
    #[arg(long, default_value_t = 5.0, value_parser = positive)]
    seconds: f64,
    /// Number of rounds
    #[arg(long, default_value_t = 5)]
    rounds: usize,
}

/// What serves, what sends, and the options for TLS.
type Kind<'a> = (&'a str, &'a str, &'a [&'a str]);

impl Ingest {
    /// Measures and prints.
    ///
    /// # Errors
    /// A process of the measurement that fails.
    pub fn run(&self) -> Result<()> {
        self.connections.iter().try_for_each(|connections| self.measure(*connections))
    }

    fn measure(&self, connections: usize) -> Result<()> {
        let bytes = experiment()?.2.size();
        let certificates = Certificates::new()?;
        let tls = certificates.option();
        let kinds: [Kind; 3] = [("learner", "grpc", &[]), ("tonic", "bare-grpc", &[]), ("learner", "grpc", &tls)];
        let mut found = [Vec::new(), Vec::new(), Vec::new()];
        for _ in 0..self.rounds {
            for (kind, found) in kinds.iter().zip(&mut found) {
                found.push(self.round(*kind, connections)?);
            }
        }
        let [plain, floors, over_tls] = &found;
        let rest = json!({ "connections": connections, "unroll_bytes": bytes });
        show(&format!("ingest.{connections}"), plain, floors, rest.clone());
        show(&format!("ingest.{connections}.tls"), over_tls, plain, rest);
        Ok(())
    }

    fn round(&self, (kind, crowd, tls): Kind, connections: usize) -> Result<Round> {
        let mut host = Process::host(&[&["--kind", kind], tls].concat())?;
        let before = host.usage()?;
        let connections = connections.to_string();
        let arguments = [&["--kind", crowd, "--actors", &connections, "--window", "4"], tls].concat();
        let mut crowd = Process::crowd(&host, &arguments)?;
        crowd.wait_for("acked", 1000.0, PATIENCE)?;
        let (start, began) = (Instant::now(), (host.usage()?, host.number("bytes")?));
        sleep(Duration::from_secs_f64(self.seconds));
        let (took, ended) = (start.elapsed(), (host.usage()?, host.number("bytes")?));
        ensure!(crowd.number("failures")? == 0.0, "an actor of the crowd failed: {}", crowd.ask("stats")?);
        let round = Round::new(&began.0, &ended.0, ended.1 - began.1, took);
        Ok(round.grown_from(before.resident, &ended.0))
    }
}
