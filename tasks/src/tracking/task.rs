//! What all environments of the tracking task share.

use comic_clips::{Catalogue, Entry, WalkerModel};
use comic_experiment::{TRACKING_OBSERVATIONS, TaskSpec, Tracking};

use super::failures::Failures;
use super::observation::Observation;
use super::reference::Reference;
use super::starts::Starts;
use crate::error::{Error, unknown_observation};
use crate::humanoid;
use crate::humanoid::observation::PROPRIOCEPTION;
use crate::humanoid::walker::Walker;
use crate::physics::{Models, substeps};

/// dm_control's `MultiClipMocapTracking` with a catalogue of clips: compiled models, reference clips, starts. It never
/// changes, and all environments of a process share it.
#[derive(Debug)]
pub struct TrackingTask {
    pub(super) config: Tracking,
    pub(super) walker: Walker,
    pub(super) models: Models,
    pub(super) references: Vec<Reference>,
    pub(super) starts: Starts,
    /// Of an environment that has not failed yet; `None` if failures do not count.
    pub(super) failures: Option<Failures>,
    pub(super) observations: Vec<Observation>,
    /// The largest reference step.
    pub(super) look_ahead: usize,
    pub(super) spec: TaskSpec,
}

impl TrackingTask {
    /// The task of training and evaluation, on the V2020 body. Reads every clip of the catalogue.
    ///
    /// # Errors
    /// [`Error`]: there is no clip, a clip cannot be read or tracked, an observation is unknown, or dm_control's XML is
    /// missing.
    pub fn new(config: &Tracking, catalogue: &Catalogue) -> Result<Self, Error> {
        Self::on(WalkerModel::Cmu2020, config, catalogue)
    }

    /// The task on the V2019 body when all clips were made for that body, else [`TrackingTask::new`]. The V2019 servos have
    /// no filter, so the proprioception has 149 numbers, which does not fit the networks. This is for comparisons with
    /// dm_control, whose own test clips are for V2019.
    ///
    /// # Errors
    /// Those of [`TrackingTask::new`].
    pub fn comparison(config: &Tracking, catalogue: &Catalogue) -> Result<Self, Error> {
        let old = catalogue.entries().iter().all(|entry| entry.model == WalkerModel::Cmu2019);
        Self::on(if old { WalkerModel::Cmu2019 } else { WalkerModel::Cmu2020 }, config, catalogue)
    }

    fn on(kind: WalkerModel, config: &Tracking, catalogue: &Catalogue) -> Result<Self, Error> {
        let entries = catalogue.entries();
        let first = entries.first().ok_or(Error::NoClips)?;
        let look_ahead = config.reference_steps.iter().copied().max().unwrap_or(0);
        // An episode has at least one step. For starts at a clip's first frame dm_control requires no more.
        let min_steps = if config.always_start_at_clip_start { 1 } else { config.min_steps.max(1) };
        for entry in entries {
            entry.check(kind, first.dt, look_ahead, min_steps)?;
        }
        let observations =
            config.observations.iter().map(|name| task_observation(name)).collect::<Result<Vec<_>, _>>()?;
        let starts = Starts::new(entries, look_ahead, min_steps, config.always_start_at_clip_start)
            .ok_or(Error::NoStarts { min_steps })?;

        let share = config.failure_starts;
        let failures = (share > 0.0).then(|| Failures::new(share, first.dt, look_ahead, entries, starts.clips()));

        let model = humanoid::build(kind)?;
        let walker = Walker::new(kind, &model)?;
        let models = Models::new(model, substeps(&first.name, first.dt)?);
        let references = load(&walker, &models, catalogue)?;
        let steps = config.reference_steps.len();
        let spec = TaskSpec {
            proprioception: PROPRIOCEPTION.iter().map(|one| one.size(&walker)).sum(),
            task: observations.iter().map(|one: &Observation| one.size(&walker, steps)).sum(),
            ..TaskSpec::tracking(config, entries.iter().map(|entry| entry.name.clone()).collect())
                .map_err(unknown_observation)?
        };
        Ok(Self {
            config: config.clone(),
            walker,
            models,
            references,
            starts,
            failures,
            observations,
            look_ahead,
            spec,
        })
    }
}

fn load(walker: &Walker, models: &Models, catalogue: &Catalogue) -> Result<Vec<Reference>, Error> {
    let mut data = models.data();
    let read = |(index, entry): (usize, &Entry)| Reference::new(catalogue.load(index)?, entry, walker, &mut data);
    catalogue.entries().iter().enumerate().map(read).collect()
}

/// The observation with this name, if the experiment may name it. dm_control's other observations are part of
/// proprioception, or are no input of a network.
fn task_observation(name: &str) -> Result<Observation, Error> {
    TRACKING_OBSERVATIONS
        .contains(&name)
        .then(|| Observation::named(name))
        .flatten()
        .ok_or_else(|| unknown_observation(name.to_string()))
}
