//! `comic-actor evaluate --watch`: evaluates the newest checkpoint of a run again and again while it trains.

use std::collections::HashMap;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use comic_clips::Catalogue;
use comic_experiment::Experiment;
use comic_proto::v1::{Checkpoint, EvaluationReport};
use comic_proto::{Access, UnrollShape, chain};
use comic_tasks::{Simulated, Step, Task};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use tokio::time::Instant;

use super::delivery::deliver;
use super::settings::{RolloutSettings, Starts};
use super::{Audience, Report, evaluate};
use crate::Error;
use crate::acting_loop::Controller;
use crate::film::recorder::{Look, Recorder};
use crate::policy::TorchPolicy;
use crate::session::{Failure, Fetched, Follower};

/// Episodes of an evaluation, at most. They always start at the same frames.
const EPISODES: usize = 64;
/// From an attempt to fetch a checkpoint to the next one.
const RETRY: Duration = Duration::from_secs(1);
/// Seconds of an evaluation's film, and the most bytes of it: the learner takes messages of 1 MiB.
const FILM_SECONDS: f64 = 5.0;
const FILM_BYTES: usize = 700_000;

/// What is evaluated, and when.
#[derive(Clone, Debug)]
pub(super) struct WatchSettings {
    pub(super) learner: String,
    pub(super) access: Access,
    pub(super) cache: Option<PathBuf>,
    /// How long to go on while the learner does not answer; for ever when absent.
    pub(super) give_up_after: Option<Duration>,
    /// From the begin of an evaluation to the begin of the next one, at least.
    pub(super) interval: Duration,
    /// Clips in place of the experiment's own.
    pub(super) clips: Vec<String>,
    /// Whether clips that were made from others are left out.
    pub(super) originals: bool,
    pub(super) seed: u64,
    /// Added to the process's nice value, so that an evaluation takes little time from actors and learner.
    pub(super) nice: i32,
}

/// Evaluates until the run is over.
///
/// # Errors
/// [`Error::Stopped`] when the process was told to stop before that (SIGTERM, SIGINT, SIGHUP); a learner that does not
/// accept this process, or does not answer for too long; an experiment that cannot be used.
pub(super) fn run(settings: &WatchSettings) -> Result<(), Error> {
    // Without a lower priority evaluations are still correct.
    let _ = rustix::process::nice(settings.nice);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
    let runtime = runtime.map_err(Error::Thread)?;
    let WatchSettings { learner, access, cache, give_up_after, .. } = settings.clone();
    let follower = Follower::new(learner, access, cache, give_up_after)?;
    let (sender, mut newest) = watch::channel(None);
    let following = runtime.spawn(follow(follower.clone(), sender));
    let mut evaluator = Evaluator { settings, scene: None, films: true };
    let mut last = None;
    let mut due = Instant::now();
    // Sleeping begins within the runtime.
    let until = async |due| tokio::time::sleep_until(due).await;
    while let Some(checkpoint) = runtime.block_on(next(&mut newest, last, until(due))) {
        let begun = Instant::now();
        let wanted = |experiment: &Experiment| evaluator.wants_clips_of(experiment);
        let fetched = unless_ended(&mut newest, follower.fetch(&checkpoint, wanted));
        match runtime.block_on(fetched) {
            Some(Ok(fetched)) => {
                (last, due) = (Some(position(&checkpoint)), begun + settings.interval);
                evaluator.evaluate(&checkpoint, fetched, &newest)?;
            }
            // A newer checkpoint may have replaced it.
            Some(Err(Failure::Lost(reason) | Failure::Postponed(reason))) => {
                tracing::info!(updates = checkpoint.updates, "not evaluated: {reason}");
                due = begun + RETRY;
            }
            Some(Err(Failure::Unwelcome(error) | Failure::Fatal(error))) => return Err(error),
            None => break,
        }
    }
    let ended = runtime.block_on(following).map_err(|_| Error::WorkerPanicked)?;
    // A slow name resolution blocks a thread of the runtime. It must not block the exit.
    runtime.shutdown_background();
    ended
}

/// Shows the newest checkpoint until the run is over or the process is told to stop. The sender is then dropped.
async fn follow(follower: Follower, newest: watch::Sender<Option<Checkpoint>>) -> Result<(), Error> {
    let mut terminate = signal(SignalKind::terminate()).map_err(Error::Thread)?;
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Error::Thread)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(Error::Thread)?;
    tokio::select! {
        ended = follower.follow(&newest) => ended,
        _ = terminate.recv() => Err(Error::Stopped),
        _ = interrupt.recv() => Err(Error::Stopped),
        _ = hangup.recv() => Err(Error::Stopped),
    }
}

/// What tells checkpoints apart: run, learner epoch and updates.
type Position = (u64, u64, u64);

fn position(checkpoint: &Checkpoint) -> Position {
    (checkpoint.run, checkpoint.learner_epoch, checkpoint.updates)
}

/// The newest checkpoint once it is another one than `last` and `due` is over; `None` when there will be none.
async fn next(
    newest: &mut watch::Receiver<Option<Checkpoint>>,
    last: Option<Position>,
    due: impl Future<Output = ()>,
) -> Option<Checkpoint> {
    unless_ended(newest, due).await?;
    let is_new = |checkpoint: &Option<Checkpoint>| checkpoint.as_ref().is_some_and(|new| Some(position(new)) != last);
    let found = newest.wait_for(is_new).await.ok()?.clone();
    if has_ended(newest) { None } else { found }
}

/// The result of `work`; `None` if the run is over, or the process told to stop, before that.
async fn unless_ended<T>(newest: &mut watch::Receiver<Option<Checkpoint>>, work: impl Future<Output = T>) -> Option<T> {
    tokio::select! {
        biased;
        () = async { while newest.changed().await.is_ok() {} } => None,
        done = work => Some(done),
    }
}

/// Whether the run is over or the process was told to stop.
fn has_ended(newest: &watch::Receiver<Option<Checkpoint>>) -> bool {
    newest.has_changed().is_err()
}

/// Evaluates one checkpoint after the other.
struct Evaluator<'a> {
    settings: &'a WatchSettings,
    /// The newest experiment.
    scene: Option<Scene>,
    /// Whether films can be made.
    films: bool,
}

/// What checkpoints of one experiment share.
struct Scene {
    experiment: Experiment,
    task: Arc<dyn Task>,
}

impl Scene {
    fn new(experiment: Experiment, settings: &WatchSettings, assets: &HashMap<String, PathBuf>) -> Result<Self, Error> {
        let WatchSettings { clips, originals, .. } = settings;
        let shown = experiment.clone().with_clips(clips);
        // Clips of the command line are files of this machine. The learner may not name any.
        let own = !clips.is_empty();
        let locate = |source: &str| assets.get(source).cloned().or_else(|| own.then(|| PathBuf::from(source)));
        let catalogue = Catalogue::open_with(&shown.clips, locate)?.for_evaluation(&shown, *originals)?;
        let task = comic_tasks::build(&shown, &catalogue)?;
        Ok(Self { experiment, task })
    }
}

impl Evaluator<'_> {
    /// Whether the files of an experiment's clips are needed: they are not if the last checkpoint had the same ones.
    fn wants_clips_of(&self, experiment: &Experiment) -> bool {
        let known = self.scene.as_ref().is_some_and(|scene| scene.experiment == *experiment);
        self.settings.clips.is_empty() && !known
    }

    /// Evaluates, films, and reports. What the learner does not take is lost with a warning.
    fn evaluate(
        &mut self,
        checkpoint: &Checkpoint,
        fetched: Fetched,
        newest: &watch::Receiver<Option<Checkpoint>>,
    ) -> Result<(), Error> {
        let begun = Instant::now();
        let Fetched { experiment, policy, low_level, assets } = fetched;
        let scene = match self.scene.take().filter(|scene| scene.experiment == experiment) {
            Some(scene) => scene,
            None => Scene::new(experiment, self.settings, &assets)?,
        };
        let Scene { experiment, task } = self.scene.insert(scene);
        let options = RolloutSettings {
            starts: Starts::Spread(EPISODES),
            deterministic: true,
            seed: self.settings.seed,
            ..RolloutSettings::default()
        };
        let mut policy = TorchPolicy::from_parameters(task.spec(), experiment, low_level.as_deref(), &policy)?;
        let shape = UnrollShape::new(task.spec(), experiment);
        let camera = if self.films { Camera::new(task.control_timestep(), experiment) } else { Ok(None) };
        let mut audience = Crew { camera, newest };
        let finished = evaluate(&mut Controller::Policy(&mut policy), task, &shape, &options, &mut audience)?;
        if has_ended(newest) {
            return Ok(());
        }
        let report = Report::new(task.spec(), &finished, &options);
        let film = audience.camera.and_then(|camera| camera.map_or(Ok(Vec::new()), Camera::finish));
        let film = film.unwrap_or_else(|error| {
            self.films = !matches!(error, Error::Task(comic_tasks::Error::Graphics { .. }));
            tracing::warn!(next_films = self.films, "this evaluation has no film: {}", chain(&error));
            Vec::new()
        });
        let &Checkpoint { run, learner_epoch, version, updates, environment_steps, seconds, .. } = checkpoint;
        tracing::info!(
            updates,
            environment_steps,
            normalised_reward = report.overall.normalised_reward,
            success_rate = report.overall.success_rate,
            episodes = finished.len(),
            film_bytes = film.len(),
            seconds = begun.elapsed().as_secs_f32(),
            "evaluated"
        );
        let json = serde_json::to_string(&report)
            .map_err(|error| Error::Usage(format!("cannot write the report as JSON: {error}")))?;
        let run = Some(run).filter(|run| *run != 0);
        let film = film.into();
        let report = EvaluationReport { run, learner_epoch, version, updates, environment_steps, seconds, json, film };
        if let Err(error) = deliver(&self.settings.learner, &self.settings.access, report) {
            tracing::warn!(updates, "the learner does not have this evaluation: {}", chain(&error));
        }
        Ok(())
    }
}

/// Films the first episode, and stops the evaluation when there is no one left to report to.
struct Crew<'a> {
    camera: Result<Option<Camera>, Error>,
    newest: &'a watch::Receiver<Option<Checkpoint>>,
}

impl Audience<Box<dyn Simulated>> for Crew<'_> {
    fn watch(
        &mut self,
        number: usize,
        environment: &mut Box<dyn Simulated>,
        _: Option<&Step>,
    ) -> Result<ControlFlow<()>, Error> {
        if let (0, Ok(Some(camera))) = (number, &mut self.camera)
            && let Err(error) = camera.shoot(environment.as_mut())
        {
            self.camera = Err(error);
        }
        Ok(if has_ended(self.newest) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }

    fn count(&mut self, _: usize, _: usize) {}
}

/// The short film of an evaluation.
struct Camera {
    recorder: Recorder,
    file: PathBuf,
    /// Holds the file.
    _directory: tempfile::TempDir,
}

impl Camera {
    fn new(control_timestep: f64, experiment: &Experiment) -> Result<Option<Self>, Error> {
        let directory = tempfile::tempdir().map_err(Error::file(std::env::temp_dir()))?;
        let file = directory.path().join("film.gif");
        let recorder = Recorder::new(&Look::small(experiment.task), &file, control_timestep)?;
        Ok(Some(Self { recorder, file, _directory: directory }))
    }

    fn shoot(&mut self, environment: &mut dyn Simulated) -> Result<(), Error> {
        if self.recorder.seconds() < FILM_SECONDS { self.recorder.shoot(environment) } else { Ok(()) }
    }

    /// The film's bytes; none if it is too large for a message.
    fn finish(self) -> Result<Vec<u8>, Error> {
        self.recorder.finish()?;
        let film = std::fs::read(&self.file).map_err(Error::file(&self.file))?;
        if film.len() > FILM_BYTES {
            tracing::warn!(bytes = film.len(), limit = FILM_BYTES, "this film is too large for the learner");
            return Ok(Vec::new());
        }
        Ok(film)
    }
}

#[cfg(test)]
mod tests {
    use std::future::ready;

    use tokio::sync::oneshot;

    use super::*;

    fn checkpoint(updates: u64) -> Option<Checkpoint> {
        Some(Checkpoint { run: 7, learner_epoch: 1, updates, ..Checkpoint::default() })
    }

    #[tokio::test]
    async fn a_checkpoint_is_evaluated_once_and_not_before_it_is_due() {
        let (sender, mut newest) = watch::channel(checkpoint(1));
        assert_eq!(next(&mut newest, None, ready(())).await, checkpoint(1));
        let (now_due, due) = oneshot::channel::<()>();
        let second = next(&mut newest, Some((7, 1, 1)), async { due.await.unwrap() });
        let (second, ()) = tokio::join!(second, async {
            sender.send_replace(checkpoint(2));
            sender.send_replace(checkpoint(3));
            now_due.send(()).unwrap();
        });
        assert_eq!(second, checkpoint(3), "the newest when it is due");
        // Without a new one it waits, also when the next evaluation is due.
        let fourth = next(&mut newest, Some((7, 1, 3)), ready(()));
        let (fourth, ()) = tokio::join!(fourth, async {
            sender.send_replace(None);
            sender.send_replace(checkpoint(3));
            sender.send_replace(checkpoint(4));
        });
        assert_eq!(fourth, checkpoint(4));
    }

    #[tokio::test]
    async fn nothing_is_evaluated_after_the_end() {
        let (sender, mut newest) = watch::channel(checkpoint(1));
        let waiting = next(&mut newest, None, std::future::pending());
        assert_eq!(tokio::join!(waiting, async { drop(sender) }).0, None);
        assert_eq!(next(&mut newest, None, ready(())).await, None);
        assert_eq!(unless_ended(&mut newest, ready(1)).await, None);
    }
}
