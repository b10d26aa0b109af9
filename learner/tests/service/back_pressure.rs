//! When the batches are full the learner stops reading: the actor's unrolls wait, its other calls do not, and nothing is lost.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use crate::support::{BATCH, World, within};
use comic_proto::v1::Verdict;
use comic_proto::v1::learner_client::LearnerClient;
use comic_replay::Next;
use futures::{StreamExt as _, stream};
use tonic::transport::Endpoint;

/// Places in batches when there is no trainer: those of the open batch and of the full one.
const SLOTS: usize = 2 * BATCH;
const UNROLLS: usize = 200;
/// Elements of proprioception that make an unroll of 100 KB.
const PROPRIOCEPTION: usize = 5000;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_actor_waits_while_the_batches_are_full_and_continues_afterwards() {
    let world = World::start_with(PROPRIOCEPTION, Vec::new()).await;
    let mut actor = world.actor(70).await;
    let unrolls: Vec<_> = (0..UNROLLS as u64).map(|sequence| actor.unroll(sequence)).collect();
    let size = unrolls[0].payload.len();
    let made = Arc::new(AtomicUsize::new(0));
    let counted = made.clone();
    let source = stream::iter(unrolls).inspect(move |_| {
        counted.fetch_add(1, Ordering::SeqCst);
    });
    let mut acks = actor.client.send_unrolls(source).await.unwrap().into_inner();
    for sequence in 0..SLOTS as u64 {
        let ack = within(Duration::from_secs(10), acks.message()).await.unwrap().unwrap();
        assert_eq!((ack.sequence, ack.verdict()), (sequence, Verdict::Taken));
    }

    // The unread stream does not delay other calls on its connection.
    for _ in 0..300 {
        let accounting = actor.accounting().await;
        assert_eq!((accounting.produced, accounting.in_flight), (SLOTS as u64, SLOTS as u64));
    }
    // Besides the taken unrolls: the stream's window, one decoded unroll, and the client's own send buffer of 1 MiB.
    let under_way = (256 * 1024 + 1024 * 1024) / size + 3;
    let made_now = made.load(Ordering::SeqCst);
    assert!(made_now <= SLOTS + under_way, "{made_now} unrolls of {size} bytes left the actor");

    let trainer = tokio::task::spawn_blocking({
        let batcher = world.batcher.clone();
        move || {
            for _ in 0..UNROLLS / BATCH {
                let Next::Batch(batch) = batcher.next_batch_within(Duration::from_secs(10)) else { panic!("no batch") };
                batcher.trained(batch);
            }
        }
    });
    for sequence in SLOTS as u64..UNROLLS as u64 {
        let ack = within(Duration::from_secs(10), acks.message()).await.unwrap().unwrap();
        assert_eq!((ack.sequence, ack.verdict()), (sequence, Verdict::Taken));
    }
    trainer.await.unwrap();
    assert!(acks.message().await.unwrap().is_none(), "the stream ends when the actor ends its own");
    let accounting = actor.accounting().await;
    assert_eq!((accounting.produced, accounting.trained, accounting.in_flight), (UNROLLS as u64, UNROLLS as u64, 0));
}

#[tokio::test]
async fn an_actor_that_dies_while_it_waits_takes_no_place_in_a_batch() {
    let world = World::start().await;
    let mut dying = world.actor(70).await;
    let mut unrolls = dying.stream().await;
    for sequence in 0..SLOTS as u64 {
        assert_eq!(unrolls.verdict(dying.unroll(sequence)).await, Verdict::Taken);
    }
    unrolls.sender.send(dying.unroll(SLOTS as u64)).await.unwrap();
    drop((dying, unrolls));

    let mut living = world.actor(71).await;
    let mut unrolls = living.stream().await;
    unrolls.sender.send(living.unroll(0)).await.unwrap();
    for _ in 0..2 {
        let Next::Batch(batch) = world.batcher.next_batch_within(Duration::from_secs(10)) else { panic!("no batch") };
        world.batcher.trained(batch);
    }
    let ack = within(Duration::from_secs(10), unrolls.acks.message()).await.unwrap().unwrap();
    assert_eq!(ack.verdict(), Verdict::Taken);
    let accounting = living.accounting().await;
    // The dead actor's last unroll may have arrived before the learner noticed the end of its connection.
    assert_eq!(accounting.produced, accounting.trained + accounting.in_flight);
    assert!((SLOTS as u64 + 1..=SLOTS as u64 + 2).contains(&accounting.produced));
}

#[tokio::test]
async fn an_actor_that_reads_no_acknowledgements_takes_no_place_in_a_batch() {
    let world = World::start().await;
    let silent = world.actor(70).await;
    // One byte is less than an acknowledgement.
    let endpoint = Endpoint::from_shared(world.address.clone()).unwrap().initial_stream_window_size(1);
    let mut client = LearnerClient::new(endpoint.connect().await.unwrap());
    let unrolls: Vec<_> = (0..100).map(|sequence| silent.unroll(sequence)).collect();
    let _unread = client.send_unrolls(stream::iter(unrolls)).await.unwrap();

    let mut other = world.actor(71).await;
    let unrolls: Vec<_> = (0..100).map(|sequence| other.unroll(sequence)).collect();
    let mut acks = other.client.send_unrolls(stream::iter(unrolls)).await.unwrap().into_inner();
    let trainer = tokio::task::spawn_blocking({
        let batcher = world.batcher.clone();
        move || {
            for _ in 0..20 {
                let Next::Batch(batch) = batcher.next_batch_within(Duration::from_secs(10)) else { panic!("no batch") };
                batcher.trained(batch);
            }
        }
    });
    for _ in 0..20 {
        let ack = within(Duration::from_secs(10), acks.message()).await.unwrap().unwrap();
        assert_eq!(ack.verdict(), Verdict::Taken);
    }
    trainer.await.unwrap();
}
