//! A process on this machine, and the signals that a test sends it.

use std::fs::{self, File};
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Time between two checks of a condition.
pub(crate) const POLL: Duration = Duration::from_millis(50);

/// A process with a log. Dropping it kills the process.
pub struct Process {
    pub(crate) child: Child,
    pub(crate) log: PathBuf,
}

impl Process {
    /// Kills the process at once (SIGKILL), as a power cut would.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn kill(mut self) -> Result<()> {
        self.child.kill().context("cannot kill")?;
        self.child.wait().context("cannot wait")?;
        Ok(())
    }

    /// Bytes of its own memory, without mapped files.
    ///
    /// # Errors
    /// When the system gives no answer.
    pub fn resident(&self) -> Result<u64> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).context("no such process")?;
        let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:")).context("no RssAnon")?;
        let kilobytes: u64 = line.trim().trim_end_matches(" kB").parse().context("RssAnon is no number")?;
        Ok(kilobytes * 1024)
    }

    /// `path` as this process sees it; the process may have its own mounts.
    pub fn sees(&self, path: &Path) -> PathBuf {
        let root = PathBuf::from(format!("/proc/{}/root", self.child.id()));
        root.join(path.strip_prefix("/").unwrap_or(path))
    }

    /// Asks the process to end (SIGTERM).
    ///
    /// # Errors
    /// When the system refuses.
    pub fn ask_to_end(&self) -> Result<()> {
        self.signal(Signal::TERM)
    }

    /// Asks the process to end (SIGTERM) and waits.
    ///
    /// # Errors
    /// When the process still runs after `limit`.
    pub async fn terminate(mut self, limit: Duration) -> Result<ExitStatus> {
        self.ask_to_end()?;
        let deadline = Instant::now() + limit;
        while Instant::now() < deadline {
            if let Some(status) = self.ended()? {
                return Ok(status);
            }
            tokio::time::sleep(POLL).await;
        }
        bail!("the process still runs {limit:?} after SIGTERM: {}", self.log())
    }

    /// Stops the process (SIGSTOP) until [`resume`](Self::resume).
    ///
    /// # Errors
    /// When the system refuses.
    pub fn pause(&self) -> Result<()> {
        self.signal(Signal::STOP)
    }

    /// Resumes the process (SIGCONT).
    ///
    /// # Errors
    /// When the system refuses.
    pub fn resume(&self) -> Result<()> {
        self.signal(Signal::CONT)
    }

    fn signal(&self, signal: Signal) -> Result<()> {
        let pid = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw).context("no process id")?;
        kill_process(pid, signal).context("cannot signal")
    }

    /// Its exit status, if the process has ended.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn ended(&mut self) -> Result<Option<ExitStatus>> {
        self.child.try_wait().context("cannot wait")
    }

    /// Waits until the process ends by itself.
    ///
    /// # Errors
    /// When the process still runs after `limit`, with its log.
    pub async fn until_it_ends(&mut self, limit: Duration) -> Result<ExitStatus> {
        let deadline = Instant::now() + limit;
        loop {
            match self.ended()? {
                Some(status) => return Ok(status),
                None if Instant::now() > deadline => bail!("the process still runs after {limit:?}: {}", self.log()),
                None => tokio::time::sleep(POLL).await,
            }
        }
    }

    /// The whole log.
    pub fn log(&self) -> String {
        read(&self.log)
    }

    /// Host and port of a learner's metrics page, as it logs them.
    ///
    /// # Errors
    /// When the learner logs no address.
    pub fn metrics_address(&self) -> Result<String> {
        let log = self.log();
        let mut lines = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
        lines.find_map(|line| Some(line["metrics"].as_str()?.to_owned())).context("no address")
    }

    /// A learner's metrics page.
    ///
    /// # Errors
    /// When the learner logs no address, or does not answer.
    pub fn metrics_page(&self) -> Result<String> {
        let mut stream = TcpStream::connect(self.metrics_address()?)?;
        stream.write_all(b"GET /metrics HTTP/1.1\r\nHost: learner\r\n\r\n")?;
        let mut page = String::new();
        stream.read_to_string(&mut page)?;
        Ok(page)
    }

    /// Waits until the log contains `text`.
    ///
    /// # Errors
    /// When the process ends or `limit` passes before that, with the log.
    pub async fn until_log_holds(&mut self, text: &str, limit: Duration) -> Result<()> {
        self.until_log(text, limit, |log| log.contains(text)).await
    }

    /// Waits until the log satisfies a condition.
    ///
    /// # Errors
    /// When the process ends or `limit` passes before that, with the log.
    pub async fn until_log(&mut self, what: &str, limit: Duration, condition: impl Fn(&str) -> bool) -> Result<()> {
        let deadline = Instant::now() + limit;
        loop {
            // This comes first, so that the log below holds everything that an ended process wrote.
            let ended = self.ended()?;
            if condition(&self.log()) {
                return Ok(());
            }
            if ended.is_some() || Instant::now() > deadline {
                bail!("`{what}` is not in the log ({ended:?}): {}", self.log());
            }
            tokio::time::sleep(POLL).await;
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn read(path: &Path) -> String {
    let mut text = Vec::new();
    let _ = File::open(path).and_then(|mut file| std::io::Read::read_to_end(&mut file, &mut text));
    String::from_utf8_lossy(&text).into_owned()
}
