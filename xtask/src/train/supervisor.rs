//! Starts, watches, restarts and stops the processes of a run.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use comic_experiment::Experiment;
use comic_setup::Interrupt;
use serde::Deserialize;

use super::display::Display;
use super::preemption::{LearnerKilled, Preemption};
use super::process::{Process, Tail};
use super::{Job, child};
use crate::metrics::Line;
use crate::{evaluations, workspace};

/// The exit code of a learner that was told to stop, and wrote its checkpoint.
const STOPPED: i32 = 4;
/// The time in which the learner must begin to serve. It opens the clips and builds the networks first.
const START_LIMIT: Duration = Duration::from_secs(120);
/// The time in which the learner must write its last checkpoint and end.
const LEARNER_END_LIMIT: Duration = Duration::from_secs(60);
/// The time in which an actor must send its last unrolls and end. The evaluator has as long.
const ACTOR_END_LIMIT: Duration = Duration::from_secs(10);
/// After this running time an actor's failure counts as the first.
const STABLE: Duration = Duration::from_secs(30);
/// Failures in a row after which an actor is not started again.
const MAX_FAILURES: u32 = 5;
/// The time after which a process that was killed on purpose is replaced. A Job takes some seconds, too.
const REPLACED_AFTER: Duration = Duration::from_secs(5);
/// The log level of an actor that logs each unroll.
const EVERY_UNROLL: &str = "info,comic_actor::session::outbox=debug";

/// One learner and its actors.
pub(super) struct Supervisor<'a> {
    job: &'a Job,
    port: u16,
    learner: Process,
    /// When to start the learner again, after it was killed on purpose.
    learner_restart_at: Option<Instant>,
    actors: Vec<Actor>,
    /// When the actors were started.
    started: Instant,
    preemption: &'a mut Preemption,
    /// Evaluates checkpoints. It is not started again: training does not need it.
    evaluator: Option<Process>,
    metrics: Tail,
    /// The newest line of metrics.
    newest: Line,
    evaluations: Tail,
    log: Tail,
}

/// One actor. Its process may be started several times.
struct Actor {
    number: usize,
    process: Option<Process>,
    failures: u32,
    /// When to start the next process, after a failure or a kill.
    restart_at: Option<Instant>,
}

impl<'a> Supervisor<'a> {
    /// Starts the learner, waits until it serves, and starts the actors and the evaluator.
    pub(super) fn start(
        job: &'a Job,
        port: u16,
        preemption: &'a mut Preemption,
        display: &mut Display,
        interrupt: &Interrupt,
    ) -> Result<Self> {
        let metrics = Tail::new(job.directory.metrics());
        let evaluations = Tail::new(job.directory.evaluations());
        let log = Tail::new(job.directory.log("learner"));
        let learner = start_learner(job, port, interrupt)?;
        let page = job.directory.page().display().to_string();
        display.event("learner serves", &[("address", format!("127.0.0.1:{port}")), ("page", page)]);
        let mut supervisor = Self {
            job,
            port,
            learner,
            learner_restart_at: None,
            actors: Vec::new(),
            started: Instant::now(),
            preemption,
            evaluator: None,
            metrics,
            newest: Line::default(),
            evaluations,
            log,
        };
        for number in 0..usize::from(job.actors) {
            let process = Some(supervisor.start_actor(number)?);
            supervisor.actors.push(Actor { number, process, failures: 0, restart_at: None });
        }
        display.event("actors started", &[("count", job.actors.to_string())]);
        if job.evaluator {
            // Training does not need it.
            match supervisor.start_evaluator() {
                Ok(process) => {
                    supervisor.evaluator = Some(process);
                    display.event("evaluator started", &[]);
                }
                Err(error) => display.event("evaluator failed", &[("reason", format!("{error:#}"))]),
            }
        }
        Ok(supervisor)
    }

    /// The learner's address.
    fn address(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    fn start_evaluator(&self) -> Result<Process> {
        let mut command = child::command(&workspace::program("comic-actor")?);
        command.args(["evaluate", "--learner", &self.address(), "--watch"]);
        Process::start("evaluator", &mut command, self.job.directory.log("evaluator"))
    }

    fn start_actor(&self, number: usize) -> Result<Process> {
        let mut command = child::command(&workspace::program("comic-actor")?);
        command.args(["--learner", &self.address()]);
        if self.job.logs_unrolls {
            command.env("RUST_LOG", EVERY_UNROLL);
        }
        let Experiment { unroll, actor, .. } = &self.job.experiment;
        if unroll.lockstep {
            // A batch waits for every environment, so the actors together must have all of them.
            let environments = unroll.batch.div_ceil(usize::from(self.job.actors) * actor.threads);
            command.args(["--environments", &environments.to_string()]);
        }
        let name = actor_name(number);
        let log = self.job.directory.log(&name);
        Process::start(name, &mut command, log)
    }

    /// Shows the run until the learner has ended or a stop is requested.
    pub(super) fn watch(&mut self, display: &mut Display, interrupt: &Interrupt) -> Result<()> {
        loop {
            self.show(display);
            if interrupt.requested() {
                display.event("stopping", &[("reason", "requested".into())]);
                return Ok(());
            }
            if let Some(moment) = self.learner_restart_at {
                if Instant::now() >= moment {
                    self.restart_learner(display, interrupt)?;
                }
            } else if let Some(status) = self.learner.ended()? {
                if status.success() {
                    display.event("budget used up", &[]);
                    return Ok(());
                }
                if status.code() == Some(STOPPED) {
                    display.event("stopping", &[("reason", "the learner was told to stop".into())]);
                    return Ok(());
                }
                bail!("comic-learner ended with {status}; {}", self.learner.last_lines());
            }
            self.restart_failed_actors(display)?;
            self.report_failed_evaluator(display)?;
            self.preempt(display)?;
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    fn restart_failed_actors(&mut self, display: &mut Display) -> Result<()> {
        for index in 0..self.actors.len() {
            let actor = &mut self.actors[index];
            if let Some(process) = &mut actor.process
                && let Some(status) = process.ended()?
            {
                let (name, output, age) = (process.name.clone(), process.last_lines(), process.age());
                actor.process = None;
                if status.success() {
                    display.event("actor ended", &[("name", name)]);
                    continue;
                }
                actor.failures = if age > STABLE { 1 } else { actor.failures + 1 };
                if actor.failures >= MAX_FAILURES {
                    bail!("{name} failed {MAX_FAILURES} times in a row, the last time with {status}; {output}");
                }
                display.event("actor failed", &[("name", name), ("status", status.to_string()), ("log", output)]);
                actor.restart_at = Some(Instant::now() + Duration::from_secs(1 << (actor.failures - 1)));
            }
            if actor.restart_at.is_some_and(|moment| Instant::now() >= moment) {
                let number = actor.number;
                let process = self.start_actor(number)?;
                display.event("actor restarted", &[("name", process.name.clone())]);
                self.actors[index].process = Some(process);
                self.actors[index].restart_at = None;
            }
        }
        Ok(())
    }

    /// Kills what is due.
    fn preempt(&mut self, display: &mut Display) -> Result<()> {
        for number in self.preemption.actors_due(self.started.elapsed(), self.actors.len()) {
            let actor = &mut self.actors[number];
            // One that was killed a moment ago has no machine yet that could be taken away.
            let Some(mut process) = actor.process.take() else { continue };
            process.kill();
            actor.restart_at = Some(Instant::now() + REPLACED_AFTER);
            self.preemption.actors_killed += 1;
            display.event("actor killed", &[("name", process.name.clone())]);
        }
        if self.preemption.learner_due(self.newest.used(&self.job.experiment.budget), Instant::now())
            && self.learner.ended()?.is_none()
        {
            self.learner.kill();
            self.learner_restart_at = Some(Instant::now() + REPLACED_AFTER);
            display.event("learner killed", &[]);
        }
        Ok(())
    }

    /// Starts the learner again after its kill, with the same run.
    fn restart_learner(&mut self, display: &mut Display, interrupt: &Interrupt) -> Result<()> {
        let resumed = self.job.directory.newest_checkpoint().map_or(Ok(0), |path| environment_steps(&path))?;
        self.preemption.learner_killed = Some(LearnerKilled { reached: self.newest.environment_steps, resumed });
        self.learner = start_learner(self.job, self.port, interrupt)?;
        self.learner_restart_at = None;
        display.event("learner restarted", &[("environment steps", resumed.to_string())]);
        Ok(())
    }

    /// Says why the evaluator has ended, if it has failed. Training continues without it.
    fn report_failed_evaluator(&mut self, display: &mut Display) -> Result<()> {
        if let Some(process) = &mut self.evaluator
            && let Some(status) = process.ended()?
        {
            if !status.success() {
                let facts = [("status", status.to_string()), ("log", process.last_lines())];
                display.event("evaluator failed", &facts);
            }
            self.evaluator = None;
        }
        Ok(())
    }

    /// Ends the processes that still run. The learner writes its checkpoint, the actors send their last unrolls.
    pub(super) fn stop(&mut self, display: &mut Display) {
        if matches!(self.learner.ended(), Ok(None)) {
            self.learner.terminate();
            if !self.learner.wait(LEARNER_END_LIMIT) {
                display.event("learner killed", &[("reason", "it did not end in time".into())]);
            }
        }
        // The learner has told its actors that the run is over. The signal is for actors that were not connected, and for an
        // evaluator that is at work.
        let actors = self.actors.iter_mut().filter_map(|actor| actor.process.as_mut());
        let others: Vec<_> = actors.chain(&mut self.evaluator).collect();
        for process in &others {
            process.terminate();
        }
        for process in others {
            if !process.wait(ACTOR_END_LIMIT) {
                display.event("killed", &[("name", process.name.clone()), ("reason", "it did not end in time".into())]);
            }
        }
        self.show(display);
    }

    /// Shows new metrics, new evaluations, and new lines of the learner's log, which report the phases before the first
    /// update.
    fn show(&mut self, display: &mut Display) {
        for line in self.log.lines() {
            if !line.contains(" metrics: ") && !is_listening_line(&line) {
                display.learner(&line);
            }
        }
        for text in self.metrics.lines() {
            display.metrics(&text);
            if let Ok(line) = serde_json::from_str(&text) {
                self.newest = line;
            }
        }
        for line in self.evaluations.lines() {
            // The whole file is read for the best, which may be older than a resumed run's new lines.
            display.evaluation(&line, evaluations::best(&self.job.directory.evaluations()));
        }
    }
}

/// The name of an actor's log and of its processes.
pub(super) fn actor_name(number: usize) -> String {
    format!("actor-{number}")
}

/// Starts the learner and waits until it serves.
fn start_learner(job: &Job, port: u16, interrupt: &Interrupt) -> Result<Process> {
    let mut command = child::command(&workspace::program("comic-learner")?);
    command.args(&job.document).args(["--address", "127.0.0.1", "--port", &port.to_string()]);
    command.arg("--run").arg(job.directory.path());
    if job.logs_unrolls {
        // Whatever the user's level is: the last line has the accounting.
        command.env("RUST_LOG", "info");
    }
    let mut learner = Process::start("comic-learner", &mut command, job.directory.log("learner"))?;
    await_serving(&mut learner, interrupt)?;
    Ok(learner)
}

/// Waits for the line `{"listening": …}`, which the learner prints when it serves.
fn await_serving(learner: &mut Process, interrupt: &Interrupt) -> Result<()> {
    while learner.age() < START_LIMIT {
        if learner.output().lines().any(is_listening_line) {
            return Ok(());
        }
        if let Some(status) = learner.ended()? {
            bail!("comic-learner ended with {status} before it served; {}", learner.last_lines());
        }
        if interrupt.requested() {
            bail!("interrupted before the learner served");
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    bail!("comic-learner did not serve within {} s; {}", START_LIMIT.as_secs(), learner.last_lines())
}

fn is_listening_line(line: &str) -> bool {
    serde_json::from_str::<serde_json::Value>(line).is_ok_and(|line| line.get("listening").is_some())
}

/// The environment steps that were trained on before this checkpoint.
fn environment_steps(checkpoint: &Path) -> Result<u64> {
    #[derive(Deserialize)]
    struct Progress {
        environment_steps: u64,
    }
    let path = checkpoint.join("progress.json");
    let text = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let progress: Progress = serde_json::from_slice(&text).with_context(|| path.display().to_string())?;
    Ok(progress.environment_steps)
}
