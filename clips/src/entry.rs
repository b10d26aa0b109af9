//! What is known of a clip before its motion is read.

use std::ops::Range;

use crate::error::Error;
use crate::humanoid::WalkerModel;

/// Two time steps that differ by less than this (s) are the same.
const TIMESTEP_TOLERANCE: f64 = 1e-9;

/// One clip of a catalogue. Its index in [`Catalogue::entries`](crate::Catalogue::entries) is the clip's index
/// everywhere: in the value function's embedding, on the wire, in metrics.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The clip's name in its file, or a built-in clip's own name (not its alias).
    pub name: String,
    /// T, the number of frames of the whole clip.
    pub steps: usize,
    /// Seconds between frames.
    pub dt: f64,
    /// The body it was made for.
    pub model: WalkerModel,
    /// First frame used.
    pub start_step: usize,
    /// Last frame used, or `None` for the clip's end. At most `steps`; see [`Entry::frames`] and [`Entry::starts`].
    pub end_step: Option<usize>,
    /// Relative probability of each of its starts.
    pub weight: f64,
}

impl Entry {
    /// The frames of the clip that the task sees: dm_control slices `[start_step : end_step + 1)`, one frame more
    /// than starts are counted in, or up to the clip's end without `end_step`
    /// (`locomotion/mocap/trajectory.py`, `Trajectory.as_dict`).
    pub fn frames(&self) -> Range<usize> {
        let end = self.end_step.map_or(self.steps, |end| (end + 1).min(self.steps));
        self.start_step..end
    }

    /// Frames of the clip at which an episode may start when the task looks `look_ahead` frames ahead and an episode
    /// must be able to last `min_steps` steps (`tracking.py`, `_get_possible_starts`); empty when there are none.
    pub fn starts(&self, look_ahead: usize, min_steps: usize) -> Range<usize> {
        let end = self.end_step.unwrap_or(self.steps).saturating_sub(look_ahead.saturating_add(min_steps));
        self.start_step..end.max(self.start_step)
    }

    /// Whether a task can track this clip: its body is `expected`, its frames are `control_dt` seconds apart (to
    /// 1e-9), and at least one frame can be a start, with the farthest reference `look_ahead` frames ahead and
    /// `min_steps` steps left.
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
        // Put so that a NaN is refused.
        let same = (self.dt - control_dt).abs() < TIMESTEP_TOLERANCE;
        if !same {
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

    /// Checks the sub-range against the clip's length.
    pub(crate) fn check_range(&self) -> Result<(), Error> {
        let error =
            |field, value, allowed| Error::Range { name: self.name.clone(), field, value, allowed, steps: self.steps };
        if self.start_step >= self.steps {
            return Err(error("start_step", self.start_step, format!("at most {}", self.steps - 1)));
        }
        match self.end_step {
            // dm_control takes larger ones and then starts episodes beyond the clip's end.
            Some(end) if end <= self.start_step || end > self.steps => {
                Err(error("end_step", end, format!("{} to {}", self.start_step + 1, self.steps)))
            }
            _ => Ok(()),
        }
    }
}
