//! Runs a learner and actors as real processes on this machine.

use std::ffi::OsString;
use std::fs::{self, OpenOptions};
use std::net::{TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use comic_proto::Access;
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{Status, StatusRequest};
use serde_json::Value;
use tempfile::TempDir;

use crate::accounting::balance;
use crate::process::{POLL, Process};
use crate::repository::root;

/// Limit of a status call.
const CALL_LIMIT: Duration = Duration::from_secs(5);

/// Options of a learner with a small experiment: an update takes milliseconds.
pub const SMALL: [&str; 30] = [
    "--preset",
    "quickstart",
    "--clips",
    "builtin:CMU_007_01",
    "--set",
    "network.encoder=[32]",
    "--set",
    "network.mlp.hidden=[32]",
    "--set",
    "network.value=[32]",
    "--set",
    "network.normaliser_steps=256",
    "--set",
    "vmpo.target_period=1",
    "--set",
    "vmpo.gradient_steps=1",
    "--set",
    "vmpo.minibatch_unrolls=8",
    "--set",
    "unroll.length=8",
    "--set",
    "unroll.batch=8",
    "--set",
    "actor.environments=2",
    "--set",
    "learner.checkpoint_seconds=0.5",
    "--set",
    "learner.metrics_seconds=0.2",
    "--set",
    "budget.minutes=0",
];

/// A program of this workspace, built beside the running test.
///
/// # Errors
/// When the program is not built, with the command that builds it.
pub fn program(name: &str) -> Result<PathBuf> {
    let own = std::env::current_exe().context("cannot tell where this test lies")?;
    // Tests lie in target/PROFILE/deps, programs in target/PROFILE.
    let directory = own.ancestors().nth(2).context("this test lies in no target directory")?;
    let path = directory.join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
    ensure!(
        path.exists(),
        "there is no {}: `cargo build --release --package comic-learner --package comic-actor` builds the programs \
         (`cargo xtask test` does it by itself)",
        path.display()
    );
    Ok(path)
}

/// Removes the user's settings, which would change how the programs reach the learner.
fn without_settings(command: &mut Command) {
    let settings = std::env::vars_os().map(|(name, _)| name.to_string_lossy().into_owned());
    for name in settings.filter(|name| name.starts_with("COMIC_")) {
        command.env_remove(name);
    }
}

/// The help text of a command.
///
/// # Errors
/// When the program fails.
pub fn help(name: &str, command: &[&str]) -> Result<String> {
    let output = Command::new(program(name)?).args(command).arg("--help").output();
    Ok(String::from_utf8(output.with_context(|| format!("cannot start {name}"))?.stdout)?)
}

/// The Python that has dm_control, torch and TensorBoard.
///
/// # Errors
/// When it does not exist, with the command that makes it.
pub fn python() -> Result<PathBuf> {
    let path = root().join(".deps/python/requirements-tests/bin/python");
    ensure!(path.exists(), "no file {}; `cargo xtask test` makes it", path.display());
    Ok(path)
}

/// A learner and actors of one run. Dropping it kills every process that still runs.
pub struct System {
    directory: TempDir,
    /// The address at which the learner listens. The default is the loopback address.
    pub host: String,
    port: u16,
    /// Reserves the port for this system.
    _kept: UdpSocket,
    pub(crate) arguments: Vec<String>,
    /// How actors and tests reach the learner. With an authority they use https.
    pub access: Access,
    /// The learner's `RUST_LOG`, if it is not the default.
    pub log_level: Option<String>,
    /// Size in bytes of a disk for the run. The disk needs root, and disappears when the learner ends.
    pub disk: Option<u64>,
    /// A library that replaces the clock of every program, and the file from which it reads the time.
    pub clock: Option<(PathBuf, PathBuf)>,
    /// The learner's process, while it runs.
    pub learner: Option<Process>,
    /// Bytes of memory of the learner before the first actor joined.
    alone: u64,
    /// The logs of the actors and of the simulated crowds. A crowd does not log acknowledged unrolls.
    actors: Vec<PathBuf>,
    started: usize,
}

/// Unrolls that were acknowledged, as the actors count them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Answered {
    /// Their number.
    pub unrolls: u64,
    /// Whether these are all unrolls that were sent: every actor ended normally, with no unroll unanswered.
    pub all: bool,
}

impl System {
    /// A run whose learner has these arguments. It starts nothing.
    ///
    /// # Errors
    /// When there is no directory or port.
    pub fn new(arguments: &[&str]) -> Result<Self> {
        let (port, kept) = free_port()?;
        Ok(Self {
            directory: tempfile::tempdir().context("cannot make a directory")?,
            host: String::from("127.0.0.1"),
            port,
            _kept: kept,
            arguments: arguments.iter().map(|argument| (*argument).to_owned()).collect(),
            access: Access::default(),
            log_level: None,
            disk: None,
            clock: None,
            learner: None,
            alone: 0,
            actors: Vec::new(),
            started: 0,
        })
    }

    /// Overrides a field of the experiment at the next start of the learner.
    pub fn set(&mut self, field: &str) {
        self.arguments.extend(["--set".to_owned(), field.to_owned()]);
    }

    /// The learner's address.
    pub fn url(&self) -> String {
        let scheme = if self.access.ca.is_some() { "https" } else { "http" };
        format!("{scheme}://{}", self.address())
    }

    /// Host and port of the learner.
    pub fn address(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    /// The run's directory.
    pub fn run(&self) -> PathBuf {
        self.directory.path().join("run")
    }

    /// Starts the learner, or restarts it after a kill, and returns its first status.
    ///
    /// # Errors
    /// When the learner does not serve within `limit`, with the end of its log.
    pub async fn start_learner(&mut self, limit: Duration) -> Result<Status> {
        let mut command = match self.disk {
            Some(bytes) => on_a_disk_of(bytes, &self.run())?,
            None => Command::new(program("comic-learner")?),
        };
        command.args(&self.arguments).args(["--port", &self.port.to_string()]);
        command.arg("--run").arg(self.run());
        if let Some(level) = &self.log_level {
            command.env("RUST_LOG", level);
        }
        self.learner = Some(self.spawn("learner", command)?);
        let status = self.until("the learner serves", limit, |status| Some(status.clone())).await?;
        self.alone = self.learner.as_ref().context("no learner")?.resident()?;
        Ok(status)
    }

    /// Bytes by which the learner's memory has grown since its start.
    ///
    /// # Errors
    /// When no learner runs, or the system gives no answer.
    pub fn grown(&self) -> Result<u64> {
        Ok(self.learner.as_ref().context("no learner")?.resident()?.saturating_sub(self.alone))
    }

    /// The acknowledged unrolls, from the actors' logs.
    ///
    /// # Errors
    /// When a log is not what an actor writes.
    pub fn answered(&self) -> Result<Answered> {
        let mut answered = Answered { unrolls: 0, all: true };
        for log in &self.actors {
            let text = fs::read_to_string(log).context("no log")?;
            let Some((_, last)) = text.rsplit_once("Settled {") else {
                ensure!(!text.contains("exiting"), "an actor ended without logging its unrolls: {text}");
                answered.all = false;
                continue;
            };
            answered.all &= !text.contains("some unrolls were not acknowledged in time");
            for verdict in ["taken", "duplicate", "stale", "invalid"] {
                let rest = last.split_once(&format!("{verdict}: ")).map(|(_, rest)| rest);
                let digits = rest.and_then(|rest| rest.split(|letter: char| !letter.is_ascii_digit()).next());
                let count: u64 = digits.context("no count")?.parse().with_context(|| format!("{verdict} of {last}"))?;
                answered.unrolls += count;
            }
        }
        Ok(answered)
    }

    /// Starts an actor that gets only the learner's address.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub fn start_actor(&mut self) -> Result<Process> {
        let access = self.access.clone();
        self.start_actor_with(&access, |_| {})
    }

    /// Starts an actor with the credentials of `access`. `change` may change its command last.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub fn start_actor_with(&mut self, access: &Access, change: impl FnOnce(&mut Command)) -> Result<Process> {
        let mut command = Command::new(program("comic-actor")?);
        command.args(["--learner", &self.url()]).args(flags(access));
        change(&mut command);
        self.spawn("actor", command)
    }

    /// Starts a program that is no actor with these arguments and the learner's address.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub fn start(&mut self, name: &str, arguments: &[&str]) -> Result<Process> {
        let mut command = Command::new(program(name)?);
        command.args(arguments).args(["--learner", &self.url()]).args(flags(&self.access));
        self.spawn(arguments.first().copied().unwrap_or(name), command)
    }

    /// Host and port of the learner's metrics page.
    ///
    /// # Errors
    /// Those of [`Process::metrics_address`].
    pub fn metrics_address(&self) -> Result<String> {
        self.learner.as_ref().context("no learner")?.metrics_address()
    }

    /// The learner's metrics page.
    ///
    /// # Errors
    /// Those of [`Process::metrics_page`].
    pub fn metrics_page(&self) -> Result<String> {
        self.learner.as_ref().context("no learner")?.metrics_page()
    }

    /// Starts an actor in this network namespace.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub fn start_actor_on(&mut self, host: &str) -> Result<Process> {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", host]).arg(program("comic-actor")?).args(["--learner", &self.url()]);
        self.spawn("actor", command)
    }

    /// Starts a process of many simulated actors. They send unrolls of zeros as fast as the learner accepts them, and read
    /// parameters.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub fn start_crowd(&mut self, actors: usize) -> Result<Process> {
        let mut command = Command::new(program("comic-bench-learner")?);
        command.args(["crowd", "--host", &self.address(), "--actors", &actors.to_string()]);
        command.args(["--window", "1", "--watch"]);
        self.spawn("crowd", command)
    }

    /// Starts an actor with this number of environments that reaches the learner at `url`.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub fn start_actor_of(&mut self, environments: u32, url: &str) -> Result<Process> {
        let mut command = Command::new(program("comic-actor")?);
        command.args(["--learner", url, "--environments", &environments.to_string()]);
        self.spawn("actor", command)
    }

    /// Runs `comic-learner COMMAND` against the learner and waits for its end.
    ///
    /// # Errors
    /// When the program cannot be started.
    pub fn ask(&self, command: &[&str]) -> Result<Output> {
        let mut asking = Command::new(program("comic-learner")?);
        asking.args(command).args(["--learner", &self.url()]).args(flags(&self.access));
        without_settings(&mut asking);
        asking.output().context("cannot start comic-learner")
    }

    pub(crate) fn spawn(&mut self, kind: &str, mut command: Command) -> Result<Process> {
        self.started += 1;
        let log = self.directory.path().join(format!("{}-{kind}.log", self.started));
        let output = OpenOptions::new().create(true).append(true).open(&log).context("cannot write a log")?;
        // The user's directories and settings must not change the result of a test.
        let home = self.directory.path().join("home");
        fs::create_dir_all(&home).context("cannot make a home directory")?;
        command.env("HOME", &home).env("XDG_CACHE_HOME", home.join("cache")).env("NO_COLOR", "1");
        without_settings(&mut command);
        if !command.get_envs().any(|(name, _)| name == "RUST_LOG") {
            command.env_remove("RUST_LOG");
        }
        if let Some((library, clock)) = &self.clock {
            command.env("LD_PRELOAD", library).env("COMIC_CLOCK", clock);
        }
        // A crowd runs until its input ends, when the test drops it.
        let child = command.stdin(Stdio::piped()).stdout(output.try_clone()?).stderr(output).spawn();
        let child = child.with_context(|| format!("cannot start the {kind}"))?;
        if matches!(kind, "actor" | "crowd") {
            self.actors.push(log.clone());
        }
        Ok(Process { child, log })
    }

    /// The learner's status.
    ///
    /// # Errors
    /// When the learner does not answer.
    pub async fn status(&self) -> Result<Status> {
        let (endpoint, bearer) = (self.access.endpoint(&self.url())?, self.access.bearer()?);
        let call = async {
            let mut client = LearnerClient::with_interceptor(endpoint.connect().await?, bearer);
            anyhow::Ok(client.get_status(StatusRequest {}).await?.into_inner())
        };
        tokio::time::timeout(CALL_LIMIT, call).await.context("the learner does not answer")?
    }

    /// Polls the learner's status until `condition` gives a value. Accounting that does not balance is an error at once.
    ///
    /// # Errors
    /// After `limit`, with `what` the test waits for, the last status and the end of the learner's log; or when the learner
    /// has ended.
    pub async fn until<T>(
        &mut self,
        what: &str,
        limit: Duration,
        mut condition: impl FnMut(&Status) -> Option<T>,
    ) -> Result<T> {
        let deadline = Instant::now() + limit;
        let mut last = String::from("none");
        while Instant::now() < deadline {
            match self.status().await {
                Ok(status) => {
                    let accounting = status.accounting.unwrap_or_default();
                    ensure!(balance(&accounting), "{what}: the accounting does not balance: {accounting:?}");
                    if let Some(found) = condition(&status) {
                        return Ok(found);
                    }
                    last = format!("{status:?}");
                }
                Err(error) => last = format!("{error:#}"),
            }
            if let Some(learner) = &mut self.learner
                && let Some(ended) = learner.ended()?
            {
                bail!("{what}: the learner ended with {ended}: {}", learner.log());
            }
            tokio::time::sleep(POLL).await;
        }
        let log = self.learner.as_ref().map(Process::log).unwrap_or_default();
        bail!("{what}: not within {limit:?}; last status: {last}; learner's log: {log}")
    }
}

/// The learner's command. It mounts a disk at `run` that only the learner sees.
fn on_a_disk_of(bytes: u64, run: &Path) -> Result<Command> {
    fs::create_dir_all(run).context("cannot make the run's directory")?;
    let mut command = Command::new("unshare");
    let script = r#"mount -t tmpfs -o "size=$1" tmpfs "$2" && shift 2 && exec "$@""#;
    command.args(["--mount", "sh", "-c", script, "sh", &bytes.to_string()]).arg(run).arg(program("comic-learner")?);
    Ok(command)
}

/// The command-line options for this access.
fn flags(access: &Access) -> Vec<OsString> {
    let Access { ca, cert, key, token_file } = access;
    let flags = [("--ca", ca), ("--cert", cert), ("--key", key), ("--token-file", token_file)];
    let given = flags.into_iter().filter_map(|(flag, path)| Some((flag, path.as_ref()?)));
    given.flat_map(|(flag, path)| [flag.into(), path.into()]).collect()
}

/// A number of the status's metrics, or 0 while there are none.
pub fn metric(status: &Status, name: &str) -> f64 {
    let metrics: Value = serde_json::from_str(&status.metrics_json).unwrap_or_default();
    metrics[name].as_f64().unwrap_or_default()
}

/// A free port below the ephemeral range, so that no client gets it while the learner is down. The UDP socket reserves it
/// among the tests of this process. UDP ports are separate from TCP ports, so the learner can still listen.
pub(crate) fn free_port() -> Result<(u16, UdpSocket)> {
    let offset = u16::try_from(std::process::id() % 10_000)?;
    let mut candidates = (0..10_000).map(|step| 20_000 + (offset + step) % 10_000);
    let free = candidates.find_map(|port| {
        let kept = UdpSocket::bind(("127.0.0.1", port)).ok()?;
        TcpListener::bind(("127.0.0.1", port)).ok()?;
        Some((port, kept))
    });
    free.context("no port from 20000 to 29999 is free")
}
