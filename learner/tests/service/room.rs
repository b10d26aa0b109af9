//! A message is read when there is room for it, and no stream keeps room that it does not use.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use bytes::Bytes;
use comic_learner::security::ConnectionLimits;
use comic_proto::frame;
use comic_proto::v1::{Queue, StatusRequest, Verdict};
use comic_replay::Next;
use futures::{StreamExt as _, stream};
use http_body_util::BodyExt as _;
use tokio::task::{JoinHandle, yield_now};
use tonic::{Code, Status};

use crate::support::{Actor, BATCH, World, within};

const MESSAGE: usize = 64 * 1024;
const LIMIT: Duration = Duration::from_secs(30);

/// A learner with room for one message.
async fn with_little_room() -> World {
    World::limited(ConnectionLimits {
        max_message_bytes: Some(MESSAGE),
        max_ingest_bytes: MESSAGE,
        ..ConnectionLimits::default()
    })
    .await
}

/// Sends these bytes and then nothing. Returns the status with which the stream ends.
async fn silent_after(world: &World, bytes: Bytes) -> JoinHandle<Code> {
    let response = world.send_frames(stream::iter([bytes]).chain(stream::pending())).await;
    tokio::spawn(async move {
        let answer = response.into_body().collect().await.unwrap();
        Status::from_header_map(answer.trailers().expect("trailers")).expect("a status").code()
    })
}

/// A metric.
fn read(world: &World, name: &str) -> u64 {
    let page = world.metrics_page();
    let line = page.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    line.expect("a metric of this name").parse().unwrap()
}

async fn status(actor: &mut Actor) -> Queue {
    actor.client.get_status(StatusRequest {}).await.unwrap().into_inner().queue.unwrap()
}

#[tokio::test]
async fn half_a_message_loses_its_room_after_ten_seconds() {
    let world = with_little_room().await;
    let half = {
        let stalled = world.actor(70).await;
        let whole = frame(&stalled.unroll(0));
        whole.slice(..whole.len() / 2)
    };
    let stalled = silent_after(&world, half).await;
    within(LIMIT, async {
        while read(&world, "comic_ingest_bytes") == 0 {
            yield_now().await
        }
    })
    .await;
    let mut other = world.actor(71).await;
    let mut unrolls = other.stream().await;
    unrolls.sender.send(other.unroll(0)).await.unwrap();
    // Enough calls for the learner to read the other unroll, if it were going to.
    for _ in 0..300 {
        assert_eq!(other.accounting().await.produced, 0, "there is no room for the other unroll");
    }
    assert_eq!(within(LIMIT, stalled).await.unwrap(), Code::DeadlineExceeded);
    let ack = within(LIMIT, unrolls.acks.message()).await.unwrap().unwrap();
    assert_eq!(ack.verdict(), Verdict::Taken);
    let accounting = other.accounting().await;
    assert_eq!(
        (accounting.produced, accounting.unattributed),
        (1, 0),
        "the late message is not counted: its actor sends it again"
    );
    assert_eq!(read(&world, "comic_unrolls_late_total"), 1);
}

#[tokio::test]
async fn a_silent_stream_keeps_no_room() {
    let world = with_little_room().await;
    let _silent = [world.actor(70).await.stream().await, world.actor(71).await.stream().await];
    let mut other = world.actor(72).await;
    let mut unrolls = other.stream().await;
    assert_eq!(unrolls.verdict(other.unroll(0)).await, Verdict::Taken);
}

#[tokio::test]
async fn an_unroll_that_waits_for_a_batch_keeps_others_unread_until_all_are_taken_in_turn() {
    let world = with_little_room().await;
    let mut filling = world.actor(70).await;
    let mut unrolls = filling.stream().await;
    for sequence in 0..2 * BATCH as u64 {
        assert_eq!(unrolls.verdict(filling.unroll(sequence)).await, Verdict::Taken);
    }
    let mut waiting = Vec::new();
    for incarnation in 71..75 {
        let mut actor = world.actor(incarnation).await;
        let unrolls = actor.stream().await;
        unrolls.sender.send(actor.unroll(0)).await.unwrap();
        waiting.push((actor, unrolls));
    }
    let waits = async { while status(&mut filling).await.waiting == 0 {} };
    within(LIMIT, waits).await;
    // Enough calls for the learner to read the other unrolls, if it were going to.
    for _ in 0..300 {
        assert_eq!(status(&mut filling).await.waiting, 1, "there is room for one message");
    }
    for _ in 0..3 {
        let batch = world.batcher.clone();
        let batch = tokio::task::spawn_blocking(move || batch.next_batch_within(LIMIT)).await.unwrap();
        let Next::Batch(batch) = batch else { panic!("no batch") };
        world.batcher.trained(batch);
    }
    for (_, unrolls) in &mut waiting {
        let ack = within(LIMIT, unrolls.acks.message()).await.unwrap().unwrap();
        assert_eq!(ack.verdict(), Verdict::Taken);
    }
    let accounting = filling.accounting().await;
    assert_eq!((accounting.produced, accounting.trained, accounting.in_flight), (8, 6, 2));
}
