//! Parameters: always the newest version, in pieces, and the versions in between are skipped.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::pin::pin;
use std::time::Duration;

use crate::support::{EPOCH, World, parameters, within};
use comic_learner::publish::{Holding, Publisher};
use comic_proto::v1::{Behaviour, ParametersChunk};
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
    let mut actor = world.actor(70).await;
    let mut early = actor.watch().await;
    for number in 1..4 {
        world.publisher.publish(number, Behaviour::Policy, &parameters(number, MEGABYTE + 1));
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
    // Far more than windows and buffers hold, so the reader is still in the first one when the others come.
    world.publisher.publish(1, Behaviour::Policy, &parameters(1, 16 * MEGABYTE));
    let begun = slow.message().await.unwrap().unwrap();
    assert_eq!((begun.version, begun.offset), (1, 0));
    for number in 2..5 {
        world.publisher.publish(number, Behaviour::Policy, &parameters(number, 100));
    }
    let mut pieces = vec![begun];
    while pieces.last().unwrap().version == 1 {
        pieces.push(within(Duration::from_secs(10), slow.message()).await.unwrap().unwrap());
    }
    let last = pieces.pop().unwrap();
    assert_eq!(pieces.iter().map(|piece| piece.data.len()).sum::<usize>(), 16 * MEGABYTE, "what was begun is finished");
    assert_eq!(last.version, 4);
}

/// Of so many versions at once, without patience for those who stall.
fn impatient(versions: usize) -> Publisher {
    Publisher::holding(EPOCH, Holding { versions, idle: Duration::ZERO, longest: Duration::MAX })
}

#[tokio::test]
async fn who_reads_on_finishes_what_it_began_however_many_versions_come() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(1, Behaviour::Policy, &parameters(1, MEGABYTE));
    let pieces = publisher.newest().unwrap().frames().len() as u64;
    let mut slow = publisher.subscribe();
    for number in 2..=pieces {
        assert_eq!(slow.next().await.unwrap().version, 1);
        publisher.publish(number, Behaviour::Policy, &parameters(number, MEGABYTE));
        // Others begin each of them, and some never end.
        let mut other = publisher.subscribe();
        other.next().await.unwrap();
        std::mem::forget(other);
    }
    assert_eq!(slow.next().await.unwrap().version, 1, "the last of its pieces");
    assert!(slow.next().await.unwrap().version > 1);
}

#[tokio::test]
async fn a_reader_that_stalled_starts_over_with_the_newest_when_its_place_was_needed() {
    let publisher = impatient(1);
    publisher.publish(1, Behaviour::Policy, &parameters(1, MEGABYTE));
    let mut stalled = publisher.subscribe();
    assert_eq!(stalled.next().await.unwrap().version, 1);
    publisher.publish(2, Behaviour::Policy, &parameters(2, MEGABYTE));
    assert_eq!(publisher.subscribe().next().await.unwrap().version, 2);
    publisher.publish(3, Behaviour::Policy, &parameters(3, MEGABYTE));
    let newest = publisher.subscribe().next().await;
    assert_eq!(newest.as_ref().unwrap().version, 3);
    assert_eq!(stalled.next().await, newest);
}

#[tokio::test]
async fn without_room_a_reader_begins_the_newest_that_others_read_and_else_waits_for_a_place() {
    let patient = Holding { versions: 1, idle: Duration::from_secs(3600), longest: Duration::from_secs(3600) };
    let publisher = Publisher::holding(EPOCH, patient);
    publisher.publish(1, Behaviour::Policy, &parameters(1, MEGABYTE));
    let mut first = publisher.subscribe();
    assert_eq!(first.next().await.unwrap().version, 1);
    let pieces = publisher.newest().unwrap().frames().len();
    publisher.publish(2, Behaviour::Policy, &parameters(2, 1));
    publisher.publish(3, Behaviour::Policy, &parameters(3, MEGABYTE));
    let mut second = publisher.subscribe();
    for _ in 0..pieces {
        assert_eq!(second.next().await.unwrap().version, 1);
    }
    {
        let mut waiting = pin!(second.next());
        assert!(futures::poll!(&mut waiting).is_pending(), "version 1 is all that is held, and it has had that");
        drop(first);
        assert_eq!(within(Duration::from_secs(10), waiting).await.unwrap().version, 3);
    }
}

#[tokio::test]
async fn versions_in_memory_are_bounded_whoever_stalls() {
    let publisher = impatient(4);
    let mut stalled = Vec::new();
    for number in 1..100 {
        publisher.publish(number, Behaviour::Policy, &parameters(number, MEGABYTE));
        let mut reader = publisher.subscribe();
        assert_eq!(reader.next().await.unwrap().version, number);
        stalled.push(reader);
        assert!(publisher.held() <= 4);
    }
    drop(stalled);
    assert_eq!(publisher.held(), 0, "what nobody reads is not held");
}

#[tokio::test]
async fn readers_share_what_was_encoded_once() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(1, Behaviour::Policy, &parameters(1, MEGABYTE));
    let pieces = [publisher.subscribe().next().await.unwrap(), publisher.subscribe().next().await.unwrap()];
    assert_eq!(pieces[0].frame.as_ptr(), pieces[1].frame.as_ptr());
}

#[tokio::test]
async fn a_piece_on_its_way_keeps_no_other_alive() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(1, Behaviour::Policy, &parameters(1, MEGABYTE));
    let mut stalled = publisher.subscribe();
    let [held, next] = [stalled.next().await.unwrap().frame, stalled.next().await.unwrap().frame];
    drop(next);
    publisher.publish(2, Behaviour::Policy, &parameters(2, 1));
    drop(stalled);
    assert!(held.is_unique(), "its memory is no other piece's");
}

#[tokio::test]
async fn the_end_of_the_run_is_told_and_ends_the_stream() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut stream = actor.watch().await;
    world.publisher.publish(1, Behaviour::Demonstration, &parameters(1, 10));
    assert_eq!(stream.message().await.unwrap().unwrap().behaviour(), Behaviour::Demonstration);
    world.publisher.end_run();
    let farewell = within(Duration::from_secs(10), stream.message()).await.unwrap().unwrap();
    assert_eq!((farewell.run_over, farewell.total), (true, 0));
    assert!(within(Duration::from_secs(10), stream.message()).await.unwrap().is_none());
}

#[tokio::test]
async fn an_older_version_is_not_published() {
    let publisher = Publisher::new(EPOCH);
    publisher.publish(5, Behaviour::Policy, &parameters(5, 1));
    publisher.publish(4, Behaviour::Policy, &parameters(4, 1));
    assert_eq!(publisher.newest_version(), 5);
}
