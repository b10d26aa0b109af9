//! Messages are found in a stream of bytes however it is cut, and a prefix that is wrong ends it.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use bytes::Bytes;
use comic_proto::v1::UnrollAck;
use comic_proto::{FrameError, FrameReader, frame};
use proptest::prelude::*;

/// Bytes of the largest message.
const LIMIT: usize = 64;

/// All messages that are there.
fn messages(reader: &mut FrameReader) -> Result<Vec<Vec<u8>>, FrameError> {
    std::iter::from_fn(|| reader.next_message().transpose())
        .map(|message| message.map(|message| message.range(0..message.len()).collect::<Vec<_>>().concat()))
        .collect()
}

/// A prefix and a message.
fn framed(message: &[u8]) -> Vec<u8> {
    [&[0], &(message.len() as u32).to_be_bytes()[..], message].concat()
}

proptest! {
    #[test]
    fn messages_are_found_wherever_the_bytes_are_cut(
        sent in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..LIMIT), 0..8),
        size in 1usize..100,
    ) {
        let bytes: Vec<u8> = sent.iter().flat_map(|message| framed(message)).collect();
        let (mut reader, mut found) = (FrameReader::new(LIMIT), Vec::new());
        for piece in bytes.chunks(size) {
            reader.push(Bytes::copy_from_slice(piece));
            found.extend(messages(&mut reader).unwrap());
        }
        prop_assert_eq!(found, sent);
        prop_assert!(!reader.has_begun());
    }
}

#[test]
fn what_frame_encodes_is_read() {
    let ack = UnrollAck { sequence: 3, ..UnrollAck::default() };
    let mut reader = FrameReader::new(LIMIT);
    reader.push(frame(&ack));
    let read = messages(&mut reader).unwrap();
    assert_eq!(read.len(), 1);
    assert_eq!(prost::Message::decode(&read[0][..]), Ok(ack));
}

#[test]
fn a_part_of_a_message_waits_for_the_rest() {
    let bytes = framed(b"whole");
    let mut reader = FrameReader::new(LIMIT);
    assert!(!reader.has_begun());
    reader.push(Bytes::copy_from_slice(&bytes[..7]));
    assert_eq!(messages(&mut reader).unwrap(), [[0; 0]; 0]);
    assert!(reader.has_begun());
    assert_eq!(reader.length(), Some(5));
    reader.push(Bytes::copy_from_slice(&bytes[7..]));
    assert_eq!(messages(&mut reader).unwrap(), [b"whole"]);
    assert!(!reader.has_begun());
}

#[test]
fn a_compressed_and_a_long_message_are_refused_by_their_prefix() {
    let next = |prefix: [u8; 5]| {
        let mut reader = FrameReader::new(LIMIT);
        reader.push(Bytes::copy_from_slice(&prefix));
        messages(&mut reader)
    };
    assert_eq!(next([1, 0, 0, 0, 1]), Err(FrameError::Compressed));
    assert_eq!(next([0, 0, 0, 0, 65]), Err(FrameError::Long { length: 65, limit: LIMIT }));
    assert_eq!(next([0, 0, 0, 0, 64]), Ok(Vec::new()));
}
