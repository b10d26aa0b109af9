//! Multi-clip motion-capture tracking (dm_control's `locomotion/tasks/reference_pose/tracking.py`).

mod environment;
mod failures;
mod gradient;
mod observation;
mod reference;
mod reward;
mod starts;
mod task;

pub use environment::TrackingEnvironment;
pub use task::TrackingTask;
