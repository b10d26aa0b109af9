//! A clip of a catalogue, without its motion.

use std::ops::Range;

use crate::error::Error;
use crate::humanoid::WalkerModel;

/// Two time steps that differ by less than this are equal, s.
const TIMESTEP_TOLERANCE: f64 = 1e-9;

/// One clip of a catalogue. Its index in [`Catalogue::entries`](crate::Catalogue::entries) is the index of the clip
/// everywhere: in the value function's embedding, on the wire, and in metrics.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The clip's name in its file, or a built-in clip's own name (not its alias).
    pub name: String,
    /// What the clip was made of if it is a copy; see [`Clip::made_from`](crate::Clip::made_from).
    pub made_from: Option<String>,
    /// T, the number of frames of the whole clip.
    pub steps: usize,
    /// Seconds between frames.
    pub dt: f64,
    /// The body that the clip was made for.
    pub model: WalkerModel,
    /// The first frame in use.
    pub start_step: usize,
    /// The last frame in use, at most `steps`; `None` for the end of the clip. See [`Entry::frames`] and
    /// [`Entry::starts`].
    pub end_step: Option<usize>,
    /// Relative probability of each start in this clip.
    pub weight: f64,
}

impl Entry {
    /// The frames of the clip that the task uses. dm_control takes `[start_step : end_step + 1)`, which is one frame
    /// more than [`Entry::starts`] counts; without `end_step`, all frames to the end of the clip
    /// (`locomotion/mocap/trajectory.py`, `Trajectory.as_dict`).
    pub fn frames(&self) -> Range<usize> {
        let end = self.end_step.map_or(self.steps, |end| (end + 1).min(self.steps));
        self.start_step..end
    }

    /// The frames at which an episode may start, possibly none. The task looks `look_ahead` frames ahead, and an
    /// episode must be able to last `min_steps` steps (`tracking.py`, `_get_possible_starts`).
    pub fn starts(&self, look_ahead: usize, min_steps: usize) -> Range<usize> {
        let end = self.end_step.unwrap_or(self.steps).saturating_sub(look_ahead.saturating_add(min_steps));
        self.start_step..end.max(self.start_step)
    }

    /// Checks that a task can track this clip: its body is `expected`, its time step is `control_dt` seconds (to 1e-9
    /// s), and [`Entry::starts`] is not empty for `look_ahead` and `min_steps`.
    ///
    /// # Errors
    /// [`Error::WrongModel`], [`Error::WrongTimestep`], [`Error::TooShort`].
    pub fn check(
        &self,
        expected: WalkerModel,
        control_dt: f64,
        look_ahead: usize,
        min_steps: usize,
    ) -> Result<(), Error> {
        if self.model != expected {
            return Err(Error::WrongModel { name: self.name.clone(), has: self.model, expected });
        }
        if !self.steps_every(control_dt) {
            return Err(Error::WrongTimestep { name: self.name.clone(), dt: self.dt, expected: control_dt });
        }
        if self.starts(look_ahead, min_steps).is_empty() {
            let end = self.end_step.unwrap_or(self.steps);
            return Err(Error::TooShort {
                name: self.name.clone(),
                first: self.start_step,
                last: end.saturating_sub(1),
                frames: end.saturating_sub(self.start_step),
                look_ahead,
                min_steps,
                needed: look_ahead.saturating_add(min_steps).saturating_add(1),
            });
        }
        Ok(())
    }

    /// Whether the time step is `dt` seconds; never if one of them is no number.
    pub(crate) fn steps_every(&self, dt: f64) -> bool {
        (self.dt - dt).abs() < TIMESTEP_TOLERANCE
    }

    /// Checks that the sub-range lies within the clip.
    pub(crate) fn check_range(&self) -> Result<(), Error> {
        let error =
            |field, value, allowed| Error::Range { name: self.name.clone(), field, value, allowed, steps: self.steps };
        if self.start_step >= self.steps {
            return Err(error("start_step", self.start_step, format!("at most {}", self.steps - 1)));
        }
        match self.end_step {
            // dm_control accepts a larger `end_step`, and then starts episodes beyond the end of the clip.
            Some(end) if end <= self.start_step || end > self.steps => {
                Err(error("end_step", end, format!("{} to {}", self.start_step + 1, self.steps)))
            }
            _ => Ok(()),
        }
    }
}
