//! A child process with a log file.

use std::fs::{self, File, OpenOptions};
use std::io::{Read, Seek, SeekFrom};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use rustix::process::{Pid, Signal, kill_process};

/// A running learner or actor. A terminal's Ctrl-C does not reach it: this program sends it one request to stop. A learner
/// that receives two requests exits without its last checkpoint.
pub(super) struct Process {
    pub(super) name: String,
    log: PathBuf,
    /// The size of the log when this process started.
    log_start: u64,
    child: Child,
    started: Instant,
}

impl Process {
    /// Starts `command`. Its standard output and standard error are appended to `log`.
    pub(super) fn start(name: impl Into<String>, command: &mut Command, log: PathBuf) -> Result<Self> {
        let name = name.into();
        let output = append(&log)?;
        let log_start = output.metadata().map_or(0, |metadata| metadata.len());
        let child = command
            .stdin(Stdio::null())
            .stdout(output.try_clone().context("cannot share a log")?)
            .stderr(output)
            .process_group(0)
            .spawn()
            .with_context(|| format!("cannot start {name}"))?;
        Ok(Self { name, log, log_start, child, started: Instant::now() })
    }

    /// How the process ended, if it has ended.
    pub(super) fn ended(&mut self) -> Result<Option<ExitStatus>> {
        self.child.try_wait().with_context(|| format!("cannot wait for {}", self.name))
    }

    /// The time since the start of the process.
    pub(super) fn age(&self) -> Duration {
        self.started.elapsed()
    }

    /// The output of this process.
    pub(super) fn output(&self) -> String {
        let mut text = Vec::new();
        if let Ok(mut file) = File::open(&self.log) {
            let _ = file.seek(SeekFrom::Start(self.log_start)).and_then(|_| file.read_to_end(&mut text));
        }
        String::from_utf8_lossy(&text).into_owned()
    }

    /// The last lines of the output, and the path of the log.
    pub(super) fn last_lines(&self) -> String {
        let output = self.output();
        let lines: Vec<&str> = output.lines().collect();
        let last = lines[lines.len().saturating_sub(12)..].join("\n  ");
        format!("the end of {}:\n  {last}", self.log.display())
    }

    /// Requests the process to end (SIGTERM).
    pub(super) fn terminate(&self) {
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            // An error means that it has ended already.
            let _ = kill_process(pid, Signal::TERM);
        }
    }

    /// Kills the process at once (SIGKILL), as a machine that is taken away does.
    pub(super) fn kill(&mut self) {
        // An error means that it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Waits until the process has ended, and kills it after `limit`. Returns whether it ended by itself.
    pub(super) fn wait(&mut self, limit: Duration) -> bool {
        let deadline = Instant::now() + limit;
        while Instant::now() < deadline {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return true;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        self.kill();
        false
    }
}

impl Drop for Process {
    /// Ends the process if this program ends with an error.
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            self.terminate();
            self.wait(Duration::from_secs(10));
        }
    }
}

/// Opens a log for appending.
pub(super) fn append(log: &Path) -> Result<File> {
    let file = OpenOptions::new().create(true).append(true).open(log);
    file.with_context(|| format!("cannot write {}", log.display()))
}

/// Reads a file that grows, line by line.
pub(super) struct Tail {
    path: PathBuf,
    position: u64,
}

impl Tail {
    /// Begins after the last line that the file has. The learner removes what a kill left of a line behind it.
    pub(super) fn new(path: PathBuf) -> Self {
        let text = fs::read(&path).unwrap_or_default();
        let position = text.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end as u64 + 1);
        Self { path, position }
    }

    /// The complete lines since the last call.
    pub(super) fn lines(&mut self) -> Vec<String> {
        let Ok(mut file) = File::open(&self.path) else { return Vec::new() };
        let mut text = String::new();
        if file.seek(SeekFrom::Start(self.position)).is_err() || file.read_to_string(&mut text).is_err() {
            return Vec::new();
        }
        let whole = text.rfind('\n').map_or(0, |end| end + 1);
        self.position += whole as u64;
        text[..whole].lines().map(str::to_owned).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn a_tail_gives_complete_new_lines_once() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        fs::write(&path, "old\n").unwrap();
        let mut tail = Tail::new(path.clone());
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        file.write_all(b"one\ntwo\nthr").unwrap();
        assert_eq!(tail.lines(), ["one", "two"]);
        file.write_all(b"ee\n").unwrap();
        assert_eq!(tail.lines(), ["three"]);
        assert!(tail.lines().is_empty());
    }

    #[test]
    fn a_terminated_process_ends_by_itself_and_its_output_is_kept() {
        let directory = tempfile::tempdir().unwrap();
        let log = directory.path().join("child.log");
        let mut command = Command::new("sh");
        command.args(["-c", "trap 'echo bye; exit 0' TERM; echo hello; while :; do sleep 0.01; done"]);
        let mut process = Process::start("child", &mut command, log).unwrap();
        let deadline = Instant::now() + Duration::from_secs(20);
        while !process.output().contains("hello") && Instant::now() < deadline {
            std::thread::yield_now();
        }
        process.terminate();
        assert!(process.wait(Duration::from_secs(20)));
        assert!(process.last_lines().ends_with("hello\n  bye"), "{}", process.last_lines());
    }
}
