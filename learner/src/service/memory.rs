//! How much memory the learner's buffers can take at most. Each is bounded by configuration, whatever peers do.

use std::fmt;

use comic_proto::Pieces;

use crate::publish::VERSIONS;
use crate::service::FRAME_SIZE;

/// Bytes of a call's answers that its peer does not take: hyper's send buffer, and the largest piece beside it, an asset's.
const ANSWER: usize = (400 + 256) * 1024;

/// A message is not copied out of the buffers that the socket was read to. One has at most twice the bytes of a frame, which
/// is how it grows, and at least [`Pieces::KEPT`] of them are the message's.
const BUFFERS: usize = 2 * FRAME_SIZE as usize / Pieces::KEPT;

/// What bounds the bytes that peers have on their way.
#[derive(Clone, Copy, Debug)]
pub struct Ingest {
    /// Connections at once.
    pub connections: usize,
    /// Bytes that one of them may have on its way unread.
    pub window: usize,
    /// Bytes of messages that were read, of all connections together.
    pub room: usize,
    /// Calls in flight at once.
    pub requests: usize,
    /// Bytes of the largest message that is taken.
    pub message: usize,
    /// Refused messages that may wait for the disk.
    pub quarantined: usize,
}

/// What decides how large the buffers get.
#[derive(Clone, Copy, Debug)]
pub struct Sizes {
    /// Batches that are assembled while one is trained on.
    pub ahead: usize,
    /// Unrolls a batch.
    pub batch: usize,
    /// Bytes of an unroll.
    pub unroll: usize,
    /// What peers have on their way.
    pub ingest: Ingest,
    /// Bytes of the parameters that actors get.
    pub parameters: usize,
    /// Bytes of a checkpoint.
    pub snapshot: usize,
}

/// The most that each buffer holds, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Unrolls in batches: those ahead, and the one at the trainer.
    pub batches: u64,
    /// Bytes on their way in that nobody read yet: a window for each connection.
    pub windows: u64,
    /// Messages that are read, half or whole, and wait for a place in a batch, with what a peer can make of its buffers by
    /// frames of no use.
    pub messages: u64,
    /// What came with the end of a message, and waits until that is answered: a frame for each call.
    pub frames: u64,
    /// Versions of the parameters that are held for readers.
    pub parameters: u64,
    /// Answers on their way out: see [`ANSWER`].
    pub answers: u64,
    /// Refused messages on their way to the disk.
    pub quarantine: u64,
    /// Checkpoints: one being written, one that waits, and the newest, to turn back to.
    pub snapshots: u64,
}

impl Bounds {
    /// The bounds of these sizes.
    pub fn new(sizes: &Sizes) -> Self {
        let product = |factors: &[usize]| factors.iter().fold(1u64, |all, factor| all.saturating_mul(*factor as u64));
        let Sizes { ahead, batch, unroll, ingest, parameters, snapshot } = *sizes;
        let Ingest { connections, window, room, requests, message, quarantined } = ingest;
        Self {
            batches: product(&[ahead + 1, batch, unroll]),
            windows: product(&[connections, window]),
            messages: product(&[room, BUFFERS]),
            frames: product(&[requests, 2 * FRAME_SIZE as usize]),
            parameters: product(&[VERSIONS, parameters]),
            answers: product(&[requests, ANSWER]),
            quarantine: product(&[quarantined, message]),
            snapshots: product(&[3, snapshot]),
        }
    }

    fn parts(&self) -> [(&'static str, u64); 8] {
        let Self { batches, windows, messages, frames, parameters, answers, quarantine, snapshots } = *self;
        [
            ("batches", batches),
            ("connection windows", windows),
            ("messages", messages),
            ("frames", frames),
            ("parameters", parameters),
            ("answers", answers),
            ("quarantine", quarantine),
            ("checkpoints", snapshots),
        ]
    }

    /// All of them together.
    pub fn sum(&self) -> u64 {
        self.parts().iter().fold(0, |sum, (_, bytes)| sum.saturating_add(*bytes))
    }
}

/// In MiB, rounded up.
impl fmt::Display for Bounds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mebibytes = |bytes: u64| bytes.div_ceil(1 << 20);
        write!(f, "at most {} MiB", mebibytes(self.sum()))?;
        for (place, (name, bytes)) in self.parts().into_iter().enumerate() {
            write!(f, "{} {name} {}", if place == 0 { ":" } else { "," }, mebibytes(bytes))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZES: Sizes = Sizes {
        ahead: 1,
        batch: 128,
        unroll: 200_000,
        ingest: Ingest {
            connections: 100,
            window: 1 << 19,
            room: 64 << 20,
            requests: 300,
            message: 1 << 20,
            quarantined: 9,
        },
        parameters: 5_000_000,
        snapshot: 40_000_000,
    };

    #[test]
    fn each_part_is_what_its_buffers_hold_and_the_sum_is_theirs() {
        let bounds = Bounds::new(&SIZES);
        let expected = Bounds {
            batches: 2 * 128 * 200_000,
            windows: 50 * 1024 * 1024,
            messages: 4 * 64 * 1024 * 1024,
            frames: 300 * 512 * 1024,
            parameters: 7 * 5_000_000,
            answers: 300 * 656 * 1024,
            quarantine: 9 * 1024 * 1024,
            snapshots: 3 * 40_000_000,
        };
        assert_eq!(bounds, expected);
        assert_eq!(bounds.sum(), 51_200_000 + 465 * 1_048_576 + 35_000_000 + 201_523_200 + 120_000_000);
        assert_eq!(
            bounds.to_string(),
            "at most 854 MiB: batches 49, connection windows 50, messages 256, frames 150, parameters 34, answers 193, quarantine 9, checkpoints 115"
        );
    }

    #[test]
    fn limits_that_limit_nothing_give_a_bound_that_is_none() {
        let bounds = Bounds::new(&Sizes { ingest: Ingest { room: usize::MAX, ..SIZES.ingest }, ..SIZES });
        assert_eq!((bounds.messages, bounds.sum()), (u64::MAX, u64::MAX));
    }
}
