//! How often and how badly.

use super::defect::{Defect, Kind};

/// Frames in which something is wrong.
#[derive(Clone, Debug, Default)]
pub(super) struct Tally {
    frames: usize,
    first: usize,
    pub(super) worst: f64,
}

impl Tally {
    /// Adds a frame, which comes after those added before.
    pub(super) fn add(&mut self, frame: usize, amount: f64) {
        if self.frames == 0 {
            self.first = frame;
        }
        self.frames += 1;
        self.worst = self.worst.max(amount);
    }

    /// The defect, if there is any.
    pub(super) fn defect(self, kind: Kind, item: &str, detail: impl FnOnce(f64) -> String) -> Option<Defect> {
        let Self { frames, first: first_frame, worst } = self;
        (frames > 0).then(|| Defect { kind, item: item.into(), frames, first_frame, worst, detail: detail(worst) })
    }
}
