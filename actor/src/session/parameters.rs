//! Assembles parameters from the pieces in which they arrive.

use bytes::{Bytes, BytesMut};
use comic_proto::v1::ParametersChunk;

use crate::Error;
use crate::mailbox::Directive;

/// A whole version.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Assembled {
    /// How to act from the next unroll on.
    Act(Directive),
    /// The run is over.
    RunOver,
}

/// Assembles versions, and checks every piece.
#[derive(Debug)]
pub struct Assembler {
    limit: u64,
    /// The version being received, and its bytes so far.
    open: Option<(Announced, BytesMut)>,
}

/// What all pieces of a version have in common.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Announced {
    learner_epoch: u64,
    version: u64,
    run_over: bool,
    total: u64,
}

impl Assembler {
    /// Refuses versions of more than `limit` bytes.
    pub fn new(limit: u64) -> Self {
        Self { limit, open: None }
    }

    /// Takes the next piece, and returns the version if this piece completes it.
    ///
    /// A piece at offset 0 begins a version. An incomplete version before it is dropped.
    ///
    /// # Errors
    /// [`Error::Parameters`] for a piece that breaks the protocol. The stream cannot be used after that.
    pub fn push(&mut self, chunk: &ParametersChunk) -> Result<Option<Assembled>, Error> {
        let announced = Announced {
            learner_epoch: chunk.learner_epoch,
            version: chunk.version,
            run_over: chunk.run_over,
            total: chunk.total,
        };
        if chunk.offset == 0 {
            if announced.total > self.limit {
                return Err(malformed(format!("{} bytes announced, at most {} fit", announced.total, self.limit)));
            }
            self.open = Some((announced, BytesMut::new()));
        }
        let Some((expected, received)) = &mut self.open else {
            return Err(malformed("the first piece does not start at 0".into()));
        };
        if *expected != announced {
            return Err(malformed("pieces of one version disagree".into()));
        }
        if chunk.offset != received.len() as u64 {
            return Err(malformed(format!("a piece at {} follows {} bytes", chunk.offset, received.len())));
        }
        let whole = received.len() as u64 + chunk.data.len() as u64;
        if whole > announced.total {
            return Err(malformed(format!("more than the {} bytes announced", announced.total)));
        }
        if chunk.data.is_empty() && announced.total > 0 {
            return Err(malformed("an empty piece".into()));
        }
        received.extend_from_slice(&chunk.data);
        if whole < announced.total {
            return Ok(None);
        }
        let parameters = std::mem::take(received).freeze();
        self.open = None;
        complete(announced, parameters).map(Some)
    }
}

fn complete(announced: Announced, parameters: Bytes) -> Result<Assembled, Error> {
    let Announced { learner_epoch, version, run_over, .. } = announced;
    if run_over {
        return Ok(Assembled::RunOver);
    }
    if parameters.is_empty() {
        return Err(malformed("a policy without parameters".into()));
    }
    Ok(Assembled::Act(Directive { learner_epoch, version, parameters }))
}

fn malformed(reason: String) -> Error {
    Error::Parameters { reason }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn chunk(version: u64, total: u64, offset: u64, data: &[u8]) -> ParametersChunk {
        ParametersChunk { learner_epoch: 3, version, total, offset, data: data.to_vec().into(), run_over: false }
    }

    proptest! {
        #[test]
        fn a_version_is_whole_however_it_is_cut(
            payload in prop::collection::vec(any::<u8>(), 1..200),
            piece in 1_usize..64,
        ) {
            let mut assembler = Assembler::new(200);
            let mut complete = None;
            for (index, data) in payload.chunks(piece).enumerate() {
                prop_assert!(complete.is_none());
                complete = assembler.push(&chunk(8, payload.len() as u64, (index * piece) as u64, data)).unwrap();
            }
            let expected = Directive { learner_epoch: 3, version: 8, parameters: payload.into() };
            prop_assert_eq!(complete, Some(Assembled::Act(expected)));
        }

        #[test]
        fn no_sequence_of_pieces_makes_it_hold_more_than_the_limit(
            pieces in prop::collection::vec((0_u64..40, 0_u64..40, prop::collection::vec(any::<u8>(), 0..40)), 0..20),
        ) {
            let mut assembler = Assembler::new(30);
            for (total, offset, data) in pieces {
                if let Ok(Some(Assembled::Act(directive))) = assembler.push(&chunk(1, total, offset, &data)) {
                    prop_assert_eq!(directive.parameters.len() as u64, total);
                }
                prop_assert!(assembler.open.as_ref().is_none_or(|(_, received)| received.len() <= 30));
            }
        }
    }

    #[test]
    fn a_newer_version_may_replace_an_incomplete_one() {
        let mut assembler = Assembler::new(10);
        assert_eq!(assembler.push(&chunk(1, 4, 0, b"ab")).unwrap(), None);
        assert!(matches!(assembler.push(&chunk(2, 1, 0, b"c")).unwrap(), Some(Assembled::Act(d)) if d.version == 2));
    }

    #[test]
    fn pieces_that_break_the_protocol_are_refused() {
        let refused = |pieces: &[ParametersChunk]| {
            let mut assembler = Assembler::new(10);
            pieces.iter().map(|piece| assembler.push(piece)).find_map(Result::err).map(|error| error.to_string())
        };
        for (pieces, reason) in [
            (vec![chunk(1, 11, 0, b"a")], "at most 10 fit"),
            (vec![chunk(1, 4, 2, b"a")], "does not start at 0"),
            (vec![chunk(1, 4, 0, b"ab"), chunk(1, 4, 3, b"c")], "follows 2 bytes"),
            (vec![chunk(1, 4, 0, b"ab"), chunk(2, 4, 2, b"cd")], "disagree"),
            (vec![chunk(1, 4, 0, b"ab"), chunk(1, 4, 2, b"cde")], "more than the 4"),
            (vec![chunk(1, 4, 0, b"")], "an empty piece"),
            (vec![chunk(1, 0, 0, b"")], "without parameters"),
        ] {
            let found = refused(&pieces).unwrap_or_default();
            assert!(found.contains(reason), "{reason}: {found}");
        }
    }

    #[test]
    fn the_end_of_the_run_needs_no_parameters() {
        let mut assembler = Assembler::new(10);
        let run_over = ParametersChunk { run_over: true, ..chunk(1, 0, 0, b"") };
        assert_eq!(assembler.push(&run_over).unwrap(), Some(Assembled::RunOver));
    }
}
