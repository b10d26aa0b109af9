//! The processes of a measurement. Each reads requests from standard input, one a line, and answers each with one line of
//! JSON.

use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use serde_json::Value;

use super::usage::Usage;

/// Time between two requests for a number that is waited for.
const POLL: Duration = Duration::from_millis(20);

/// A child process, killed when this is dropped.
#[derive(Debug)]
pub(super) struct Process {
    child: Child,
    requests: ChildStdin,
    answers: BufReader<ChildStdout>,
    /// Where a host listens; empty for a crowd.
    address: String,
}

impl Process {
    pub(super) fn host(arguments: &[&str]) -> Result<Self> {
        let mut host = Self::start("host", arguments)?;
        host.address = host.answer()?["listening"].as_str().context("the host printed no address")?.into();
        Ok(host)
    }

    pub(super) fn crowd(host: &Self, arguments: &[&str]) -> Result<Self> {
        Self::start("crowd", &[&["--host", &host.address], arguments].concat())
    }

    fn start(what: &str, arguments: &[&str]) -> Result<Self> {
        let program = std::env::current_exe().context("cannot find the path of this program")?;
        let mut child = Command::new(program)
            .arg(what)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start the {what}"))?;
        let requests = child.stdin.take().context("a child without standard input")?;
        let answers = BufReader::new(child.stdout.take().context("a child without standard output")?);
        Ok(Self { child, requests, answers, address: String::new() })
    }

    pub(super) fn ask(&mut self, request: &str) -> Result<Value> {
        writeln!(self.requests, "{request}").context("a process of the measurement has ended")?;
        self.answer()
    }

    fn answer(&mut self) -> Result<Value> {
        let mut line = String::new();
        self.answers.read_line(&mut line)?;
        let line = line.trim();
        serde_json::from_str(line)
            .with_context(|| format!("unreadable answer of a process of the measurement: `{line}`"))
    }

    pub(super) fn usage(&mut self) -> Result<Usage> {
        let answer = self.ask("usage")?;
        serde_json::from_value(answer).context("unreadable usage")
    }

    /// Resets the peak of the process's memory to what it has now, where the system allows that.
    pub(super) fn reset_peak(&self) {
        let _ = std::fs::write(format!("/proc/{}/clear_refs", self.child.id()), "5");
    }

    /// The number `name` of the process.
    pub(super) fn number(&mut self, name: &str) -> Result<f64> {
        let stats = self.ask("stats")?;
        stats[name].as_f64().with_context(|| format!("no `{name}` in {stats}"))
    }

    /// Waits until the number `name` is at least `least`.
    pub(super) fn wait_for(&mut self, name: &str, least: f64, patience: Duration) -> Result<()> {
        let start = Instant::now();
        while self.number(name)? < least {
            ensure!(start.elapsed() < patience, "fewer than {least} {name} after {patience:?}: {}", self.ask("stats")?);
            sleep(POLL);
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

/// Answers the requests on standard input until it ends. The request `usage` has the same answer in every process.
pub(super) fn answer_requests(mut answer: impl FnMut(&str) -> Value) -> Result<()> {
    for request in std::io::stdin().lock().lines() {
        let request = request.context("cannot read requests")?;
        let answer = match request.as_str() {
            "usage" => serde_json::to_value(Usage::now())?,
            request => answer(request),
        };
        writeln!(std::io::stdout(), "{answer}").context("cannot write an answer")?;
    }
    Ok(())
}
