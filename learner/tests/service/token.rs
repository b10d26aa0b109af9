//! If the learner requires a token, it refuses every call without an accepted one.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;
use std::time::Duration;

use crate::support::{World, joining, parameters, within};
use comic_learner::security::{Security, Tokens};
use comic_proto::Access;
use comic_proto::v1::{JoinRequest, StatusRequest, WatchRequest};
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

async fn world(tokens: &Path) -> World {
    World::secured(Security { tls: None, tokens: Tokens::new(Some(tokens)).unwrap() }).await
}

fn access(directory: &Path, token: &str) -> Access {
    let file = directory.join(token);
    std::fs::write(&file, token).unwrap();
    Access { token_file: Some(file), ..Access::default() }
}

#[tokio::test]
async fn every_call_is_refused_without_a_token_and_with_a_wrong_one() {
    let directory = tempfile::tempdir().unwrap();
    let accepted = directory.path().join("accepted");
    std::fs::write(&accepted, "open-sesame").unwrap();
    let world = world(&accepted).await;
    for shown in [Access::default(), access(directory.path(), "open-simsim")] {
        let mut client = world.client_with(&shown).await.unwrap();
        let refusals = [
            client.join(JoinRequest::default()).await.unwrap_err(),
            client.get_status(StatusRequest {}).await.unwrap_err(),
            client.watch_parameters(WatchRequest::default()).await.unwrap_err(),
            client.send_unrolls(futures::stream::empty()).await.unwrap_err(),
        ];
        for refused in refusals {
            assert_eq!(refused.code(), Code::Unauthenticated);
            assert!(!refused.message().contains("sesame"), "{refused}");
        }
    }
    let mut client = world.client_with(&access(directory.path(), "open-sesame")).await.unwrap();
    client.get_status(StatusRequest {}).await.unwrap();
}

#[tokio::test]
async fn a_renewed_token_takes_effect_without_a_restart() {
    let directory = tempfile::tempdir().unwrap();
    let accepted = directory.path().join("accepted");
    std::fs::write(&accepted, "first").unwrap();
    let world = world(&accepted).await;
    let mut first = world.client_with(&access(directory.path(), "first")).await.unwrap();
    let mut second = world.client_with(&access(directory.path(), "second")).await.unwrap();
    assert!(first.get_status(StatusRequest {}).await.is_ok());
    assert!(second.get_status(StatusRequest {}).await.is_err());
    std::fs::write(&accepted, "first\nsecond").unwrap();
    assert!(first.get_status(StatusRequest {}).await.is_ok());
    assert!(second.get_status(StatusRequest {}).await.is_ok());
    std::fs::write(&accepted, "second").unwrap();
    assert!(first.get_status(StatusRequest {}).await.is_err());
}

/// Who deletes a file of tokens wants nobody to enter with them.
#[tokio::test]
async fn a_token_file_that_is_gone_or_unusable_refuses_everybody_until_it_is_there_again() {
    let directory = tempfile::tempdir().unwrap();
    let accepted = directory.path().join("accepted");
    std::fs::write(&accepted, "open-sesame").unwrap();
    let world = world(&accepted).await;
    let mut client = world.client_with(&access(directory.path(), "open-sesame")).await.unwrap();
    let spoilt: [&dyn Fn(); 3] =
        [&|| std::fs::remove_file(&accepted).unwrap(), &|| std::fs::write(&accepted, "").unwrap(), &|| {
            std::fs::write(&accepted, [0xff; 8]).unwrap()
        }];
    for spoil in spoilt {
        spoil();
        let refused = client.get_status(StatusRequest {}).await.unwrap_err();
        assert_eq!(refused.code(), Code::Unauthenticated);
        std::fs::write(&accepted, "open-sesame").unwrap();
        client.get_status(StatusRequest {}).await.unwrap();
    }
}

#[tokio::test]
async fn streams_end_when_their_token_is_withdrawn() {
    let directory = tempfile::tempdir().unwrap();
    let accepted = directory.path().join("accepted");
    std::fs::write(&accepted, "withdrawn\nkept").unwrap();
    let world = world(&accepted).await;
    let mut streams = Vec::new();
    for (incarnation, token) in [(70, "withdrawn"), (71, "kept")] {
        let mut client = world.client_with(&access(directory.path(), token)).await.unwrap();
        let actor = client.join(joining(incarnation)).await.unwrap().into_inner().actor;
        let request = WatchRequest { actor, incarnation };
        streams.push(client.watch_parameters(request).await.unwrap().into_inner());
    }
    let [withdrawn, kept] = &mut streams[..] else { panic!("two streams") };
    std::fs::write(&accepted, "kept").unwrap();
    let ended = within(Duration::from_secs(30), withdrawn.message()).await.unwrap_err();
    assert_eq!(ended.code(), Code::Unauthenticated);
    world.publisher.publish(1, &parameters(1, 100));
    assert!(within(Duration::from_secs(30), kept.message()).await.unwrap().is_some());
}

#[tokio::test]
async fn the_health_check_needs_no_token() {
    let directory = tempfile::tempdir().unwrap();
    let accepted = directory.path().join("accepted");
    std::fs::write(&accepted, "open-sesame").unwrap();
    let world = world(&accepted).await;
    let mut health = HealthClient::new(world.channel().await);
    let request = || HealthCheckRequest { service: "comic.v1.Learner".into() };
    health.check(request()).await.unwrap();
    assert_eq!(health.watch(request()).await.unwrap_err().code(), Code::Unauthenticated, "a stream would take a place");
}
