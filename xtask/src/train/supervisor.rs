//! The processes of a run: started, watched, restarted, stopped.

use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use comic_experiment::Experiment;
use comic_setup::Interrupt;

use super::Job;
use super::display::Display;
use super::process::{Process, Tail};
use crate::workspace;

/// How long the learner may take to serve: it opens the clips and builds networks first.
const START_LIMIT: Duration = Duration::from_secs(120);
/// How long the learner may take to write its last checkpoint and leave.
const LEARNER_LEAVES: Duration = Duration::from_secs(60);
/// How long actors may take to flush and leave.
const ACTOR_LEAVES: Duration = Duration::from_secs(10);
/// An actor that lived so long was sound: its next death counts as the first.
const SOUND: Duration = Duration::from_secs(30);
/// Deaths in a row after which an actor is not started again.
const DEATHS: u32 = 5;

/// One learner and its actors.
pub(super) struct Supervisor<'a> {
    job: &'a Job,
    port: u16,
    learner: Process,
    actors: Vec<Actor>,
    metrics: Tail,
    log: Tail,
}

/// One actor's place; the process in it may change.
struct Actor {
    number: usize,
    process: Option<Process>,
    deaths: u32,
    /// When to start the next process, after a death.
    again: Option<Instant>,
}

impl<'a> Supervisor<'a> {
    /// Starts the learner, waits until it serves, and starts the actors.
    pub(super) fn start(job: &'a Job, port: u16, display: &mut Display, interrupt: &Interrupt) -> Result<Self> {
        let metrics = Tail::new(job.directory.metrics());
        let log = Tail::new(job.directory.log("learner"));
        let mut command = Command::new(workspace::program("comic-learner")?);
        command.args(&job.document).args(["--address", "127.0.0.1", "--port", &port.to_string()]);
        command.arg("--run").arg(job.directory.path());
        let mut learner = Process::start("comic-learner", &mut command, job.directory.log("learner"))?;
        await_serving(&mut learner, interrupt)?;
        display.event("learner serves", &[("address", format!("127.0.0.1:{port}"))]);
        let mut supervisor = Self { job, port, learner, actors: Vec::new(), metrics, log };
        for number in 0..usize::from(job.actors) {
            let process = Some(supervisor.start_actor(number)?);
            supervisor.actors.push(Actor { number, process, deaths: 0, again: None });
        }
        display.event("actors started", &[("count", job.actors.to_string())]);
        Ok(supervisor)
    }

    fn start_actor(&self, number: usize) -> Result<Process> {
        let mut command = Command::new(workspace::program("comic-actor")?);
        command.args(["--learner", &format!("http://127.0.0.1:{}", self.port)]);
        let Experiment { unroll, actor, .. } = &self.job.experiment;
        if unroll.lockstep {
            // A batch waits for every environment, so the actors have all of them between them.
            let environments = unroll.batch.div_ceil(usize::from(self.job.actors) * actor.threads);
            command.args(["--environments", &environments.to_string()]);
        }
        let name = format!("actor-{number}");
        let log = self.job.directory.log(&name);
        Process::start(name, &mut command, log)
    }

    /// Shows the run until the learner has finished or a stop is asked for.
    pub(super) fn watch(&mut self, display: &mut Display, interrupt: &Interrupt) -> Result<()> {
        loop {
            self.show(display);
            if interrupt.requested() {
                display.event("stopping", &[("reason", "asked to".into())]);
                return Ok(());
            }
            if let Some(status) = self.learner.ended()? {
                if status.success() {
                    display.event("budget spent", &[]);
                    return Ok(());
                }
                bail!("comic-learner ended with {status}; {}", self.learner.last_words());
            }
            self.tend_actors(display)?;
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    fn tend_actors(&mut self, display: &mut Display) -> Result<()> {
        for index in 0..self.actors.len() {
            let actor = &mut self.actors[index];
            if let Some(process) = &mut actor.process
                && let Some(status) = process.ended()?
            {
                let (name, words, age) = (process.name.clone(), process.last_words(), process.age());
                actor.process = None;
                if status.success() {
                    display.event("actor left", &[("name", name)]);
                    continue;
                }
                actor.deaths = if age > SOUND { 1 } else { actor.deaths + 1 };
                if actor.deaths >= DEATHS {
                    bail!("{name} died {DEATHS} times in a row, last with {status}; {words}");
                }
                display.event("actor died", &[("name", name), ("status", status.to_string()), ("log", words)]);
                actor.again = Some(Instant::now() + Duration::from_secs(1 << (actor.deaths - 1)));
            }
            if actor.again.is_some_and(|again| Instant::now() >= again) {
                let number = actor.number;
                let process = self.start_actor(number)?;
                display.event("actor restarted", &[("name", process.name.clone())]);
                self.actors[index].process = Some(process);
                self.actors[index].again = None;
            }
        }
        Ok(())
    }

    /// Ends what still runs: the learner writes its checkpoint, actors flush what they have.
    pub(super) fn stop(&mut self, display: &mut Display) {
        if matches!(self.learner.ended(), Ok(None)) {
            self.learner.terminate();
            if !self.learner.wait(LEARNER_LEAVES) {
                display.event("learner killed", &[("reason", "it did not leave in time".into())]);
            }
        }
        // The learner has told its actors that the run is over; those that do not know it are asked.
        let actors: Vec<_> = self.actors.iter_mut().filter_map(|actor| actor.process.as_mut()).collect();
        for process in &actors {
            process.terminate();
        }
        for process in actors {
            if !process.wait(ACTOR_LEAVES) {
                display.event("actor killed", &[("name", process.name.clone())]);
            }
        }
        self.show(display);
    }

    /// New metrics, and what the learner says beside them: the phases before the first update take a while.
    fn show(&mut self, display: &mut Display) {
        for line in self.log.lines() {
            if !line.contains(" metrics: ") && !says_it_serves(&line) {
                display.learner(&line);
            }
        }
        for line in self.metrics.lines() {
            display.metrics(&line);
        }
    }
}

/// Waits for the line `{"listening": …}` by which the learner says that it serves.
fn await_serving(learner: &mut Process, interrupt: &Interrupt) -> Result<()> {
    while learner.age() < START_LIMIT {
        if learner.output().lines().any(says_it_serves) {
            return Ok(());
        }
        if let Some(status) = learner.ended()? {
            bail!("comic-learner ended with {status} before it served; {}", learner.last_words());
        }
        if interrupt.requested() {
            bail!("interrupted before the learner served");
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    bail!("comic-learner does not serve after {} s; {}", START_LIMIT.as_secs(), learner.last_words())
}

fn says_it_serves(line: &str) -> bool {
    serde_json::from_str::<serde_json::Value>(line).is_ok_and(|said| said.get("listening").is_some())
}
