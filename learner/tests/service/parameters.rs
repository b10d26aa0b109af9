//! Parameters: readers get the newest version in pieces, and skip the versions in between.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::pin::pin;
use std::time::Duration;

use crate::support::{EPOCH, World, parameters, within};
use comic_learner::publish::{Holding, Publisher};
use comic_proto::v1::ParametersChunk;
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
async fn each_version_arrives_whole_and_a_late_reader_gets_the_newest() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut early = actor.watch().await;
    for number in 1..4 {
        world.publisher.publish(number, &parameters(number, MEGABYTE + 1));
        assert_eq!(version(&mut early).await, (number, vec![number as u8; MEGABYTE + 1]));
    }
    let mut late = actor.watch().await;
    assert_eq!(version(&mut late).await.0, 3);
}

#[tokio::test]
async fn a_slow_reader_skips_the_versions_in_between() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut slow = actor.watch().await;
    // Far more than windows and buffers hold, so the reader still reads the first version when the others are published.
    world.publisher.publish(1, &parameters(1, 16 * MEGABYTE));
    let begun = slow.message().await.unwrap().unwrap();
    assert_eq!((begun.version, begun.offset), (1, 0));
    for number in 2..5 {
        world.publisher.publish(number, &parameters(number, 100));
    }
    let mut pieces = vec![begun];
    while pieces.last().unwrap().version == 1 {
        pieces.push(within(Duration::from_secs(10), slow.message()).await.unwrap().unwrap());
    }
    let last = pieces.pop().unwrap();
    assert_eq!(
        pieces.iter().map(|piece| piece.data.len()).sum::<usize>(),
        16 * MEGABYTE,
        "the reader finishes the version that it began"
    );
    assert_eq!(last.version, 4);
}

/// A publisher that holds so many versions, and replaces those of stalled readers at once.
fn impatient(versions: usize) -> Publisher {
    Publisher::holding(EPOCH, Holding { versions, idle: Duration::ZERO, longest: Duration::MAX })
}

#[tokio::test]
async fn a_slow_reader_finishes_its_version_while_many_others_are_published() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(1, &parameters(1, MEGABYTE));
    let pieces = publisher.newest().unwrap().frames().len() as u64;
    let mut slow = publisher.subscribe();
    for number in 2..=pieces {
        assert_eq!(slow.next().await.unwrap().version, 1);
        publisher.publish(number, &parameters(number, MEGABYTE));
        // Other readers begin each version, and some never finish.
        let mut other = publisher.subscribe();
        other.next().await.unwrap();
        std::mem::forget(other);
    }
    assert_eq!(slow.next().await.unwrap().version, 1, "the last piece of its version");
    assert!(slow.next().await.unwrap().version > 1);
}

#[tokio::test]
async fn a_stalled_reader_starts_again_with_the_newest_version_after_its_own_was_replaced() {
    let publisher = impatient(1);
    publisher.publish(1, &parameters(1, MEGABYTE));
    let mut stalled = publisher.subscribe();
    assert_eq!(stalled.next().await.unwrap().version, 1);
    publisher.publish(2, &parameters(2, MEGABYTE));
    assert_eq!(publisher.subscribe().next().await.unwrap().version, 2);
    publisher.publish(3, &parameters(3, MEGABYTE));
    let newest = publisher.subscribe().next().await;
    assert_eq!(newest.as_ref().unwrap().version, 3);
    assert_eq!(stalled.next().await, newest);
}

#[tokio::test]
async fn when_no_version_can_be_added_a_reader_begins_the_newest_held_one_or_waits() {
    let patient = Holding { versions: 1, idle: Duration::from_secs(3600), longest: Duration::from_secs(3600) };
    let publisher = Publisher::holding(EPOCH, patient);
    publisher.publish(1, &parameters(1, MEGABYTE));
    let mut first = publisher.subscribe();
    assert_eq!(first.next().await.unwrap().version, 1);
    let pieces = publisher.newest().unwrap().frames().len();
    publisher.publish(2, &parameters(2, 1));
    publisher.publish(3, &parameters(3, MEGABYTE));
    let mut second = publisher.subscribe();
    for _ in 0..pieces {
        assert_eq!(second.next().await.unwrap().version, 1);
    }
    {
        let mut waiting = pin!(second.next());
        assert!(futures::poll!(&mut waiting).is_pending(), "only version 1 is held, and the reader has read it");
        drop(first);
        assert_eq!(within(Duration::from_secs(10), waiting).await.unwrap().version, 3);
    }
}

#[tokio::test]
async fn the_versions_in_memory_are_bounded_while_readers_stall() {
    let publisher = impatient(4);
    let mut stalled = Vec::new();
    for number in 1..100 {
        publisher.publish(number, &parameters(number, MEGABYTE));
        let mut reader = publisher.subscribe();
        assert_eq!(reader.next().await.unwrap().version, number);
        stalled.push(reader);
        assert!(publisher.held() <= 4);
    }
    drop(stalled);
    assert_eq!(publisher.held(), 0, "a version without readers is not held");
}

#[tokio::test]
async fn readers_share_one_encoded_copy() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(1, &parameters(1, MEGABYTE));
    let pieces = [publisher.subscribe().next().await.unwrap(), publisher.subscribe().next().await.unwrap()];
    assert_eq!(pieces[0].frame.as_ptr(), pieces[1].frame.as_ptr());
}

#[tokio::test]
async fn a_piece_that_is_being_sent_keeps_no_other_piece_in_memory() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(1, &parameters(1, MEGABYTE));
    let mut stalled = publisher.subscribe();
    let [held, next] = [stalled.next().await.unwrap().frame, stalled.next().await.unwrap().frame];
    drop(next);
    publisher.publish(2, &parameters(2, 1));
    drop(stalled);
    assert!(held.is_unique(), "the piece shares its memory with no other");
}

#[tokio::test]
async fn the_end_of_the_run_is_sent_and_ends_the_stream() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut stream = actor.watch().await;
    world.publisher.publish(1, &parameters(1, 10));
    assert!(!stream.message().await.unwrap().unwrap().run_over);
    world.publisher.end_run();
    let last = within(Duration::from_secs(10), stream.message()).await.unwrap().unwrap();
    assert_eq!((last.run_over, last.total), (true, 0));
    assert!(within(Duration::from_secs(10), stream.message()).await.unwrap().is_none());
}

#[tokio::test]
async fn an_older_version_is_not_published() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(5, &parameters(5, 1));
    publisher.publish(4, &parameters(4, 1));
    assert_eq!(publisher.newest_version(), 5);
}
