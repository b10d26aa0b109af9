//! The task and the policy of a film or a window.

use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use comic_clips::Catalogue;
use comic_experiment::{ClipSource, Experiment, TaskName, Transfer};
use comic_proto::UnrollShape;
use comic_tasks::{Simulated, Task};

use crate::Error;
use crate::acting_loop::Controller;
use crate::checkpoint::{self, Checkpoint};
use crate::evaluate::{Audience, Finished, RolloutSettings, Start, roll_out};
use crate::page;
use crate::policy::TorchPolicy;

/// The preset of tracking; every other task's preset has the task's name.
const TRACKING_PRESET: &str = "quickstart";

/// The task, and what acts in it.
#[derive(Args, Clone, Debug)]
pub(super) struct Scene {
    /// The task: tracking, go-to-target, gaps, walls, get-up or ball-catch.
    #[arg(long, value_name = "TASK")]
    task: TaskName,
    /// The clip to follow or to start from, instead of the experiment's clips: builtin:NAME, FILE.h5#CLIP.
    #[arg(long, value_name = "SOURCE")]
    clip: Option<String>,
    /// The policy that acts: a run's directory, its `checkpoints`, one checkpoint, or a policy that `comic-learner export`
    /// wrote. Without it, the servo action follows a clip, and the zero action acts in any other task.
    #[arg(long, value_name = "DIR|FILE", visible_alias = "policy")]
    checkpoint: Option<PathBuf>,
    /// The experiment without a checkpoint: a preset's name or a TOML file; the task's own preset unless given.
    #[arg(long, value_name = "NAME|FILE", conflicts_with = "checkpoint")]
    preset: Option<String>,
    /// Overrides a field of the preset, for instance `--set gaps.gap=[0.5,1.0]`.
    #[arg(long, value_name = "FIELD=VALUE", conflicts_with = "checkpoint")]
    set: Vec<String>,
    /// Where the first episode starts: the clip's frame, or the number of a drawn episode; the task's first unless
    /// given. Each later episode begins at the next start.
    #[arg(long, value_name = "N")]
    start: Option<usize>,
    /// The mean action and the latent's mean instead of samples.
    #[arg(long)]
    deterministic: bool,
    /// Seed of the noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// A task, and what acts in it.
pub(super) struct Cast {
    pub(super) task: Arc<dyn Task>,
    policy: Option<TorchPolicy>,
    shape: UnrollShape,
    name: TaskName,
    /// Clip and frame of all starts, the wanted one first.
    starts: Vec<(usize, usize)>,
    options: RolloutSettings,
}

/// What a checkpoint holds for acting.
struct Learned {
    policy: Vec<u8>,
    low_level: Option<Vec<u8>>,
}

impl Scene {
    /// The task's name.
    pub(super) fn task(&self) -> TaskName {
        self.task
    }

    /// What is shown, in words.
    pub(super) fn title(&self) -> String {
        let policy = match &self.checkpoint {
            Some(path) if self.deterministic => format!("{}, without noise", page::short(path)),
            Some(path) => format!("{}, with noise of seed {}", page::short(path), self.seed),
            None if self.task == TaskName::Tracking => "servo action".into(),
            None => "zero action".into(),
        };
        format!("{} · {policy}", self.task)
    }

    /// Reads experiment, checkpoint and clips, and builds the task.
    ///
    /// # Errors
    /// Errors of the experiment, the checkpoint, a clip or the start.
    pub(super) fn cast(&self) -> Result<Cast, Error> {
        let (mut experiment, learned) = self.experiment()?;
        if let Some(clip) = &self.clip {
            experiment.clips = vec![ClipSource::parse(clip)];
        }
        let task = comic_tasks::build(&experiment, &Catalogue::open(&experiment.clips)?)?;
        let policy = learned.map(|Learned { policy, low_level }| {
            TorchPolicy::from_parameters(task.spec(), &experiment, low_level.as_deref(), &policy)
        });
        let policy = policy.transpose()?;
        let starts = self.starts(task.as_ref())?;
        let name = self.task;
        let options = RolloutSettings {
            deterministic: self.deterministic,
            seed: self.seed,
            environments: 1,
            ..RolloutSettings::default()
        };
        let shape = UnrollShape::new(task.spec(), &experiment);
        Ok(Cast { task, policy, shape, name, starts, options })
    }

    /// The experiment, and what was learned when there is a checkpoint. Without one, no low level acts.
    fn experiment(&self) -> Result<(Experiment, Option<Learned>), Error> {
        let own = if self.task == TaskName::Tracking { TRACKING_PRESET } else { self.task.name() };
        let (experiment, learned, origin) = match &self.checkpoint {
            Some(path) => {
                let Checkpoint { path, experiment, policy, low_level, .. } = checkpoint::read(path)?;
                tracing::info!(checkpoint = %path.display(), "playing");
                (experiment, Some(Learned { policy, low_level }), format!("checkpoint {}", path.display()))
            }
            None => {
                let preset = self.preset.as_deref().unwrap_or(own);
                let mut experiment = comic_experiment::resolve(preset, &self.set)?;
                experiment.transfer = Transfer::default();
                (experiment, None, format!("preset {preset}"))
            }
        };
        if experiment.tasks().iter().any(|(task, _)| *task == self.task) {
            return Ok((experiment, learned));
        }
        Err(Error::Usage(format!(
            "{origin}: its task is {}, not {}: name that one with --task, or another checkpoint or preset",
            experiment.tasks().iter().map(|(task, _)| task.name()).collect::<Vec<_>>().join(" and "),
            self.task
        )))
    }

    /// All starts of the first clip that has any, the wanted one first.
    fn starts(&self, task: &dyn Task) -> Result<Vec<(usize, usize)>, Error> {
        let spec = task.spec();
        let is_own = |clip: usize| spec.tasks.get(spec.task_of(clip)).is_some_and(|part| part.name == self.task.name());
        let clip = task.starts().iter().find(|clip| is_own(clip.clip) && !clip.frames.is_empty());
        let clip = clip.ok_or_else(|| Error::Usage("the clip is too short for an episode to start".into()))?;
        let first = self.start.unwrap_or(clip.frames.start);
        if !clip.frames.contains(&first) {
            let (from, to) = (clip.frames.start, clip.frames.end - 1);
            return Err(Error::Usage(format!("--start {first}: no episode starts there, only at {from} to {to}")));
        }
        let frames = (first..clip.frames.end).chain(clip.frames.start..first);
        Ok(frames.map(|start| (clip.clip, start)).collect())
    }
}

impl Cast {
    /// Rolls out `episodes` episodes, or fewer if the audience breaks.
    ///
    /// # Errors
    /// A failing forward pass, or what the audience returns.
    pub(super) fn play(
        &mut self,
        episodes: usize,
        audience: &mut dyn Audience<Box<dyn Simulated>>,
    ) -> Result<Vec<Finished>, Error> {
        self.roll_out(&Start::numbered(self.starts.iter().copied().cycle().take(episodes)), audience)
    }

    /// Rolls out `episodes` episodes whose starts are spread evenly over all starts, or every start if there are fewer, or fewer
    /// if the audience breaks.
    ///
    /// # Errors
    /// As for [`play`](Self::play).
    pub(super) fn play_spread(
        &mut self,
        episodes: usize,
        audience: &mut dyn Audience<Box<dyn Simulated>>,
    ) -> Result<Vec<Finished>, Error> {
        let starts = self.starts.len();
        let count = episodes.min(starts);
        if count < episodes {
            tracing::warn!(episodes, starts, "there are fewer starts than episodes: each start has one");
        }
        let spread = (0..count).filter_map(|place| self.starts.get(place * starts / count).copied());
        self.roll_out(&Start::numbered(spread), audience)
    }

    fn roll_out(
        &mut self,
        starts: &[Start],
        audience: &mut dyn Audience<Box<dyn Simulated>>,
    ) -> Result<Vec<Finished>, Error> {
        let mut controller = match &mut self.policy {
            Some(policy) => Controller::Policy(policy),
            None if self.name == TaskName::Tracking => Controller::Servo,
            None => Controller::Zero,
        };
        roll_out(&mut controller, &self.task, &self.shape, starts, &self.options, audience)
    }
}
