//! The physics without a task: what the environments' speed is measured against.

use std::sync::Arc;

use crate::physics::Data;
use crate::tracking::TrackingTask;

/// `6 × mj_step` + `mj_forward` per control step (10 × for clips of 0.05 s) on a task's own model, and nothing else.
#[derive(Debug)]
pub struct RawFloor {
    task: Arc<TrackingTask>,
    data: Data,
    control: [f64; 56],
}

impl RawFloor {
    /// A simulation on the task's model, at the first start of its first clip.
    pub fn new(task: &Arc<TrackingTask>) -> Self {
        let mut floor = Self { task: Arc::clone(task), data: task.models.data(), control: [0.0; 56] };
        let first = task.references.first().map_or(0, |reference| reference.first);
        floor.reset_to(0, first);
        floor
    }

    /// `mj_resetData` and the state at frame `start` of clip `clip`, both as in [`Episode`](crate::Episode). Frames
    /// and clips out of range are the last ones.
    pub fn reset_to(&mut self, clip: usize, start: usize) {
        let Some(reference) = self.task.references.get(clip).or(self.task.references.last()) else { return };
        let frame = start.saturating_sub(reference.first);
        self.data.reset();
        self.data.qpos_mut().copy_from_slice(&reference.qpos(frame));
        self.data.qvel_mut().copy_from_slice(&reference.qvel(frame));
    }

    /// One control step; `action` as in [`Environment::step`](crate::Environment::step).
    pub fn step(&mut self, action: &[f32]) {
        for (place, value) in self.control.iter_mut().zip(action) {
            *place = f64::from(*value);
        }
        self.task.models.step_plainly(&mut self.data, &self.control);
    }

    /// `mj_forward`: after [`RawFloor::reset_to`], the least that a reset costs.
    pub fn forward(&mut self) {
        self.data.forward();
    }
}
