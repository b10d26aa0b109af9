//! Parameters to many connections.

use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::Result;
use clap::Args;
use serde_json::json;

use super::certificates::Certificates;
use super::figure::{MEGABYTE, Round, extended, show};
use super::paper::PATIENCE;
use super::process::Process;
use super::stalled::Stalled;

/// Measure parameters to many connections against bare sockets, then with new versions all the time, then with readers
/// that stop reading
#[derive(Debug, Args)]
pub struct Publish {
    /// Number of connections
    #[arg(long, value_name = "N", default_value_t = 1000)]
    connections: usize,
    /// Bytes of a version
    #[arg(long, value_name = "BYTES", default_value_t = 5_000_000, value_parser = clap::value_parser!(u64).range(1..))]
    parameters: u64,
    /// Number of rounds, of three versions each
    #[arg(long, default_value_t = 3)]
    rounds: usize,
}

/// Versions of a round.
const VERSIONS: usize = 3;
/// Updates between versions in the paper's scale, and the seconds between versions that these come to.
const PERIODS: [(usize, f64); 2] = [(1, 0.1), (100, 10.0)];
/// Seconds for which the lag is measured.
const LAG_SECONDS: f64 = 40.0;

/// What serves, what reads, and the options for TLS.
type Kind<'a> = (&'a str, &'a str, &'a [&'a str]);

impl Publish {
    /// Measures and prints.
    ///
    /// # Errors
    /// A process of the measurement that fails.
    pub fn run(&self) -> Result<()> {
        self.throughput()?;
        PERIODS.iter().try_for_each(|(period, every)| self.lag(*period, *every))?;
        Stalled::new(self.connections, self.parameters).run()
    }

    /// The first two kinds of readers drop what they read. The third decodes it, as actors do. The fourth also decrypts
    /// it.
    fn throughput(&self) -> Result<()> {
        let certificates = Certificates::new()?;
        let tls = certificates.option();
        let kinds: [Kind; 4] = [
            ("learner", "readers", &[]),
            ("sockets", "sockets", &[]),
            ("learner", "grpc", &[]),
            ("learner", "grpc", &tls),
        ];
        let mut found = [Vec::new(), Vec::new(), Vec::new(), Vec::new()];
        for _ in 0..self.rounds {
            for (kind, found) in kinds.iter().zip(&mut found) {
                found.push(self.round(*kind)?);
            }
        }
        let [dropped, floors, decoded, over_tls] = &found;
        let connections = self.connections;
        let rest = json!({ "connections": connections, "parameters_bytes": self.parameters });
        show(&format!("publish.{connections}"), dropped, floors, rest.clone());
        show(&format!("publish.{connections}.decoded"), decoded, floors, rest.clone());
        show(&format!("publish.{connections}.decoded.tls"), over_tls, decoded, rest);
        Ok(())
    }

    /// A version is published when every connection has read the one before.
    fn round(&self, (kind, crowd, tls): Kind) -> Result<Round> {
        let (connections, size) = (self.connections.to_string(), self.parameters.to_string());
        let mut host = Process::host(&[&["--kind", kind, "--parameters", &size], tls].concat())?;
        let arguments = [&["--kind", crowd, "--actors", &connections, "--watch", "--parameters", &size], tls].concat();
        let mut crowd = Process::crowd(&host, &arguments)?;
        crowd.wait_for("connected", self.connections as f64, PATIENCE)?;
        // One version to warm up.
        host.ask("publish")?;
        crowd.wait_for("versions", self.connections as f64, PATIENCE)?;
        let (start, before) = (Instant::now(), host.usage()?);
        for version in 2..=VERSIONS + 1 {
            host.ask("publish")?;
            crowd.wait_for("versions", (version * self.connections) as f64, PATIENCE)?;
        }
        let bytes = (VERSIONS * self.connections) as f64 * self.parameters as f64;
        Ok(Round::new(&before, &host.usage()?, bytes, start.elapsed()))
    }

    /// A new version after every `every` seconds, whether or not the last one was read.
    fn lag(&self, target_period: usize, every: f64) -> Result<()> {
        let (every, size) = (every.to_string(), self.parameters.to_string());
        let mut host = Process::host(&["--kind", "learner", "--parameters", &size, "--publish-every", &every])?;
        let before = host.usage()?;
        let connections = self.connections;
        let mut crowd = Process::crowd(&host, &["--actors", &connections.to_string(), "--watch"])?;
        crowd.wait_for("versions", connections as f64, PATIENCE)?;
        host.reset_peak();
        let connected = host.usage()?.resident;
        let (start, began, read) = (Instant::now(), host.usage()?, crowd.number("bytes")?);
        crowd.ask("reset")?;
        sleep(Duration::from_secs_f64(LAG_SECONDS));
        let stats = crowd.ask("stats")?;
        let bytes = stats["bytes"].as_f64().unwrap_or_default() - read;
        let round = Round::new(&began, &host.usage()?, bytes, start.elapsed());
        let rest = json!({
            "peak_growth_mb": (host.usage()?.peak - connected) / MEGABYTE,
            "connections_mb": (connected - before.resident) / MEGABYTE,
            "lag_versions": stats["lag_versions"], "lag_seconds": stats["lag_seconds"],
            "longest_without_a_version_s": stats["longest_without_a_version"],
        });
        let line = round.line(&format!("publish.{connections}.period_{target_period}"));
        println!("{}", extended(line, rest));
        Ok(())
    }
}
