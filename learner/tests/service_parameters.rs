//! Parameters: always the newest version, in pieces, and the versions in between are skipped.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod service_support;

use std::time::Duration;

use comic_learner::publish::Publisher;
use comic_proto::v1::{Behaviour, ParametersChunk, WatchRequest};
use service_support::{EPOCH, World, parameters, within};
use tonic::Streaming;

const MEGABYTE: usize = 1024 * 1024;

/// Reads one whole version.
async fn version(stream: &mut Streaming<ParametersChunk>) -> (u64, Vec<u8>) {
    let (mut number, mut payload) = (0, Vec::new());
    loop {
        let chunk = within(Duration::from_secs(10), stream.message()).await.unwrap().expect("a piece");
        if chunk.offset == 0 {
            (number, payload) = (chunk.version, Vec::new());
        }
        assert_eq!((chunk.learner_epoch, chunk.version, chunk.offset), (EPOCH, number, payload.len() as u64));
        payload.extend(&chunk.data);
        if payload.len() as u64 == chunk.total {
            return (number, payload);
        }
    }
}

#[tokio::test]
async fn each_version_arrives_whole_and_an_actor_that_comes_late_gets_the_newest() {
    let world = World::start().await;
    let mut client = world.client().await;
    let mut early = client.watch_parameters(WatchRequest::default()).await.unwrap().into_inner();
    for number in 1..4 {
        world.publisher.publish(number, Behaviour::Policy, parameters(number, MEGABYTE + 1));
        assert_eq!(version(&mut early).await, (number, vec![number as u8; MEGABYTE + 1]));
    }
    let mut late = client.watch_parameters(WatchRequest::default()).await.unwrap().into_inner();
    assert_eq!(version(&mut late).await.0, 3);
}

#[tokio::test]
async fn a_slow_reader_skips_the_versions_in_between() {
    let world = World::start().await;
    let mut client = world.client().await;
    let mut slow = client.watch_parameters(WatchRequest::default()).await.unwrap().into_inner();
    // Far more than windows and buffers hold, so the reader is still in the first one when the others come.
    world.publisher.publish(1, Behaviour::Policy, parameters(1, 16 * MEGABYTE));
    let begun = slow.message().await.unwrap().unwrap();
    assert_eq!((begun.version, begun.offset), (1, 0));
    for number in 2..5 {
        world.publisher.publish(number, Behaviour::Policy, parameters(number, 100));
    }
    let mut pieces = vec![begun];
    while pieces.last().unwrap().version == 1 {
        pieces.push(within(Duration::from_secs(10), slow.message()).await.unwrap().unwrap());
    }
    let last = pieces.pop().unwrap();
    assert_eq!(pieces.iter().map(|piece| piece.data.len()).sum::<usize>(), 16 * MEGABYTE, "what was begun is finished");
    assert_eq!(last.version, 4);
}

#[tokio::test]
async fn a_reader_too_far_behind_starts_over_with_the_newest() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(1, Behaviour::Policy, parameters(1, MEGABYTE));
    let mut stalled = publisher.subscribe();
    assert_eq!(stalled.next().await.unwrap().version, 1);
    for number in 2..30 {
        publisher.publish(number, Behaviour::Policy, parameters(number, MEGABYTE));
    }
    let piece = stalled.next().await.unwrap();
    assert_eq!((piece.version, piece.offset), (29, 0));
}

#[tokio::test]
async fn readers_share_one_copy() {
    let publisher = Publisher::new(EPOCH);
    let payload = parameters(1, MEGABYTE);
    publisher.publish(1, Behaviour::Policy, payload.clone());
    let pieces = [publisher.subscribe().next().await.unwrap(), publisher.subscribe().next().await.unwrap()];
    assert!(pieces.iter().all(|piece| piece.data.as_ptr() == payload.as_ptr()));
}

#[tokio::test]
async fn the_end_of_the_run_is_told_and_ends_the_stream() {
    let world = World::start().await;
    let mut client = world.client().await;
    let mut stream = client.watch_parameters(WatchRequest::default()).await.unwrap().into_inner();
    world.publisher.publish(1, Behaviour::Demonstrate, parameters(1, 10));
    assert_eq!(stream.message().await.unwrap().unwrap().behaviour(), Behaviour::Demonstrate);
    world.publisher.publish(1, Behaviour::Leave, parameters(1, 0));
    let farewell = within(Duration::from_secs(10), stream.message()).await.unwrap().unwrap();
    assert_eq!((farewell.behaviour(), farewell.total), (Behaviour::Leave, 0));
    assert!(within(Duration::from_secs(10), stream.message()).await.unwrap().is_none());
}

#[tokio::test]
async fn an_older_version_is_not_published() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(5, Behaviour::Policy, parameters(5, 1));
    publisher.publish(4, Behaviour::Policy, parameters(4, 1));
    assert_eq!(publisher.newest_version(), 5);
}
