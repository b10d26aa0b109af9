//! The processes of a measurement: told what to do by lines on their stdin, each answered by one line of JSON.

use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use serde_json::Value;

use super::GLANCE;
use super::usage::Usage;

/// A process that lives as long as this does.
#[derive(Debug)]
pub(super) struct Process {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
    /// Of a host, where it listens.
    address: String,
}

impl Process {
    pub(super) fn host(arguments: &[&str]) -> Result<Self> {
        let mut host = Self::start("host", arguments)?;
        host.address = host.answer()?["listening"].as_str().context("the host does not say where it listens")?.into();
        Ok(host)
    }

    pub(super) fn crowd(host: &Self, arguments: &[&str]) -> Result<Self> {
        Self::start("crowd", &[&["--host", &host.address], arguments].concat())
    }

    fn start(what: &str, arguments: &[&str]) -> Result<Self> {
        let program = std::env::current_exe().context("cannot tell where this program lies")?;
        let mut command = Command::new(program);
        if std::env::var_os("RUST_LOG").is_none() {
            // Thousands of actors join.
            command.env("RUST_LOG", "warn");
        }
        let mut child = command
            .args(["load", what])
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start the {what}"))?;
        let orders = child.stdin.take().context("a child's stdin")?;
        let answers = BufReader::new(child.stdout.take().context("a child's stdout")?);
        Ok(Self { child, orders, answers, address: String::new() })
    }

    pub(super) fn ask(&mut self, order: &str) -> Result<Value> {
        writeln!(self.orders, "{order}").context("a process of the measurement is gone")?;
        self.answer()
    }

    fn answer(&mut self) -> Result<Value> {
        let mut line = String::new();
        self.answers.read_line(&mut line)?;
        serde_json::from_str(&line).with_context(|| format!("a process of the measurement answers `{}`", line.trim()))
    }

    pub(super) fn usage(&mut self) -> Result<Usage> {
        let answer = self.ask("usage")?;
        serde_json::from_value(answer).context("unreadable usage")
    }

    /// From now on the peak of its memory is that since now, where the system allows it.
    pub(super) fn forget_peak(&self) {
        let _ = std::fs::write(format!("/proc/{}/clear_refs", self.child.id()), "5");
    }

    /// One of its numbers.
    pub(super) fn number(&mut self, name: &str) -> Result<f64> {
        let stats = self.ask("stats")?;
        stats[name].as_f64().with_context(|| format!("no `{name}` in {stats}"))
    }

    /// Waits until one of its numbers is at least so large.
    pub(super) fn wait_for(&mut self, name: &str, least: f64, patience: Duration) -> Result<()> {
        let start = Instant::now();
        while self.number(name)? < least {
            ensure!(start.elapsed() < patience, "no {least} {name} after {patience:?}: {}", self.ask("stats")?);
            sleep(GLANCE);
        }
        Ok(())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Answers orders from stdin until it ends.
pub(super) fn obey(mut answer: impl FnMut(&str) -> Value) -> Result<()> {
    for order in std::io::stdin().lock().lines() {
        let order = order.context("cannot read orders")?;
        let answer = match order.as_str() {
            "usage" => serde_json::to_value(Usage::now())?,
            order => answer(order),
        };
        writeln!(std::io::stdout(), "{answer}").context("nobody reads the answers")?;
    }
    Ok(())
}
