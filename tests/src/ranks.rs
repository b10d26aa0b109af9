//! Several learners that train one run on this machine.

use std::net::UdpSocket;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use comic_proto::v1::{Accounting, Status};
use serde_json::Value;

use crate::process::Process;
use crate::steps::LIMIT;
use crate::system::{System, free_port, program};

/// The learners of one run. Rank 0 is the learner of the system.
pub struct Ranks {
    /// Rank 0 and its actors.
    pub system: System,
    /// The other ranks, from rank 1 on, while they run.
    pub others: Vec<Process>,
    size: usize,
    port: u16,
    /// Reserves the port for this system.
    _kept: UdpSocket,
}

impl Ranks {
    /// A run of so many learners with these arguments. It starts nothing.
    ///
    /// # Errors
    /// When there is no directory or port.
    pub fn new(size: usize, arguments: &[&str]) -> Result<Self> {
        let system = System::new(arguments)?;
        let (port, kept) = free_port()?;
        Ok(Self { system, others: Vec::new(), size, port, _kept: kept })
    }

    /// Starts every rank, and returns the first status of rank 0.
    ///
    /// # Errors
    /// When rank 0 does not serve in time, with the end of its log.
    pub async fn start(&mut self) -> Result<Status> {
        self.others.clear();
        for rank in 1..self.size {
            let other = self.start_rank(rank, &[])?;
            self.others.push(other);
        }
        let own = self.system.arguments.len();
        let world = self.world(0);
        self.system.arguments.extend(world);
        let started = self.system.start_learner(LIMIT).await;
        self.system.arguments.truncate(own);
        started
    }

    /// Starts a rank that is not the first, with more arguments.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub fn start_rank(&mut self, rank: usize, more: &[&str]) -> Result<Process> {
        let mut command = Command::new(program("comic-learner")?);
        command.args(&self.system.arguments).args(self.world(rank)).args(["--port", "0"]).args(more);
        match rank {
            0 => command.arg("--run").arg(self.system.run()),
            // It must not need one.
            _ => command.args(["--run", "/dev/null/no-directory"]),
        };
        self.system.spawn(&format!("rank-{rank}"), command)
    }

    fn world(&self, rank: usize) -> [String; 6] {
        let rendezvous = format!("127.0.0.1:{}", self.port);
        let (size, rank) = (self.size.to_string(), rank.to_string());
        ["--world-size".into(), size, "--rank".into(), rank, "--rendezvous".into(), rendezvous]
    }
}

/// The accounting of all ranks, as rank 0's metrics have it.
///
/// # Errors
/// When there are no metrics yet.
pub fn accounting_of_all(status: &Status) -> Result<Accounting> {
    let metrics: Value = serde_json::from_str(&status.metrics_json)?;
    let number = |value: &Value| value.as_u64().context("no accounting yet");
    let accounting = &metrics["accounting"];
    let dropped = |reason: &str| number(&accounting["dropped"][reason]);
    let all = Accounting {
        produced: number(&accounting["produced"])?,
        trained: number(&accounting["trained"])?,
        dropped_stale: dropped("stale")?,
        dropped_invalid: dropped("invalid")?,
        dropped_superseded: dropped("superseded")?,
        dropped_lost_at_restart: dropped("lost_at_restart")?,
        in_flight: number(&accounting["in_flight"])?,
        ..Accounting::default()
    };
    ensure!(crate::accounting::balance(&all), "the accounting of all ranks does not balance: {all:?}");
    Ok(all)
}
