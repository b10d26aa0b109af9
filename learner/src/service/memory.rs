//! How much memory the learner's buffers can take at most. The configuration bounds each of them, whatever peers do.

use std::fmt;

use comic_proto::Pieces;

use super::http2::FRAME_SIZE;
use crate::publish::VERSIONS;

/// Bytes of a call's answers that its peer does not read: hyper's send buffer, and the largest answer, a chunk of an asset.
const ANSWER: usize = (400 + 256) * 1024;

/// Bytes of buffers for each byte of a message. A message stays in the buffers to which the socket was read. A buffer grows to
/// at most twice the bytes of a frame, and at least [`Pieces::KEPT`] of them belong to the message.
const BUFFER_RATIO: usize = 2 * FRAME_SIZE as usize / Pieces::KEPT;

/// The limits on the bytes that peers send.
#[derive(Clone, Copy, Debug)]
pub struct IngestLimits {
    /// Connections at once.
    pub connections: usize,
    /// Bytes that one connection may have unread.
    pub window: usize,
    /// Bytes of messages that were read, of all connections together.
    pub room: usize,
    /// Calls in flight at once.
    pub requests: usize,
    /// Bytes of the largest message that is accepted.
    pub message: usize,
    /// Refused messages that may wait for the disk.
    pub quarantined: usize,
}

/// The sizes that decide how large the buffers get.
#[derive(Clone, Copy, Debug)]
pub struct Sizes {
    /// Batches that are assembled while one is trained on.
    pub ahead: usize,
    /// Unrolls a batch.
    pub batch: usize,
    /// Bytes of an unroll.
    pub unroll: usize,
    /// Bytes of an off-policy algorithm's replay.
    pub replay: u64,
    /// The limits on what peers send.
    pub ingest: IngestLimits,
    /// Bytes of the parameters that actors get.
    pub parameters: usize,
    /// Bytes of a checkpoint.
    pub snapshot: usize,
}

/// The most that each buffer holds, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Batches: those assembled ahead, the trainer's, and the one that off-policy learning takes from.
    pub batches: u64,
    /// The replay of an off-policy algorithm, with the sample that is learned from; allocated and committed at the start.
    pub replay: u64,
    /// Bytes that were sent and not read yet: a window for each connection.
    pub windows: u64,
    /// Messages that were read, in part or as a whole, and are not in a batch yet, with the memory that a peer can make their
    /// buffers take by useless frames.
    pub messages: u64,
    /// Bytes that came in one frame with the end of a message and wait until it is answered: a frame for each call.
    pub frames: u64,
    /// Versions of the parameters that are held for readers.
    pub parameters: u64,
    /// Answers that their peers have not read yet.
    pub answers: u64,
    /// Refused messages that wait for the disk.
    pub quarantine: u64,
    /// Checkpoints: one being written, one that waits, and the newest, which the trainer can restore.
    pub snapshots: u64,
}

impl Bounds {
    /// The bounds that follow from these sizes.
    pub fn new(sizes: &Sizes) -> Self {
        let product = |factors: &[usize]| factors.iter().fold(1u64, |all, factor| all.saturating_mul(*factor as u64));
        let Sizes { ahead, batch, unroll, replay, ingest, parameters, snapshot } = *sizes;
        let IngestLimits { connections, window, room, requests, message, quarantined } = ingest;
        Self {
            batches: product(&[ahead + 2, batch, unroll]),
            replay,
            windows: product(&[connections, window]),
            messages: product(&[room, BUFFER_RATIO]),
            frames: product(&[requests, 2 * FRAME_SIZE as usize]),
            parameters: product(&[VERSIONS, parameters]),
            answers: product(&[requests, ANSWER]),
            quarantine: product(&[quarantined, message]),
            snapshots: product(&[3, snapshot]),
        }
    }

    fn parts(&self) -> [(&'static str, u64); 9] {
        let Self { batches, replay, windows, messages, frames, parameters, answers, quarantine, snapshots } = *self;
        [
            ("batches", batches),
            ("replay", replay),
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
        replay: 5 << 20,
        ingest: IngestLimits {
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
    fn each_bound_follows_from_its_sizes_and_the_sum_adds_them() {
        let bounds = Bounds::new(&SIZES);
        let expected = Bounds {
            batches: 3 * 128 * 200_000,
            replay: 5 << 20,
            windows: 50 * 1024 * 1024,
            messages: 4 * 64 * 1024 * 1024,
            frames: 300 * 512 * 1024,
            parameters: 7 * 5_000_000,
            answers: 300 * 656 * 1024,
            quarantine: 9 * 1024 * 1024,
            snapshots: 3 * 40_000_000,
        };
        assert_eq!(bounds, expected);
        assert_eq!(bounds.sum(), 76_800_000 + 470 * 1_048_576 + 35_000_000 + 201_523_200 + 120_000_000);
        assert_eq!(
            bounds.to_string(),
            "at most 884 MiB: batches 74, replay 5, connection windows 50, messages 256, frames 150, parameters 34, answers 193, quarantine 9, checkpoints 115"
        );
    }

    #[test]
    fn unlimited_sizes_give_the_largest_bound() {
        let bounds = Bounds::new(&Sizes { ingest: IngestLimits { room: usize::MAX, ..SIZES.ingest }, ..SIZES });
        assert_eq!((bounds.messages, bounds.sum()), (u64::MAX, u64::MAX));
    }
}
