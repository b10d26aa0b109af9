//! A counter of the frames that have one defect.

use super::defect::{Defect, Kind};

/// Number of frames with a defect, the first one, and the worst value.
#[derive(Clone, Debug, Default)]
pub(super) struct Tally {
    frames: usize,
    first: usize,
    pub(super) worst: f64,
}

impl Tally {
    /// Adds a frame. Frames are added in increasing order.
    pub(super) fn add(&mut self, frame: usize, amount: f64) {
        if self.frames == 0 {
            self.first = frame;
        }
        self.frames += 1;
        self.worst = self.worst.max(amount);
    }

    /// The defect, or `None` if no frame was added.
    pub(super) fn defect(self, kind: Kind, item: &str, detail: impl FnOnce(f64) -> String) -> Option<Defect> {
        let Self { frames, first: first_frame, worst } = self;
        (frames > 0).then(|| Defect { kind, item: item.into(), frames, first_frame, worst, detail: detail(worst) })
    }
}
