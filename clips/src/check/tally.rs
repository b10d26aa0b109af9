//! Counters of the frames that have one defect.

use std::ops::Range;

use super::defect::{Defect, Kind};

/// Number of frames with a defect, the first one, and the worst value.
#[derive(Clone, Debug, Default)]
pub(super) struct Tally {
    frames: usize,
    first: usize,
    worst: f64,
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

    /// Number of frames added.
    pub(super) fn frames(&self) -> usize {
        self.frames
    }

    /// The defect, or `None` if no frame was added.
    pub(super) fn defect(self, kind: Kind, item: &str, detail: impl FnOnce(f64) -> String) -> Option<Defect> {
        let Self { frames, first: first_frame, worst } = self;
        (frames > 0).then(|| Defect { kind, item: item.into(), frames, first_frame, worst, detail: detail(worst) })
    }
}

/// A [`Tally`] of ranges of frames, with the description of the worst range.
#[derive(Clone, Debug, Default)]
pub(super) struct Stretches {
    tally: Tally,
    detail: String,
}

impl Stretches {
    /// Adds a range of frames, after those that were added before. `detail` gets the frames in words.
    pub(super) fn add(&mut self, range: Range<usize>, amount: f64, detail: impl FnOnce(&str) -> String) {
        if self.tally.frames == 0 || amount > self.tally.worst {
            self.detail = detail(&match range.len() {
                1 => format!("frame {}", range.start),
                _ => format!("frames {} to {}", range.start, range.end.saturating_sub(1)),
            });
        }
        range.for_each(|frame| self.tally.add(frame, amount));
    }

    /// The defect, or `None` if no range was added.
    pub(super) fn defect(self, kind: Kind, item: &str) -> Option<Defect> {
        self.tally.defect(kind, item, |_| self.detail)
    }
}
