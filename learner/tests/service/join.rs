//! `Join` tells an actor everything that it needs, or refuses it with a reason.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use crate::support::{EPOCH, RUN, World, joining, parameters};
use comic_experiment::{Experiment, TaskSpec};
use comic_learner::publish::Publisher;
use comic_learner::security::{ConnectionLimits, Security};
use comic_learner::service::quarantine::QuarantineArguments;
use comic_learner::service::{Service, Setup};
use comic_proto::v1::{Environments, JoinRequest, StatusRequest, Verdict, WatchRequest};
use comic_proto::{PROTOCOL_VERSION, UnrollLayout, UnrollShape};
use tonic::Code;

#[tokio::test]
async fn the_reply_holds_experiment_task_layout_and_epoch() {
    let world = World::start().await;
    let reply = world.actor(70).await.reply;
    let experiment = Experiment::from_toml("the reply", &reply.experiment).unwrap();
    let spec: TaskSpec = toml::from_str(&reply.task_spec).unwrap();
    assert_eq!((&experiment, &spec), (&world.experiment, &world.spec));
    let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
    assert_eq!(reply.layout_hash, layout.hash());
    assert_eq!((reply.learner_epoch, reply.next_sequence), (EPOCH, 0));
}

#[tokio::test]
async fn a_new_process_gets_a_new_index_and_seed_and_a_reconnecting_one_keeps_its_own() {
    let world = World::start().await;
    let (one, mut other) = (world.actor(70).await, world.actor(71).await);
    assert_ne!(one.reply.actor, other.reply.actor);
    assert_ne!(one.reply.seed, other.reply.seed);
    let again = JoinRequest { actor: Some(one.reply.actor), ..joining(70) };
    let again = other.client.join(again).await.unwrap().into_inner();
    assert_eq!((again.actor, again.seed), (one.reply.actor, one.reply.seed));
}

#[tokio::test]
async fn the_seed_depends_on_experiment_and_index_and_not_on_the_process() {
    let (one, other) = (World::start().await, World::start().await);
    assert_eq!(one.actor(70).await.reply.seed, other.actor(71).await.reply.seed);
}

#[tokio::test]
async fn another_protocol_is_refused_with_the_remedy() {
    let world = World::start().await;
    for protocol in [PROTOCOL_VERSION - 1, PROTOCOL_VERSION + 1] {
        let refused = world.client().await.join(JoinRequest { protocol, ..joining(70) }).await.unwrap_err();
        assert_eq!(refused.code(), Code::FailedPrecondition);
        assert!(refused.message().contains("same release"), "{}", refused.message());
    }
}

#[tokio::test]
async fn unrolls_that_an_earlier_epoch_acknowledged_count_as_lost_when_their_actor_joins_again() {
    let world = World::start().await;
    let mut client = world.client().await;
    let reply = client.join(JoinRequest { acknowledged: 7, ..joining(70) }).await.unwrap().into_inner();
    assert_eq!(reply.next_sequence, 7);
    let again = client.join(JoinRequest { acknowledged: 5, ..joining(70) }).await.unwrap().into_inner();
    assert_eq!(again.next_sequence, 7, "no number is lost twice");
    let accounting = world.batcher.accounting();
    assert_eq!((accounting.produced, accounting.dropped.lost_at_restart), (7, 7));
    let impossible = client.join(JoinRequest { acknowledged: u64::MAX, ..joining(70) }).await.unwrap_err();
    assert_eq!(impossible.code(), Code::InvalidArgument);
    assert_eq!(world.batcher.accounting(), accounting);
}

#[tokio::test]
async fn an_actor_of_another_run_is_refused_without_counting_its_unrolls() {
    let world = World::start().await;
    let mut client = world.client().await;
    assert_eq!(client.join(joining(70)).await.unwrap().into_inner().run, RUN);
    let back = JoinRequest { actor: Some(0), acknowledged: 7, ..joining(71) };
    let refused = client.join(JoinRequest { run: Some(RUN + 1), ..back.clone() }).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition, "{refused}");
    assert_eq!(world.batcher.accounting().produced, 0);
    client.join(JoinRequest { run: Some(RUN), ..back }).await.unwrap();
    assert_eq!(world.batcher.accounting().dropped.lost_at_restart, 7);
}

#[tokio::test]
async fn parameters_are_for_actors_that_have_joined() {
    let world = World::start().await;
    let unknown = WatchRequest { incarnation: 71, ..WatchRequest::default() };
    let refused = world.client().await.watch_parameters(unknown).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition, "{refused}");
    world.publisher.publish(1, &parameters(1, 10));
    let mut watch = world.actor(70).await.watch().await;
    assert_eq!(watch.message().await.unwrap().unwrap().version, 1);
}

#[tokio::test]
async fn a_newer_process_of_a_name_takes_the_older_ones_place() {
    let world = World::start().await;
    let named = |incarnation| JoinRequest { name: "comic-actor-0".into(), ..joining(incarnation) };
    let mut older = world.named_actor(71, "comic-actor-0").await;
    let mut newer = world.named_actor(72, "comic-actor-0").await;
    let mut unrolls = older.stream().await;
    let refused = unrolls.send(older.unroll(0)).await.unwrap_err();
    assert_eq!(refused.code(), Code::Aborted);
    let refused = older.client.join(named(71)).await.unwrap_err();
    assert_eq!(refused.code(), Code::Aborted, "the older process ends: {refused}");
    assert!(refused.message().contains("newer process"), "{refused}");
    let watch = WatchRequest { incarnation: 71, ..WatchRequest::default() };
    let refused = older.client.watch_parameters(watch).await.unwrap_err();
    assert_eq!(refused.code(), Code::Aborted);
    let mut unrolls = newer.stream().await;
    assert_eq!(unrolls.verdict(newer.unroll(0)).await, Verdict::Taken);
    let accounting = newer.accounting().await;
    assert_eq!((accounting.produced, accounting.in_flight), (1, 1), "the refused unroll is not counted");
    let long = JoinRequest { name: "x".repeat(254), ..joining(73) };
    assert_eq!(newer.client.join(long).await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test]
async fn in_lockstep_actors_divide_the_environments_share_a_seed_and_further_actors_stand_by() {
    let world = World::in_lockstep(8).await;
    let mut client = world.client().await;
    let asking = |incarnation, threads, environments| JoinRequest { threads, environments, ..joining(incarnation) };
    let mut seeds = std::collections::HashSet::new();
    for (request, assigned) in [
        (asking(70, Some(2), Some(2)), (0, 4)),
        (asking(71, Some(1), Some(3)), (4, 3)),
        // The experiment's number is 16, but one environment is left.
        (asking(72, None, None), (7, 1)),
        (asking(71, Some(1), Some(3)), (4, 3)),
    ] {
        let reply = client.join(request).await.unwrap().into_inner();
        assert_eq!(reply.environments, Some(Environments { first: assigned.0, count: assigned.1 }));
        seeds.insert(reply.seed);
    }
    assert_eq!(seeds.len(), 1);
    let refused = client.join(joining(73)).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted, "an actor tries again: {refused}");
    assert_eq!(world.batcher.snapshot().accounts.len(), 3, "no account was opened for the actor that stands by");
    let actors = client.get_status(StatusRequest {}).await.unwrap().into_inner().actors.unwrap();
    assert_eq!(actors.alive, 3, "an actor that stands by does not count as alive");
}

#[tokio::test]
async fn in_lockstep_an_actor_of_an_earlier_epoch_must_start_again() {
    let world = World::in_lockstep(8).await;
    let refused = world.client().await.join(JoinRequest { actor: Some(0), ..joining(70) }).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains("began anew"), "{}", refused.message());
}

#[tokio::test]
async fn a_service_whose_parts_disagree_does_not_start() {
    let world = World::start().await;
    let setup = || Setup {
        id: RUN,
        run: "runs/test".into(),
        security: Security::default(),
        limits: ConnectionLimits::default(),
        experiment: world.experiment.clone(),
        spec: world.spec.clone(),
        assets: Vec::new(),
        batcher: world.batcher.clone(),
        publisher: world.publisher.clone(),
        quarantine: QuarantineArguments::default(),
        placement: None,
    };
    let (mut longer, mut later) = (setup(), setup());
    longer.experiment.unroll.length += 1;
    later.publisher = Publisher::new(EPOCH + 1);
    assert!(Service::new(longer).unwrap_err().to_string().contains("length: 5"));
    assert!(Service::new(later).unwrap_err().to_string().contains("epoch 3"));
    assert!(Service::new(setup()).is_ok());
}
