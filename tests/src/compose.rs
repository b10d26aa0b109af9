//! A learner, actors and an evaluator in containers, as `deploy/compose.yaml` starts them.

use std::env;
use std::fmt::Write as _;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

use crate::accounting::balance_of_json;
use crate::repository::root;
use crate::system::SMALL;

/// Time between two checks of a condition. Each check starts a process in a container.
const POLL: Duration = Duration::from_millis(500);

/// A Compose project of its own. Dropping it removes its containers, networks and volumes, and keeps the images.
pub struct Project {
    name: String,
    files: &'static [&'static str],
    /// Options of the learner in addition to those of the file.
    options: String,
    /// For how many seconds actors and the evaluator wait for a learner that does not answer.
    pub patience: u32,
}

impl Project {
    /// Makes a project of these files in `deploy`. It starts nothing.
    pub fn new(purpose: &str, files: &'static [&'static str]) -> Self {
        // The files name the preset themselves.
        Self {
            name: format!("comic-{purpose}-{}", std::process::id()),
            files,
            options: SMALL[2..].join(" "),
            patience: 600,
        }
    }

    /// Adds an option for the next start of the learner.
    pub fn tell(&mut self, option: &str) {
        // Writing to a string cannot fail.
        let _ = write!(self.options, " {option}");
    }

    /// Runs a command of Compose to its end and returns its output.
    ///
    /// # Errors
    /// When the command fails, with its output.
    pub fn compose(&self, arguments: &[&str]) -> Result<String> {
        let mut command = compose();
        for file in self.files {
            command.arg("--file").arg(root().join("deploy").join(file));
        }
        command.args(["--project-name", &self.name]).args(arguments);
        // The user's own settings do not count, and the limits fit the smallest machine.
        for (name, _) in env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("COMIC_")) {
            command.env_remove(name);
        }
        command.env("COMIC_OPTIONS", &self.options).env("COMIC_METRICS_PORT", "").env("COMIC_TENSORBOARD_PORT", "");
        command.env("COMIC_LEARNER_CPUS", "1").env("COMIC_ACTOR_CPUS", "0.5");
        command.env("COMIC_GIVE_UP_AFTER", self.patience.to_string());
        run(&mut command)
    }

    /// Starts every service that does not run yet, with this number of actors.
    ///
    /// # Errors
    /// When a service cannot be started.
    pub fn up(&self, actors: usize) -> Result<()> {
        let scale = format!("actor={actors}");
        self.compose(&["up", "--detach", "--no-build", "--no-recreate", "--scale", &scale]).map(drop)
    }

    /// Runs a program in the learner's container.
    ///
    /// # Errors
    /// When the command fails, with its output.
    pub fn in_learner(&self, command: &[&str]) -> Result<String> {
        self.compose(&[&["exec", "-T", "learner"], command].concat())
    }

    /// The containers of a service, running or not.
    ///
    /// # Errors
    /// When the engine gives no answer.
    pub fn containers(&self, service: &str) -> Result<Vec<Container>> {
        let filters = [("project", self.name.as_str()), ("service", service)];
        let [project, service] = filters.map(|(label, value)| format!("label=com.docker.compose.{label}={value}"));
        let found = docker(&["ps", "--all", "--quiet", "--no-trunc", "--filter", &project, "--filter", &service])?;
        Ok(found.lines().map(|id| Container(id.to_owned())).collect())
    }

    /// The one container of a service.
    ///
    /// # Errors
    /// When the service has no container, or several.
    pub fn container(&self, service: &str) -> Result<Container> {
        let found = self.containers(service)?;
        ensure!(found.len() == 1, "not one {service}: {found:?}");
        found.into_iter().next().context("no container")
    }

    /// The network of all containers.
    pub fn network(&self) -> String {
        format!("{}_default", self.name)
    }

    /// The output of `comic-learner status --json` in the learner's container.
    ///
    /// # Errors
    /// When the learner does not answer.
    pub fn status(&self) -> Result<Value> {
        Ok(serde_json::from_str(&self.in_learner(&["comic-learner", "status", "--json"])?)?)
    }

    /// Polls the learner's status until `condition` holds. Accounting that does not balance is an error at once.
    ///
    /// # Errors
    /// After `limit`, with `what` the test waits for, the last status, and all logs.
    pub async fn until(&self, what: &str, limit: Duration, condition: impl Fn(&Value) -> bool) -> Result<Value> {
        let begin = Instant::now();
        let mut last = String::from("none");
        while begin.elapsed() < limit {
            match self.status() {
                Ok(status) => {
                    ensure!(
                        balance_of_json(&status["accounting"]),
                        "{what}: the accounting does not balance: {}",
                        status["accounting"]
                    );
                    if condition(&status) {
                        println!(
                            "{what}: after {:.1} s, accounting {}",
                            begin.elapsed().as_secs_f64(),
                            status["accounting"]
                        );
                        return Ok(status);
                    }
                    last = status.to_string();
                }
                Err(error) => last = format!("{error:#}"),
            }
            tokio::time::sleep(POLL).await;
        }
        bail!(
            "{what}: not within {limit:?}; last status: {last}; {}",
            self.compose(&["logs", "--no-color", "--tail=100"])?
        )
    }
}

impl Drop for Project {
    fn drop(&mut self) {
        if let Err(error) =
            self.compose(&["--profile", "tensorboard", "down", "--volumes", "--remove-orphans", "--timeout", "1"])
        {
            eprintln!("not everything is gone: {error:#}");
        }
    }
}

/// A container.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Container(String);

impl Container {
    /// Runs a docker command with this container as its last argument.
    ///
    /// # Errors
    /// When the command fails, with its output.
    pub fn docker(&self, arguments: &[&str]) -> Result<String> {
        docker(&[arguments, &[&self.0]].concat())
    }

    /// Runs a program in the container.
    ///
    /// # Errors
    /// When the command fails, with its output.
    pub fn exec(&self, command: &[&str]) -> Result<String> {
        docker(&[&["exec", &self.0], command].concat())
    }

    /// The field `state` of the engine's description of the container, for instance `.State.ExitCode`.
    ///
    /// # Errors
    /// When there is no such field.
    pub fn inspect(&self, state: &str) -> Result<String> {
        let format = format!("{{{{json {state}}}}}");
        Ok(self.docker(&["inspect", "--format", &format])?.trim().trim_matches('"').to_owned())
    }

    /// The container's log.
    ///
    /// # Errors
    /// When the engine gives no answer.
    pub fn log(&self) -> Result<String> {
        self.docker(&["logs"])
    }

    /// Waits until the field `state` has the value `wanted`.
    ///
    /// # Errors
    /// After `limit`, with the value and the log.
    pub async fn until_is(&self, state: &str, wanted: &str, limit: Duration) -> Result<()> {
        let begin = Instant::now();
        loop {
            let is = self.inspect(state)?;
            if is == wanted {
                return Ok(());
            }
            ensure!(begin.elapsed() < limit, "{state} is {is}, not {wanted}, after {limit:?}: {}", self.log()?);
            tokio::time::sleep(POLL).await;
        }
    }

    /// Waits until the log contains `text`.
    ///
    /// # Errors
    /// After `limit`, with the log.
    pub async fn until_log_holds(&self, text: &str, limit: Duration) -> Result<()> {
        let begin = Instant::now();
        while !self.log()?.contains(text) {
            ensure!(begin.elapsed() < limit, "`{text}` is not in the log after {limit:?}: {}", self.log()?);
            tokio::time::sleep(POLL).await;
        }
        Ok(())
    }
}

/// Compose, v2 or v1.
fn compose() -> Command {
    let mut second = Command::new("docker");
    second.arg("compose");
    let there = Command::new("docker").args(["compose", "version"]).output();
    if there.is_ok_and(|answer| answer.status.success()) { second } else { Command::new("docker-compose") }
}

/// Runs a docker command to its end and returns its output.
///
/// # Errors
/// When the command fails, with its output.
pub fn docker(arguments: &[&str]) -> Result<String> {
    run(Command::new("docker").args(arguments))
}

/// Standard output and standard error together: the programs in the containers write their logs to the latter.
fn run(command: &mut Command) -> Result<String> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    let said = |stream: &[u8]| String::from_utf8_lossy(stream).into_owned();
    ensure!(
        output.status.success(),
        "{command:?}: {}: {}{}",
        output.status,
        said(&output.stdout),
        said(&output.stderr)
    );
    let logs = command.get_args().any(|argument| argument == "logs");
    let stderr = if logs { said(&output.stderr) } else { String::new() };
    Ok(said(&output.stdout) + &stderr)
}
