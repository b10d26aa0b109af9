//! The messages in the frames of a connection. The first byte decides how the bytes are cut into pieces.

#![no_main]

use bytes::Bytes;
use comic_fuzz::seed;
use comic_proto::v1::UnrollAck;
use comic_proto::{FrameError, FrameReader, frame};
use libfuzzer_sys::fuzz_target;

/// Bytes of the largest message.
const LIMIT: usize = 4096;

fuzz_target!(init: {
    let message = frame(&UnrollAck { sequence: 3, ..UnrollAck::default() });
    seed("two-messages", &[&[1], &message[..], &message[..]].concat());
    seed("half-a-message", &[&[3], &message[..message.len() - 1]].concat());
    seed("compressed", &[1, 1, 0, 0, 0, 0]);
    seed("long", &[1, 0, 255, 255, 255, 255]);
}, |bytes: &[u8]| {
    let Some((length, bytes)) = bytes.split_first() else { return };
    let mut reader = FrameReader::new(LIMIT);
    let mut found = Vec::new();
    let mut pieces = bytes.chunks(usize::from(*length).max(1));
    let ended = loop {
        match reader.next_message() {
            Ok(Some(message)) => found.push(message.range(0..message.len()).collect::<Vec<_>>().concat()),
            Ok(None) => match pieces.next() {
                Some(piece) => reader.push(Bytes::copy_from_slice(piece)),
                None => break Ok(reader.has_begun()),
            },
            Err(error) => break Err(error),
        }
    };
    assert_eq!((found, ended), whole(bytes));
});

/// The same from all bytes at once: the messages, and whether a part of one is left.
fn whole(mut bytes: &[u8]) -> (Vec<Vec<u8>>, Result<bool, FrameError>) {
    let mut found = Vec::new();
    while let Some((prefix, rest)) = bytes.split_first_chunk::<5>() {
        let [compressed, length @ ..] = prefix;
        let length = u32::from_be_bytes(*length) as usize;
        if *compressed != 0 {
            return (found, Err(FrameError::Compressed));
        }
        if length > LIMIT {
            return (found, Err(FrameError::Long { length, limit: LIMIT }));
        }
        if rest.len() < length {
            return (found, Ok(true));
        }
        found.push(rest[..length].to_vec());
        bytes = &rest[length..];
    }
    (found, Ok(!bytes.is_empty()))
}
