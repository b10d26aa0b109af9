//! On the signal every stream ends by itself, and the server with them, within a second.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::{Duration, Instant};

use crate::support::{BATCH, World, joining, parameters, within};
use comic_proto::v1::{Behaviour, StatusRequest, Verdict};
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// A second on a machine that has nothing else to do.
const LIMIT: Duration = Duration::from_secs(10);

/// An actor that reads this comes back.
fn drains(status: Status) {
    assert_eq!(status.code(), Code::Unavailable);
    assert!(status.message().contains("draining: reconnect"), "{status}");
}

#[tokio::test]
async fn who_asks_while_the_learner_drains_is_told_to_come_back() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut health = HealthClient::new(world.channel().await);
    let mut watch = health.watch(HealthCheckRequest::default()).await.unwrap().into_inner();
    assert_eq!(watch.message().await.unwrap().unwrap().status(), ServingStatus::Serving);
    world.service.drain();
    drains(actor.client.join(joining(71)).await.unwrap_err());
    assert_eq!(within(LIMIT, watch.message()).await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert!(world.metrics_page().contains("comic_joins_total{result=\"draining\"} 1\n"));
    assert!(actor.client.get_status(StatusRequest {}).await.is_ok(), "the accounting can still be read");
    // The update that was under way was the last one: who was sent away may come and hear that.
    world.publisher.end_run();
    let mut late = world.actor(71).await;
    let mut watch = late.watch().await;
    assert!(within(LIMIT, watch.message()).await.unwrap().unwrap().run_over);
}

#[tokio::test]
async fn idle_streams_end_within_a_second_and_say_why() {
    let mut world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    let mut watch = actor.watch().await;
    world.begin_shutdown();
    drains(within(LIMIT, unrolls.acks.message()).await.unwrap_err());
    drains(within(LIMIT, watch.message()).await.unwrap_err());
    drop((actor, unrolls, watch));
    within(LIMIT, world.ended()).await.unwrap();
}

#[tokio::test]
async fn an_unroll_that_waits_for_a_slot_is_let_go_unanswered() {
    let mut world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    for sequence in 0..2 * BATCH as u64 {
        assert_eq!(unrolls.verdict(actor.unroll(sequence)).await, Verdict::Taken);
    }
    unrolls.sender.send(actor.unroll(2 * BATCH as u64)).await.unwrap();
    // A round trip on the same connection: by now the unroll has most likely arrived, and it waits.
    actor.accounting().await;
    world.begin_shutdown();
    drains(within(LIMIT, unrolls.acks.message()).await.unwrap_err());
    let accounting = world.batcher.accounting();
    assert_eq!((accounting.produced, accounting.in_flight), (4, 4));
}

#[tokio::test]
async fn a_closed_batcher_ends_the_streams_of_unrolls_too() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    world.batcher.close();
    unrolls.sender.send(actor.unroll(0)).await.unwrap();
    drains(within(LIMIT, unrolls.acks.message()).await.unwrap_err());
    assert!(actor.client.get_status(StatusRequest {}).await.is_ok(), "the accounting can still be read");
}

#[tokio::test]
async fn the_farewell_is_still_delivered() {
    let mut world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut watch = actor.watch().await;
    world.publisher.publish(1, Behaviour::Policy, &parameters(1, 10));
    assert_eq!(watch.message().await.unwrap().unwrap().behaviour(), Behaviour::Policy);
    world.publisher.end_run();
    world.begin_shutdown();
    let farewell = within(LIMIT, watch.message()).await.unwrap().unwrap();
    assert!(farewell.run_over);
    assert!(within(LIMIT, watch.message()).await.unwrap().is_none());
}

#[tokio::test]
async fn an_actor_that_does_not_read_cannot_hold_up_the_end() {
    let mut world = World::start().await;
    let mut actor = world.actor(70).await;
    world.publisher.publish(1, Behaviour::Policy, &parameters(1, 64 * 1024 * 1024));
    let unread = actor.watch().await;
    let begun = Instant::now();
    world.begin_shutdown();
    world.ended().await.unwrap();
    assert!(begun.elapsed() < LIMIT, "{:?}", begun.elapsed());
    drop(unread);
}
