//! Each limit refuses further peers with a reason, and does not disturb the others.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::io::ErrorKind;
use std::time::Duration;

use crate::support::{EPOCH, RUN, World, joining, within};
use comic_learner::publish::Publisher;
use comic_learner::security::{ConnectionLimits, Security};
use comic_learner::service::quarantine::QuarantineArguments;
use comic_learner::service::{Service, Setup};
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{EvaluationReport, StatusRequest, Verdict};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

const LIMIT: Duration = Duration::from_secs(10);

#[tokio::test]
async fn connections_from_one_address() {
    let world =
        World::limited(ConnectionLimits { max_connections_per_address: Some(2), ..ConnectionLimits::default() }).await;
    let (mut first, mut second) = (world.client().await, world.client().await);
    first.get_status(StatusRequest {}).await.unwrap();
    second.get_status(StatusRequest {}).await.unwrap();
    let third = async {
        let mut client = LearnerClient::connect(world.address.clone()).await?;
        anyhow::Ok(client.get_status(StatusRequest {}).await?)
    };
    assert!(within(LIMIT, third).await.is_err());
    first.get_status(StatusRequest {}).await.unwrap();
    drop(second);
    // The place is free when the server has noticed the end of the connection.
    let again = async {
        loop {
            if let Ok(mut client) = LearnerClient::connect(world.address.clone()).await
                && client.get_status(StatusRequest {}).await.is_ok()
            {
                break;
            }
            tokio::task::yield_now().await;
        }
    };
    within(LIMIT, again).await;
}

/// Such a connection would keep a place that others need.
#[tokio::test]
async fn connections_without_an_accepted_call() {
    let authentication_timeout = Duration::from_secs(3);
    let world = World::limited(ConnectionLimits { authentication_timeout, ..ConnectionLimits::default() }).await;
    let mut actor = world.actor(70).await;
    let address = world.address.trim_start_matches("http://");
    let falls_silent_after = async |word: &[u8]| {
        let mut silent = TcpStream::connect(address).await.unwrap();
        silent.write_all(word).await.unwrap();
        let mut said = Vec::new();
        // The learner sends its settings and then closes.
        let ended = within(LIMIT, silent.read_to_end(&mut said)).await;
        assert!(ended.is_ok() || ended.is_err_and(|error| error.kind() == ErrorKind::ConnectionReset));
    };
    let only_checks_the_health = async {
        let mut health = HealthClient::new(world.channel().await);
        while health.check(HealthCheckRequest::default()).await.is_ok() {}
    };
    tokio::join!(
        falls_silent_after(b""),
        falls_silent_after(b"PRI * HTTP/2.0"),
        within(LIMIT, only_checks_the_health),
        within(LIMIT, pings_and_never_reads(address)),
    );
    actor.client.get_status(StatusRequest {}).await.expect("an older connection with an accepted call stays");
}

/// Sends HTTP/2 pings until the learner has no room for the answers, and goes on until it closes the connection.
async fn pings_and_never_reads(address: &str) {
    // A SETTINGS frame and a PING frame (RFC 9113, 6.5 and 6.7).
    let settings = [0, 0, 0, 4, 0, 0, 0, 0, 0];
    let ping = [0, 0, 8, 6, 0, 0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8];
    let mut peer = TcpStream::connect(address).await.unwrap();
    peer.write_all(&[b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", &settings[..]].concat()).await.unwrap();
    while peer.write_all(&ping.repeat(1000)).await.is_ok() {}
}

/// Otherwise a peer whose certificate is no longer accepted would stay connected for ever.
#[tokio::test]
async fn the_age_of_connections() {
    let max_connection_age = Duration::from_secs(4);
    let world = World::limited(ConnectionLimits { max_connection_age, ..ConnectionLimits::default() }).await;
    let mut actor = world.actor(70).await;
    let (mut watch, mut unrolls) = (actor.watch().await, actor.stream().await);
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    // A stream ends with the reason, so that no unroll is sent in vain.
    for ended in [within(LIMIT, watch.message()).await.map(drop), within(LIMIT, unrolls.acks.message()).await.map(drop)]
    {
        let ended = ended.unwrap_err();
        assert_eq!(ended.code(), Code::Unavailable, "the actor connects again");
        assert!(ended.message().contains("--max-connection-age"), "{ended}");
    }
    assert_eq!(actor.client.get_status(StatusRequest {}).await.unwrap_err().code(), Code::Unavailable);
    let mut again = world.actor(70).await;
    assert_eq!(again.stream().await.verdict(again.unroll(1)).await, Verdict::Taken);
}

#[tokio::test]
async fn actors() {
    let world = World::limited(ConnectionLimits { max_actors: 1, ..ConnectionLimits::default() }).await;
    let mut first = world.actor(70).await;
    let mut client = world.client().await;
    let refused = client.join(joining(71)).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted, "an actor tries again");
    assert!(refused.message().contains("--max-actors"), "{refused}");
    first.client.join(joining(70)).await.expect("a present actor may join again");
    assert_eq!(world.batcher.snapshot().accounts.len(), 1, "no account was opened for the refused actor");
}

#[tokio::test]
async fn calls_in_flight() {
    let world = World::limited(ConnectionLimits { max_requests: 2, ..ConnectionLimits::default() }).await;
    let mut actor = world.actor(70).await;
    let streams = (actor.watch().await, actor.watch().await);
    let mut client = actor.client;
    let refused = client.get_status(StatusRequest {}).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted);
    drop(streams);
    // The places are free when the server has noticed the end of the streams.
    within(LIMIT, async { while client.get_status(StatusRequest {}).await.is_err() {} }).await;
}

#[tokio::test]
async fn bytes_of_a_message() {
    let world =
        World::limited(ConnectionLimits { max_message_bytes: Some(64 * 1024), ..ConnectionLimits::default() }).await;
    let mut client = world.client().await;
    let report = |bytes| EvaluationReport {
        run: Some(RUN),
        learner_epoch: EPOCH,
        json: format!("\"{}\"", "x".repeat(bytes)),
        ..EvaluationReport::default()
    };
    client.report_evaluation(report(60 * 1024)).await.unwrap();
    assert_eq!(client.report_evaluation(report(64 * 1024)).await.unwrap_err().code(), Code::OutOfRange);
}

#[tokio::test]
async fn a_limit_that_is_too_small_for_an_unroll_is_a_wrong_configuration() {
    let world = World::start().await;
    for (limits, option) in [
        (ConnectionLimits { max_message_bytes: Some(10), ..ConnectionLimits::default() }, "--max-message-bytes"),
        (ConnectionLimits { max_ingest_bytes: 10, ..ConnectionLimits::default() }, "--max-ingest-bytes"),
    ] {
        let setup = Setup {
            run: "runs/test".into(),
            id: 1,
            security: Security::default(),
            limits,
            experiment: world.experiment.clone(),
            spec: world.spec.clone(),
            assets: Vec::new(),
            batcher: world.batcher.clone(),
            publisher: Publisher::new(EPOCH),
            quarantine: QuarantineArguments::default(),
            placement: None,
        };
        let refused = Service::new(setup).unwrap_err();
        assert!(refused.exit_code() == 2 && refused.to_string().contains(option), "{refused}");
    }
}
