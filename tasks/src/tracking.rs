//! Multi-clip motion-capture tracking: what all environments share.

use std::sync::Arc;

use comic_clips::{Catalogue, Entry, WalkerModel};
use comic_experiment::{TRACKING_OBSERVATIONS, TaskSpec, Tracking};

use crate::environment::TrackingEnvironment;
use crate::error::Error;
use crate::humanoid;
use crate::observation::{Observation, PROPRIOCEPTION};
use crate::physics::{Models, substeps};
use crate::reference::Reference;
use crate::starts::{ClipStarts, Starts};
use crate::walker::Walker;
use crate::{Simulated, Task};

/// dm_control's `MultiClipMocapTracking` over a catalogue of clips: compiled models, reference clips, starts.
/// Immutable; every environment of a process shares one through an `Arc`.
#[derive(Debug)]
pub struct TrackingTask {
    pub(crate) config: Tracking,
    pub(crate) walker: Walker,
    pub(crate) models: Models,
    pub(crate) references: Vec<Reference>,
    pub(crate) starts: Starts,
    pub(crate) observations: Vec<Observation>,
    /// The farthest reference step.
    pub(crate) look_ahead: usize,
    spec: TaskSpec,
}

impl TrackingTask {
    /// The task of training and evaluation, on the V2020 body. Reads every clip of the catalogue.
    ///
    /// # Errors
    /// [`Error`]: no clip, a clip that cannot be read or tracked, an unknown observation, dm_control's XML missing.
    pub fn new(config: &Tracking, catalogue: &Catalogue) -> Result<Self, Error> {
        Self::on(WalkerModel::Cmu2020, config, catalogue)
    }

    /// As [`TrackingTask::new`], but clips that were all made for the V2019 body are tracked on it. That body's servos
    /// have no filter, so its proprioception is shorter (149 numbers) than networks are built for: it is there for
    /// comparisons with dm_control, whose own test clips are such.
    ///
    /// # Errors
    /// As [`TrackingTask::new`].
    pub fn comparison(config: &Tracking, catalogue: &Catalogue) -> Result<Self, Error> {
        let old = catalogue.entries().iter().all(|entry| entry.model == WalkerModel::Cmu2019);
        Self::on(if old { WalkerModel::Cmu2019 } else { WalkerModel::Cmu2020 }, config, catalogue)
    }

    fn on(kind: WalkerModel, config: &Tracking, catalogue: &Catalogue) -> Result<Self, Error> {
        let entries = catalogue.entries();
        let first = entries.first().ok_or(Error::NoClips)?;
        let look_ahead = config.reference_steps.iter().copied().max().unwrap_or(0);
        // An episode lasts a step at least; at a clip's start dm_control asks for no more than that.
        let min_steps = if config.always_start_at_clip_start { 1 } else { config.min_steps.max(1) };
        for entry in entries {
            entry.check(kind, first.dt, look_ahead, min_steps)?;
        }
        let observations =
            config.observations.iter().map(|name| task_observation(name)).collect::<Result<Vec<_>, _>>()?;
        let starts = Starts::new(entries, look_ahead, min_steps, config.always_start_at_clip_start)
            .ok_or(Error::NoStarts { min_steps })?;

        let model = humanoid::build(kind)?;
        let walker = Walker::new(kind, &model)?;
        let models = Models::new(model, substeps(&first.name, first.dt)?);
        let references = load(&walker, &models, catalogue)?;
        let steps = config.reference_steps.len();
        let size = |all: &[Observation]| all.iter().map(|one| one.size(&walker, steps)).sum();
        let spec = TaskSpec {
            proprioception: size(&PROPRIOCEPTION),
            task: size(&observations),
            ..TaskSpec::tracking(config, entries.iter().map(|entry| entry.name.clone()).collect()).map_err(unknown)?
        };
        Ok(Self { config: config.clone(), walker, models, references, starts, observations, look_ahead, spec })
    }

    /// An environment of its own, already reset; `seed` decides all its draws.
    pub fn tracking_environment(self: &Arc<Self>, seed: u64) -> TrackingEnvironment {
        TrackingEnvironment::new(Arc::clone(self), seed)
    }
}

impl Task for TrackingTask {
    fn spec(&self) -> &TaskSpec {
        &self.spec
    }

    /// Where episodes start, clip by clip.
    fn starts(&self) -> &[ClipStarts] {
        self.starts.clips()
    }

    /// That of the clips' frames, which all have the same.
    fn control_timestep(&self) -> f64 {
        self.models.control_timestep()
    }

    fn environment(self: Arc<Self>, seed: u64) -> Result<Box<dyn Simulated>, Error> {
        Ok(Box::new(TrackingEnvironment::new(self, seed)))
    }
}

fn load(walker: &Walker, models: &Models, catalogue: &Catalogue) -> Result<Vec<Reference>, Error> {
    let mut data = models.data();
    let read = |(index, entry): (usize, &Entry)| Reference::new(catalogue.load(index)?, entry, walker, &mut data);
    catalogue.entries().iter().enumerate().map(read).collect()
}

/// Only the names of the experiment's vocabulary: what else dm_control has is proprioception already, or no input for
/// a network.
fn task_observation(name: &str) -> Result<Observation, Error> {
    TRACKING_OBSERVATIONS
        .contains(&name)
        .then(|| Observation::named(name))
        .flatten()
        .ok_or_else(|| unknown(name.to_string()))
}

pub(crate) fn unknown(name: String) -> Error {
    let likeness = |known: &str| strsim::jaro_winkler(known, &name);
    let nearest = TRACKING_OBSERVATIONS.into_iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)));
    Error::Observation { nearest: nearest.unwrap_or_default().to_string(), name }
}
