//! An unroll does not depend on how HTTP/2 cuts its bytes into frames. Bytes that are no unroll end only their own stream.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use bytes::{Buf as _, Bytes};
use comic_proto::v1::{UnrollAck, Verdict};
use comic_proto::{Field, frame};
use comic_replay::Next;
use futures::stream;
use http_body_util::BodyExt as _;
use tonic::{Code, Status};
use tonic_prost::prost::Message as _;

use crate::support::{World, within};

/// Sends these frames, and returns the acknowledgements and the final status.
async fn send(world: &World, frames: Vec<Bytes>) -> (Vec<UnrollAck>, Code) {
    let answer = within(Duration::from_secs(10), async {
        world.send_frames(stream::iter(frames)).await.into_body().collect().await.unwrap()
    })
    .await;
    let status = answer.trailers().cloned().unwrap_or_default();
    let (mut bytes, mut acks) = (answer.to_bytes(), Vec::new());
    while bytes.has_remaining() {
        assert_eq!(bytes.get_u8(), 0, "compressed");
        let length = bytes.get_u32() as usize;
        acks.push(UnrollAck::decode(bytes.split_to(length)).unwrap());
    }
    (acks, Status::from_header_map(&status).expect("a status").code())
}

/// Cuts bytes into frames of so many bytes, and the rest into one: h2 ends a connection on which thousands of unread frames
/// have one byte each.
fn cut(bytes: &[u8], length: usize) -> Vec<Bytes> {
    let (begin, rest) = bytes.split_at(bytes.len().min(length.saturating_mul(250)));
    begin.chunks(length).chain([rest]).filter(|frame| !frame.is_empty()).map(Bytes::copy_from_slice).collect()
}

#[tokio::test]
async fn unrolls_are_taken_from_frames_of_any_size() {
    for length in [1, 3, 100, usize::MAX] {
        let world = World::start().await;
        let actor = world.actor(70).await;
        let both = [frame(&actor.unroll(0)), frame(&actor.unroll(1))].concat();
        let (acks, status) = send(&world, cut(&both, length.min(both.len()))).await;
        let found: Vec<_> = acks.iter().map(|ack| (ack.sequence, ack.verdict())).collect();
        assert_eq!((found, status), (vec![(0, Verdict::Taken), (1, Verdict::Taken)], Code::Ok), "frames of {length}");
        let Next::Batch(batch) = world.batcher.next_batch_within(Duration::ZERO) else { panic!("two unrolls fill it") };
        let rewards: Vec<f32> = [0u64, 1].map(|sequence| [sequence as f32; 8]).concat();
        assert_eq!(batch.f32(Field::Reward), rewards, "frames of {length}");
    }
}

#[tokio::test]
async fn a_message_without_its_end_is_refused() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let (first, second) = (frame(&actor.unroll(0)), frame(&actor.unroll(1)));
    for half in [2, second.len() / 2, second.len() - 1] {
        let (acks, status) = send(&world, vec![first.clone(), second.slice(..half)]).await;
        assert_eq!((acks.len(), status), (1, Code::Internal), "the first {half} bytes");
    }
    let accounting = actor.accounting().await;
    assert_eq!((accounting.in_flight, accounting.duplicates, accounting.unattributed), (1, 2, 3));
}

#[tokio::test]
async fn compressed_and_malformed_messages_are_refused_with_a_status() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut compressed = frame(&actor.unroll(0)).to_vec();
    compressed[0] = 1;
    assert_eq!(send(&world, vec![compressed.into()]).await, (vec![], Code::Internal));
    let nonsense = Bytes::from_static(b"\x00\x00\x00\x00\x02\x0b\x0b");
    assert_eq!(send(&world, vec![nonsense]).await, (vec![], Code::Internal));
    let endless = Bytes::from_static(b"\x00\xff\xff\xff\xff");
    assert_eq!(send(&world, vec![endless]).await, (vec![], Code::OutOfRange));
    assert_eq!(actor.accounting().await.unattributed, 3);
}
