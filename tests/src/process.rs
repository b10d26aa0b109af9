//! A process on this machine, and what a test does to it.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::{Pid, Signal, kill_process};

/// How often a condition is looked at again.
pub(crate) const POLL: Duration = Duration::from_millis(50);

/// A process with a log, killed when dropped.
pub struct Process {
    pub(crate) child: Child,
    pub(crate) log: PathBuf,
}

impl Process {
    /// Ends it on the spot (SIGKILL), as a power cut would.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn kill(mut self) -> Result<()> {
        self.child.kill().context("cannot kill")?;
        self.child.wait().context("cannot wait")?;
        Ok(())
    }

    /// Bytes of memory it has for itself, without the files it maps.
    ///
    /// # Errors
    /// When the system does not say.
    pub fn resident(&self) -> Result<u64> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).context("no such process")?;
        let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:")).context("no RssAnon")?;
        let kilobytes: u64 = line.trim().trim_end_matches(" kB").parse().context("RssAnon is no number")?;
        Ok(kilobytes * 1024)
    }

    /// `path` as this process sees it, if it has disks of its own.
    pub fn sees(&self, path: &Path) -> PathBuf {
        let root = PathBuf::from(format!("/proc/{}/root", self.child.id()));
        root.join(path.strip_prefix("/").unwrap_or(path))
    }

    /// Asks it to leave (SIGTERM) and waits.
    ///
    /// # Errors
    /// When it is still there after `limit`.
    pub async fn terminate(mut self, limit: Duration) -> Result<ExitStatus> {
        self.signal(Signal::TERM)?;
        let deadline = Instant::now() + limit;
        while Instant::now() < deadline {
            if let Some(status) = self.ended()? {
                return Ok(status);
            }
            tokio::time::sleep(POLL).await;
        }
        bail!("still there {limit:?} after SIGTERM: {}", self.log())
    }

    /// Stops it where it is (SIGSTOP), until it [`resumes`](Self::resume).
    ///
    /// # Errors
    /// When the system refuses.
    pub fn pause(&self) -> Result<()> {
        self.signal(Signal::STOP)
    }

    /// Lets it go on (SIGCONT).
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

    /// How it ended, if it has.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn ended(&mut self) -> Result<Option<ExitStatus>> {
        self.child.try_wait().context("cannot wait")
    }

    /// Waits until it ends by itself.
    ///
    /// # Errors
    /// When it is still there after `limit`, with its log.
    pub async fn until_it_ends(&mut self, limit: Duration) -> Result<ExitStatus> {
        let deadline = Instant::now() + limit;
        loop {
            match self.ended()? {
                Some(status) => return Ok(status),
                None if Instant::now() > deadline => bail!("still there after {limit:?}: {}", self.log()),
                None => tokio::time::sleep(POLL).await,
            }
        }
    }

    /// Everything it has written.
    pub fn log(&self) -> String {
        read(&self.log)
    }

    /// Waits until its log holds `text`.
    ///
    /// # Errors
    /// When it ends or `limit` is over before that, with the log.
    pub async fn until_log_holds(&mut self, text: &str, limit: Duration) -> Result<()> {
        self.until_log(text, limit, |log| log.contains(text)).await
    }

    /// Waits until its log satisfies a condition.
    ///
    /// # Errors
    /// When it ends or `limit` is over before that, with the log.
    pub async fn until_log(&mut self, what: &str, limit: Duration, condition: impl Fn(&str) -> bool) -> Result<()> {
        let deadline = Instant::now() + limit;
        loop {
            // Asked first: what it wrote before it ended is there then.
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
