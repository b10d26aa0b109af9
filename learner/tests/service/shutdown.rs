//! On the signal all streams and the server end within a second.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::{Duration, Instant};

use crate::support::{BATCH, World, joining, parameters, within};
use comic_proto::v1::{StatusRequest, Verdict};
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// One second on an idle machine; a busy one may take longer.
const LIMIT: Duration = Duration::from_secs(10);

/// Checks the status that makes an actor reconnect.
fn assert_draining(status: Status) {
    assert_eq!(status.code(), Code::Unavailable);
    assert!(status.message().contains("draining: reconnect"), "{status}");
}

#[tokio::test]
async fn an_actor_that_joins_while_the_learner_drains_is_told_to_reconnect() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut health = HealthClient::new(world.channel().await);
    let mut watch = health.watch(HealthCheckRequest::default()).await.unwrap().into_inner();
    assert_eq!(watch.message().await.unwrap().unwrap().status(), ServingStatus::Serving);
    world.service.drain();
    assert_draining(actor.client.join(joining(71)).await.unwrap_err());
    assert_eq!(within(LIMIT, watch.message()).await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert!(world.metrics_page().contains("comic_joins_total{result=\"draining\"} 1\n"));
    assert!(actor.client.get_status(StatusRequest {}).await.is_ok(), "the accounting can still be read");
    // The running update was the last one. A refused actor may join now, and is told that the run is over.
    world.publisher.end_run();
    let mut late = world.actor(71).await;
    let mut watch = late.watch().await;
    assert!(within(LIMIT, watch.message()).await.unwrap().unwrap().run_over);
}

#[tokio::test]
async fn idle_streams_end_within_a_second_with_the_reason() {
    let mut world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    let mut watch = actor.watch().await;
    world.begin_shutdown();
    assert_draining(within(LIMIT, unrolls.acks.message()).await.unwrap_err());
    assert_draining(within(LIMIT, watch.message()).await.unwrap_err());
    drop((actor, unrolls, watch));
    within(LIMIT, world.ended()).await.unwrap();
}

#[tokio::test]
async fn an_unroll_that_waits_for_a_place_is_not_answered() {
    let mut world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    for sequence in 0..2 * BATCH as u64 {
        assert_eq!(unrolls.verdict(actor.unroll(sequence)).await, Verdict::Taken);
    }
    unrolls.sender.send(actor.unroll(2 * BATCH as u64)).await.unwrap();
    // A round trip on the same connection, so that the unroll has most likely arrived and waits.
    actor.accounting().await;
    world.begin_shutdown();
    assert_draining(within(LIMIT, unrolls.acks.message()).await.unwrap_err());
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
    assert_draining(within(LIMIT, unrolls.acks.message()).await.unwrap_err());
    assert!(actor.client.get_status(StatusRequest {}).await.is_ok(), "the accounting can still be read");
}

#[tokio::test]
async fn the_end_of_the_run_is_delivered_while_the_server_closes() {
    let mut world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut watch = actor.watch().await;
    world.publisher.publish(1, &parameters(1, 10));
    assert_eq!(watch.message().await.unwrap().unwrap().version, 1);
    world.publisher.end_run();
    world.begin_shutdown();
    let last = within(LIMIT, watch.message()).await.unwrap().unwrap();
    assert!(last.run_over);
    assert!(within(LIMIT, watch.message()).await.unwrap().is_none());
}

#[tokio::test]
async fn an_actor_that_does_not_read_cannot_delay_the_end() {
    let mut world = World::start().await;
    let mut actor = world.actor(70).await;
    world.publisher.publish(1, &parameters(1, 64 * 1024 * 1024));
    let unread = actor.watch().await;
    let begun = Instant::now();
    world.begin_shutdown();
    world.ended().await.unwrap();
    assert!(begun.elapsed() < LIMIT, "{:?}", begun.elapsed());
    drop(unread);
}
