//! Bytes in pieces have the same meaning as in one piece, for all positions of the cuts.

use bytes::{Buf, Bytes};
use comic_proto::v1::{EpisodeStatistics, UnrollHeader, UnrollMessage};
use comic_proto::{Pieces, ReceivedUnroll};
use proptest::prelude::*;
use prost::Message as _;

/// The bytes, cut into pieces of these lengths, which repeat. If `push` is true, the pieces are pushed one by one;
/// otherwise all are kept.
fn cut(bytes: &[u8], (lengths, push): &(Vec<usize>, bool)) -> Pieces {
    let (mut pieces, mut rest, mut lengths) = (Vec::new(), bytes, lengths.iter().cycle());
    while !rest.is_empty() {
        let length = lengths.next().map_or(rest.len(), |length| rest.len().min(*length));
        pieces.push(Bytes::copy_from_slice(&rest[..length]));
        rest = &rest[length..];
    }
    if !push {
        return pieces.into_iter().collect();
    }
    let mut pushed = Pieces::default();
    pieces.into_iter().for_each(|piece| pushed.push(piece));
    pushed
}

fn whole(mut pieces: Pieces) -> Vec<u8> {
    pieces.copy_to_bytes(pieces.len()).to_vec()
}

fn lengths() -> impl Strategy<Value = (Vec<usize>, bool)> {
    let lengths =
        prop::collection::vec(prop_oneof![1usize..8, 1usize..5000, Just(Pieces::KEPT), Just(Pieces::KEPT + 3)], 1..6);
    (lengths, any::<bool>())
}

/// Bytes that fit into small pieces, and longer ones.
fn bytes() -> impl Strategy<Value = Vec<u8>> {
    let length = prop_oneof![0usize..20_000, Pieces::KEPT..3 * Pieces::KEPT];
    (length, any::<u8>()).prop_map(|(length, salt)| (0..length).map(|i| (i % 251) as u8 ^ salt).collect())
}

fn header() -> impl Strategy<Value = Option<UnrollHeader>> {
    let numbers = (any::<u64>(), any::<u64>(), any::<u64>(), any::<u32>());
    let returns = prop::collection::vec(any::<f32>().prop_filter("compared", |value| !value.is_nan()), 0..6);
    prop::option::of((numbers, prop::collection::vec(returns, 0..4)).prop_map(|(numbers, returns)| {
        let (actor, incarnation, sequence, environment) = numbers;
        let episodes =
            returns.into_iter().map(|returns| EpisodeStatistics { returns, steps: 3, ..Default::default() }).collect();
        UnrollHeader {
            actor,
            incarnation,
            sequence,
            environment,
            episodes,
            layout_hash: vec![7; 32],
            ..UnrollHeader::default()
        }
    }))
}

#[test]
fn a_large_piece_between_small_ones_is_not_copied() {
    let large = Bytes::from(vec![1; Pieces::KEPT]);
    let mut pieces = Pieces::default();
    for length in (1..300).rev() {
        pieces.push(Bytes::from(vec![2; length]));
    }
    let before = pieces.len();
    pieces.push(large.clone());
    for _ in 0..10_000 {
        pieces.push(Bytes::from_static(b"3"));
    }
    let found: Vec<_> = pieces.range(0..pieces.len()).collect();
    let expected = [before, large.len(), 10_000];
    assert_eq!(found.iter().map(|piece| piece.len()).collect::<Vec<_>>(), expected);
    assert_eq!(found[1].as_ptr(), large.as_ptr(), "the large piece was copied");
}

#[test]
fn a_small_piece_does_not_keep_its_buffer() {
    let buffer = Bytes::from(vec![1; 4 * Pieces::KEPT]);
    let mut pieces = Pieces::default();
    pieces.push(buffer.slice(..Pieces::KEPT - 1));
    pieces.push(buffer.slice(Pieces::KEPT - 1..Pieces::KEPT));
    assert!(buffer.is_unique());
    pieces.push(buffer.slice(Pieces::KEPT..2 * Pieces::KEPT));
    assert!(!buffer.is_unique());
}

#[test]
fn fields_with_a_wrong_type_and_truncated_messages_are_refused() {
    for bytes in [
        &b"\x08\x01"[..],
        b"\x11",
        b"\x12\x05abcd",
        b"\x00",
        b"\x1b\x1c",
        b"\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff",
    ] {
        assert!(ReceivedUnroll::decode(cut(bytes, &(vec![1], false))).is_err(), "{bytes:?}");
        assert!(UnrollMessage::decode(bytes).is_err() || bytes == b"\x1b\x1c", "{bytes:?}");
    }
}

proptest! {
    #[test]
    fn an_unroll_in_pieces_equals_the_sent_one(
        header in header(),
        payload in bytes(),
        lengths in lengths(),
    ) {
        let message = UnrollMessage { header, payload: payload.clone().into() };
        let received = ReceivedUnroll::decode(cut(&message.encode_to_vec(), &lengths)).unwrap();
        prop_assert_eq!(received.header, message.header);
        prop_assert_eq!(whole(received.payload), payload);
    }

    #[test]
    fn random_bytes_are_decoded_like_by_the_generated_type(
        bytes in prop::collection::vec(prop_oneof![any::<u8>(), 0u8..32], 0..60),
        lengths in lengths(),
    ) {
        let theirs = UnrollMessage::decode(&bytes[..]);
        match ReceivedUnroll::decode(cut(&bytes, &lengths)) {
            Ok(ours) => {
                let theirs = theirs.unwrap();
                // NaN is not equal to itself, so the texts are compared.
                prop_assert_eq!(format!("{:?}", ours.header), format!("{:?}", theirs.header));
                prop_assert_eq!(whole(ours.payload), theirs.payload.to_vec());
            }
            // Only groups are accepted by the generated type and refused here. They are not used.
            Err(error) => prop_assert!(theirs.is_err() || error.to_string().contains("wire type"), "{}", error),
        }
    }

    #[test]
    fn pieces_are_split_copied_and_read_like_one_piece(
        bytes in bytes(),
        lengths in lengths(),
        (from, to) in (0usize..400_000, 0usize..400_000),
    ) {
        let mut pieces = cut(&bytes, &lengths);
        let within = from.min(bytes.len())..to.clamp(from.min(bytes.len()), bytes.len());
        let found: Vec<&[u8]> = pieces.range(from..to).collect();
        prop_assert_eq!(&found.concat(), &bytes[within.clone()]);
        let mut copy = vec![0; within.len()];
        pieces.copy_to(within.start, &mut copy);
        prop_assert_eq!(&copy, &bytes[within.clone()]);
        match pieces.split_to(from) {
            Some(front) => {
                prop_assert_eq!(whole(front), &bytes[..from]);
                prop_assert_eq!(whole(pieces), &bytes[from..]);
            }
            None => {
                prop_assert!(from > bytes.len());
                prop_assert_eq!(whole(pieces), bytes);
            }
        }
    }
}
