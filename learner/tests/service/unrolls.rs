//! Every unroll is answered: it is taken, or refused with a reason that is counted.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use crate::support::{BATCH, EPOCH, World, within};
use bytes::Bytes;
use comic_learner::service::quarantine::QuarantineArguments;
use comic_proto::v1::{UnrollMessage, Verdict};
use comic_proto::{Field, UnrollBuffer};
use comic_replay::{Next, Phase};
use tonic::Code;

#[tokio::test]
async fn an_unroll_is_taken_acknowledged_and_given_to_the_trainer() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    for sequence in 0..BATCH as u64 {
        let ack = unrolls.send(actor.unroll(sequence)).await.unwrap();
        assert_eq!((ack.sequence, ack.verdict(), ack.detail.as_str()), (sequence, Verdict::Taken, ""));
    }
    let Next::Batch(batch) = world.batcher.next_batch_within(Duration::ZERO) else { panic!("no batch") };
    let rewards = batch.f32(Field::Reward);
    assert_eq!(rewards, [[0.0; 8], [1.0; 8]].concat());
    assert_eq!(actor.accounting().await.in_flight, 2);
    world.batcher.trained(batch);
    let accounting = actor.accounting().await;
    assert_eq!((accounting.produced, accounting.trained, accounting.in_flight), (2, 2, 0));
}

#[tokio::test]
async fn an_invalid_unroll_is_refused_with_the_field_and_the_next_one_is_taken() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    let mut broken = UnrollBuffer::from_payload(&actor.layout, &actor.unroll(0).payload).unwrap();
    broken.row_mut(Field::Task, 2)[1] = f32::NAN;
    let message = UnrollMessage { payload: broken.into_bytes(), ..actor.unroll(0) };
    let ack = unrolls.send(message).await.unwrap();
    assert_eq!((ack.sequence, ack.verdict()), (0, Verdict::Invalid));
    assert_eq!(ack.detail, "task[2] is not finite");

    let short = UnrollMessage { payload: Bytes::from_static(b"short"), ..actor.unroll(1) };
    assert_eq!(unrolls.verdict(short).await, Verdict::Invalid);
    let foreign = actor.unroll_with(2, |header| header.layout_hash = vec![0; 32]);
    assert_eq!(unrolls.verdict(foreign).await, Verdict::Invalid);
    let future = actor.unroll_with(3, |header| header.version = 1);
    assert_eq!(unrolls.verdict(future).await, Verdict::Invalid);
    assert_eq!(unrolls.verdict(actor.unroll(4)).await, Verdict::Taken);
    let accounting = actor.accounting().await;
    assert_eq!((accounting.produced, accounting.dropped_invalid, accounting.in_flight), (5, 4, 1));
}

#[tokio::test]
async fn only_invalid_unrolls_go_to_the_quarantine() {
    let directory = tempfile::tempdir().unwrap();
    let quarantine =
        QuarantineArguments { quarantine: Some(directory.path().to_path_buf()), quarantine_bytes: 1 << 20 };
    let world = World::quarantining(quarantine).await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    let short = UnrollMessage { payload: Bytes::from_static(b"short"), ..actor.unroll(1) };
    assert_eq!(unrolls.verdict(short.clone()).await, Verdict::Invalid);
    assert_eq!(unrolls.verdict(short).await, Verdict::Duplicate);
    let kept = "comic_quarantined_total{result=\"kept\"} 1\n";
    within(Duration::from_secs(10), async {
        while !world.metrics_page().contains(kept) {
            tokio::task::yield_now().await;
        }
    })
    .await;
    let files: Vec<_> = std::fs::read_dir(directory.path()).unwrap().map(|file| file.unwrap().file_name()).collect();
    assert_eq!(files, [format!("{EPOCH}-{}-1.unroll", actor.reply.actor).as_str()]);
}

#[tokio::test]
async fn an_unroll_without_a_header_is_refused_and_counts_for_no_actor() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    let ack = unrolls.send(UnrollMessage { header: None, payload: Bytes::new() }).await.unwrap();
    assert_eq!((ack.verdict(), ack.detail.as_str()), (Verdict::Invalid, "unroll has no header"));
    let accounting = actor.accounting().await;
    assert_eq!((accounting.produced, accounting.unattributed), (0, 1));
}

#[tokio::test]
async fn an_unroll_that_is_sent_again_after_a_reconnect_is_taken_once() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut first = actor.stream().await;
    assert_eq!(first.verdict(actor.unroll(0)).await, Verdict::Taken);
    drop(first);
    let mut second = actor.stream().await;
    assert_eq!(second.verdict(actor.unroll(0)).await, Verdict::Duplicate);
    assert_eq!(second.verdict(actor.unroll(1)).await, Verdict::Taken);
    let accounting = actor.accounting().await;
    assert_eq!((accounting.produced, accounting.in_flight, accounting.duplicates), (2, 2, 1));
}

#[tokio::test]
async fn old_unrolls_are_stale_and_those_of_another_epoch_or_phase_superseded() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    world.batcher.set_phase(Phase { epoch: EPOCH, version: 6, oldest: 0 });
    let ack = unrolls.send(actor.unroll(0)).await.unwrap();
    assert_eq!((ack.verdict(), ack.detail.as_str()), (Verdict::Stale, "version 0 is too old, the newest is 6"));

    let earlier = actor.unroll_with(1, |header| {
        (header.learner_epoch, header.version, header.layout_hash) = (EPOCH - 1, 99, vec![1; 32]);
    });
    let ack = unrolls.send(earlier).await.unwrap();
    assert_eq!((ack.verdict(), ack.detail.as_str()), (Verdict::Rejoin, "made in learner epoch 2, this is 3"));

    world.batcher.set_phase(Phase { epoch: EPOCH, version: 6, oldest: 6 });
    let ack = unrolls.send(actor.unroll(2)).await.unwrap();
    let detail = "version 0 is of an earlier phase, which ended before version 6";
    assert_eq!((ack.verdict(), ack.detail.as_str()), (Verdict::Superseded, detail));
    let accounting = actor.accounting().await;
    assert_eq!((accounting.dropped_stale, accounting.dropped_superseded, accounting.in_flight), (1, 2, 0));
}

#[tokio::test]
async fn an_actor_that_has_not_joined_is_told_to_join() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    let refused = unrolls.send(actor.unroll_with(0, |header| header.incarnation = 71)).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().ends_with("join first"), "{}", refused.message());
    assert_eq!(actor.accounting().await.unattributed, 1);
}

#[tokio::test]
async fn a_message_that_is_too_large_ends_the_stream_before_it_is_read() {
    let world = World::start().await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    let huge = UnrollMessage { payload: Bytes::from(vec![0; 2 * 1024 * 1024]), ..actor.unroll(0) };
    let refused = unrolls.send(huge).await.unwrap_err();
    assert_eq!(refused.code(), Code::OutOfRange);
    let mut unrolls = actor.stream().await;
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    assert_eq!(actor.accounting().await.unattributed, 1);
}
