//! `comic-actor evaluate`.

use std::io::{IsTerminal as _, Write as _};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use comic_clips::Catalogue;
use comic_experiment::{Experiment, TaskName, Transfer};
use comic_proto::v1::EvaluationReport;
use comic_proto::{Access, UnrollShape, chain};
use comic_tasks::{Ghost, Simulated, Step, Task};

use super::delivery::deliver;
use super::settings::{RolloutSettings, Starts};
use super::{Audience, Report, evaluate, watch};
use crate::Error;
use crate::acting_loop::Controller;
use crate::checkpoint::{self, Checkpoint, Position};
use crate::film::encode::Format;
use crate::film::recorder::{Look, Recorder};
use crate::output_file::OutputFile;
use crate::page;
use crate::policy::TorchPolicy;

const JSON_HELP: &str = "\
With --json one object goes to standard output:
  deterministic  whether means were taken instead of samples
  noise          standard deviation of the noise on mean actions
  seed           the seed
  clips          one object for each clip, in the clips' order:
    clip               name
    episodes           number of episodes
    diverged           how many of them ended because the simulation diverged
    length_mean        mean steps of an episode
    return_mean        mean return
    normalised_reward  mean of return / (most a step pays x steps left at the episode's start)
    reward_per_step    reward per survived step / most a step pays, 1.45 in tracking
    fraction_survived  mean of steps / steps left in the clip at the episode's start
    success_rate       share of the episodes that are a success by the task's definition (docs/tasks.md);
                       in tracking they lasted to the end of their clip
    measures           means over episodes, by name: targets in go-to-target, metres and obstacles in gaps
                       and walls, held_steps in ball-catch
    tracking_error     in tracking, means over all steps and the bodies, as PHC defines them:
      position_mm           distance in the world, mm
      local_position_mm     distance when both roots are at the same place, mm
      velocity_mm_per_step  difference of the velocities, mm a step
    head_height        mean over all steps of the head's height, m; 0 in a step that diverged
    reward_terms       each reward term's mean per step, by name
  tasks          in joint training the same for each task, over the episodes of all its clips
  overall        the same over all episodes; its clip is \"overall\"";

/// Evaluates a policy: return, normalised reward, fraction of the clip survived and reward terms, per clip.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = JSON_HELP)]
pub struct Evaluate {
    /// A run's directory, its `checkpoints`, or one checkpoint; the newest complete checkpoint is evaluated. Or a policy
    /// that `comic-learner export` wrote.
    #[arg(long, value_name = "DIR|FILE", visible_alias = "policy", required_unless_present_any = ["preset", "watch"])]
    checkpoint: Option<PathBuf>,
    /// The experiment to evaluate without a checkpoint: a preset's name or a TOML file.
    #[arg(long, value_name = "NAME|FILE", conflicts_with = "checkpoint")]
    preset: Option<String>,
    /// Overrides a field of the preset's or the checkpoint's experiment, for instance
    /// `--set tracking.termination_threshold=0.5` or `--set get_up.lying_share=1`.
    #[arg(long, value_name = "FIELD=VALUE", conflicts_with_all = ["watch", "learner"])]
    set: Vec<String>,
    /// The policy with its initial parameters.
    #[arg(long)]
    untrained: bool,
    /// The servo action (the pose of the next reference frame) instead of a policy.
    #[arg(long, conflicts_with = "untrained")]
    servo: bool,
    /// Clips in place of the experiment's own: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP.
    #[arg(long, value_name = "SOURCE", num_args = 1..)]
    clips: Vec<String>,
    /// Leaves out clips that were made from others by `clips mirror`, `speed` or `join`. Tasks that follow no clips are
    /// evaluated as without it.
    #[arg(long)]
    originals: bool,
    /// The mean action and the latent's mean instead of samples.
    #[arg(long)]
    deterministic: bool,
    /// Adds Gaussian noise with this standard deviation to each entry of the mean action, before it is clipped, as
    /// MoCapAct's evaluation does with 0.1.
    #[arg(long, value_name = "STD", default_value_t = 0.0, requires = "deterministic", value_parser = noise)]
    noise: f32,
    /// Episodes of each clip from random starts, instead of every start once.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    episodes: Option<u32>,
    /// Seed of random starts and of the noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// JSON instead of a table; see below.
    #[arg(long)]
    json: bool,
    /// Write the reward of every step to this file, one JSON object an episode: clip, start (its frame), rewards.
    #[arg(long, value_name = "FILE")]
    rewards: Option<PathBuf>,
    /// Report the evaluation of a checkpoint to this learner. The learner stores it in `evaluations.jsonl`, and the
    /// checkpoint as `checkpoints/best` if no other was better.
    #[arg(long, value_name = "URL", conflicts_with_all = ["untrained", "servo", "preset"])]
    learner: Option<String>,
    /// Evaluates the newest checkpoint of the run of --learner without noise, on at most 64 starts that are always the
    /// same, again and again until the run is over. The learner stores the evaluations with a short film each.
    #[arg(long, requires = "learner", help_heading = "Watch")]
    #[arg(conflicts_with_all = ["checkpoint", "noise", "episodes", "json", "rewards", "html", "video", "camera", "ghost", "size", "fps"])]
    watch: bool,
    /// Minutes from one evaluation to the next.
    #[arg(long, value_name = "MINUTES", default_value_t = 2.0, value_parser = minutes, help_heading = "Watch")]
    #[arg(requires = "watch")]
    every: f64,
    /// Lowers the priority of the process, so that it takes little time from actors and learner.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(i32).range(0..20))]
    #[arg(requires = "watch", help_heading = "Watch")]
    nice: i32,
    /// Where files from the learner are kept; `comic` in the user's cache directory unless given.
    #[arg(long, value_name = "DIR", env = "COMIC_CACHE", help_heading = "Watch")]
    cache: Option<PathBuf>,
    /// End with exit code 3 when the learner has not answered for so long. Never unless given.
    #[arg(long, value_name = "SECONDS", env = "COMIC_GIVE_UP_AFTER", help_heading = "Watch")]
    #[arg(value_parser = clap::value_parser!(u32).range(1..))]
    give_up_after: Option<u32>,
    #[command(flatten)]
    access: Access,
    /// Films the first episode: .gif, .webp, .mp4 (through ffmpeg) or .png (a contact sheet).
    #[arg(long, value_name = "FILE", help_heading = "Film")]
    video: Option<PathBuf>,
    #[command(flatten)]
    look: Look,
    /// Writes a page for any browser that plays the episodes with the lowest, the median and the highest normalised reward.
    #[arg(long, value_name = "FILE", help_heading = "Film")]
    html: Option<PathBuf>,
}

/// What is evaluated.
struct Subject {
    experiment: Experiment,
    parameters: Option<Vec<u8>>,
    /// In transfer: the file of the frozen low level.
    low_level: Option<Vec<u8>>,
    position: Position,
}

impl Evaluate {
    /// Evaluates and prints the report.
    ///
    /// # Errors
    /// A wrong command line, a checkpoint that cannot be used, a failing evaluation, film or report.
    pub fn run(&self) -> Result<(), Error> {
        if let (Some(learner), true) = (&self.learner, self.watch) {
            return self.watch(learner);
        }
        let subject = self.subject()?;
        let position = subject.position;
        let (report, film) = self.evaluate(subject)?;
        let json = serde_json::to_string_pretty(&report)
            .map_err(|error| Error::Usage(format!("cannot write the report as JSON: {error}")))?;
        // The report is printed first: a failing film or an unreachable learner must not lose it.
        let text = if self.json { format!("{json}\n") } else { report.to_string() };
        std::io::stdout().write_all(text.as_bytes()).map_err(Error::file("standard output"))?;
        if let Some(learner) = &self.learner {
            let Position { run, epoch: learner_epoch, version, updates } = position;
            let report = EvaluationReport { run, learner_epoch, version, updates, json, ..EvaluationReport::default() };
            deliver(learner, &self.access, report)?;
        }
        film
    }

    fn watch(&self, learner: &str) -> Result<(), Error> {
        watch::run(&watch::WatchSettings {
            learner: learner.to_owned(),
            access: self.access.clone(),
            cache: self.cache.clone(),
            give_up_after: self.give_up_after.map(|seconds| Duration::from_secs(seconds.into())),
            interval: Duration::from_secs_f64(self.every * 60.0),
            clips: self.clips.clone(),
            originals: self.originals,
            seed: self.seed,
            nice: self.nice,
        })
    }

    /// The report, and the result of the film.
    fn evaluate(&self, subject: Subject) -> Result<(Report, Result<(), Error>), Error> {
        let Subject { mut experiment, parameters, low_level, position } = subject;
        if self.servo {
            // The servo action is a command, not a latent.
            experiment.transfer = Transfer::default();
        }
        if let Some(out) = self.html.as_ref().filter(|out| !page::is_page(out)) {
            return Err(Error::Usage(format!("--html {}: name it .html", out.display())));
        }
        let page_ghost = if self.video.is_none() && self.html.is_some() { self.look.of_page()? } else { None };
        if let Some(out) = &self.video {
            Format::of(out)?;
            self.look.suits(experiment.task)?;
        }
        // An untrained policy starts from the mean pose of the experiment's clips, also when it is evaluated on others.
        let own = if self.untrained { Some(Catalogue::open(&experiment.clips)?) } else { None };
        let experiment = experiment.with_clips(&self.clips);
        let catalogue = Catalogue::open(&experiment.clips)?.for_evaluation(&experiment, self.originals)?;
        let task = comic_tasks::build(&experiment, &catalogue)?;
        let options = RolloutSettings {
            starts: self.episodes.map_or(Starts::Every, |episodes| Starts::Random(episodes as usize)),
            deterministic: self.deterministic,
            noise: self.noise,
            seed: self.seed,
            ..RolloutSettings::default()
        };
        let shape = UnrollShape::new(task.spec(), &experiment);
        let mut policy =
            self.policy(&experiment, task.as_ref(), own.as_ref(), low_level.as_deref(), parameters.as_deref())?;
        let mut controller = policy.as_mut().map_or(Controller::Servo, Controller::Policy);
        let recorder =
            self.video.as_ref().map(|out| Recorder::new(&self.look, out, task.control_timestep())).transpose()?;
        let page = self.html.as_ref().map(|out| {
            let file = OutputFile::create(out).map_err(Error::file(out))?;
            let ghost = page_ghost.or((experiment.task == TaskName::Tracking).then_some(Ghost::On));
            let (title, every) = (self.title(&experiment, position.updates), self.look.every(task.control_timestep()));
            Ok::<_, Error>((file, super::page::Look { title, ghost, every }))
        });
        let page = page.transpose()?;
        let mut follower = Follower { recorder, failed: None };
        let finished = evaluate(&mut controller, &task, &shape, &options, &mut follower)?;
        let report = Report::new(task.spec(), &finished, &options);
        if let Some(path) = &self.rewards {
            super::rewards::write(path, task.spec(), &finished)?;
        }
        let film = match (follower.failed, follower.recorder) {
            (Some(error), _) => Err(error),
            (None, recorder) => recorder.map_or(Ok(()), Recorder::finish),
        };
        let page = page.map_or(Ok(()), |(file, look)| {
            let document = super::page::make(look, &mut controller, &task, &shape, &finished, &options)?;
            document.write(file)
        });
        Ok((report, both(film, page)))
    }

    /// What is evaluated, in words.
    fn title(&self, experiment: &Experiment, updates: u64) -> String {
        let tasks: Vec<&str> = experiment.tasks().iter().map(|(task, _)| task.name()).collect();
        let policy = match &self.checkpoint {
            _ if self.servo => "servo action".into(),
            _ if self.untrained => "untrained".into(),
            Some(path) => format!("{} after {updates} updates", page::short(path)),
            None => String::new(),
        };
        let noise = if self.deterministic && self.noise == 0.0 { "without noise" } else { "with noise" };
        format!("{} · {policy}, {noise}", tasks.join(", "))
    }

    /// The experiment, and the parameters when there is a checkpoint.
    fn subject(&self) -> Result<Subject, Error> {
        if let Some(path) = &self.checkpoint {
            let found = checkpoint::read(path)?;
            tracing::info!(checkpoint = %found.path.display(), "evaluating");
            let Checkpoint { experiment, policy, low_level, position, .. } = found;
            let experiment = experiment.with_overrides(&self.set)?;
            return Ok(Subject { experiment, parameters: Some(policy), low_level, position });
        }
        let preset = self.preset.as_deref().unwrap_or_default();
        if !self.untrained && !self.servo {
            return Err(Error::Usage(
                "a preset has no trained policy: add --untrained or --servo, or name a --checkpoint".into(),
            ));
        }
        let experiment = comic_experiment::resolve(preset, &self.set)?;
        Ok(Subject { experiment, parameters: None, low_level: None, position: Position::default() })
    }

    fn policy(
        &self,
        experiment: &Experiment,
        task: &dyn Task,
        own: Option<&Catalogue>,
        low_level: Option<&[u8]>,
        parameters: Option<&[u8]>,
    ) -> Result<Option<TorchPolicy>, Error> {
        if self.servo {
            return Ok(None);
        }
        let policy = match parameters {
            Some(parameters) if !self.untrained => {
                TorchPolicy::from_parameters(task.spec(), experiment, low_level, parameters)?
            }
            _ => TorchPolicy::untrained(task.spec(), experiment, low_level, experiment.seed, || {
                own.map_or(Ok([0.0; 56]), |own| Ok(own.mean_action()?))
            })?,
        };
        Ok(Some(policy))
    }
}

/// Shows the evaluation's progress, and films its first episode if a film was asked for.
struct Follower {
    recorder: Option<Recorder>,
    /// The error that ended the film early.
    failed: Option<Error>,
}

impl Audience<Box<dyn Simulated>> for Follower {
    fn watch(
        &mut self,
        number: usize,
        environment: &mut Box<dyn Simulated>,
        _: Option<&Step>,
    ) -> Result<ControlFlow<()>, Error> {
        if let (Some(recorder), None, 0) = (&mut self.recorder, &self.failed, number) {
            self.failed = recorder.shoot(environment.as_mut()).err();
        }
        Ok(ControlFlow::Continue(()))
    }

    fn count(&mut self, done: usize, all: usize) {
        show_progress(done, all);
    }
}

/// Both results as one: the first error, and a line of the log for another one.
fn both(film: Result<(), Error>, page: Result<(), Error>) -> Result<(), Error> {
    if let (Err(_), Err(error)) = (&film, &page) {
        tracing::error!("{}", chain(error));
    }
    film.and(page)
}

fn noise(text: &str) -> Result<f32, String> {
    match text.parse() {
        Ok(noise) if (0.0..=1e3).contains(&noise) => Ok(noise),
        _ => Err("must be a number from 0 to 1000".into()),
    }
}

fn minutes(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(minutes) if (0.0..=1e6).contains(&minutes) => Ok(minutes),
        _ => Err("must be a number from 0 to 1000000".into()),
    }
}

fn show_progress(done: usize, all: usize) {
    let mut stderr = std::io::stderr();
    if stderr.is_terminal() {
        let end = if done == all { "\n" } else { "" };
        // The evaluation continues when its progress cannot be shown.
        let _ = write!(stderr, "\r{done} of {all} episodes{end}");
    } else if done.is_multiple_of(100) || done == all {
        tracing::info!(done, all, "episodes");
    }
}
