//! Peers without a token, or with one and bad intentions, take nothing that honest actors need.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use crate::support::{EPOCH, RUN, World, joining, within};
use bytes::Bytes;
use comic_learner::observe::probes;
use comic_learner::security::{ConnectionLimits, Security, Tls};
use comic_proto::v1::{EvaluationReport, JoinRequest, StatusRequest, Verdict};
use comic_proto::{Access, MAX_SEQUENCE};
use futures::FutureExt as _;
use futures::stream;
use http::Request;
use http_body::Frame;
use http_body_util::StreamBody;
use rcgen::{CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tonic::body::Body;
use tonic::{Code, Status};
use tower::Service as _;

const LIMIT: Duration = Duration::from_secs(20);

/// Connects from this address of the loopback network.
async fn connect_from(source: [u8; 4], to: SocketAddr) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(SocketAddr::from((source, 0))).unwrap();
    socket.connect(to).await.unwrap()
}

fn socket_address(world: &World) -> SocketAddr {
    world.address.trim_start_matches("http://").parse().unwrap()
}

/// A request for the health whose body never ends.
fn endless_check(address: &str) -> Request<Body> {
    let frames = stream::once(async { Ok::<_, Status>(Frame::data(Bytes::from_static(&[0]))) });
    let body = StreamBody::new(futures::StreamExt::chain(frames, stream::pending()));
    Request::post(format!("{address}/grpc.health.v1.Health/Check"))
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .body(Body::new(body))
        .unwrap()
}

#[tokio::test]
async fn a_flood_of_health_checks_takes_no_place_of_an_honest_actors_calls() {
    let world = World::limited(ConnectionLimits { max_requests: 8, ..ConnectionLimits::default() }).await;
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    let mut checks = Vec::new();
    for _ in 0..4 {
        let mut channel = world.channel().await;
        for _ in 0..32 {
            std::future::poll_fn(|context| channel.poll_ready(context)).await.unwrap();
            checks.push(channel.call(endless_check(&world.address)).boxed());
        }
    }
    // Until the learner has seen them: it refuses those that have no place.
    let (first, _, open) = within(LIMIT, futures::future::select_all(checks)).await;
    let refused = first.unwrap().headers().get("grpc-status").cloned().expect("a refusal");
    assert_eq!(refused, "8", "RESOURCE_EXHAUSTED");
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    let _watch = actor.watch().await;
    assert_eq!(actor.accounting().await.in_flight, 1);
    drop(open);
}

/// The largest request for the health names a service of 1 KiB.
#[tokio::test]
async fn a_health_check_is_a_small_message() {
    let world = World::start().await;
    let mut health = tonic_health::pb::health_client::HealthClient::new(world.channel().await);
    let request = |bytes| tonic_health::pb::HealthCheckRequest { service: "x".repeat(bytes) };
    assert_eq!(health.check(request(900)).await.unwrap_err().code(), Code::NotFound);
    assert_eq!(health.check(request(2000)).await.unwrap_err().code(), Code::OutOfRange);
}

#[tokio::test]
async fn a_flood_of_silent_peers_does_not_delay_the_probes() {
    let world = World::start().await;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    tokio::spawn(probes::serve(listener, world.service.probed()));
    let mut silent = Vec::new();
    for _ in 0..200 {
        silent.push(TcpStream::connect(address).await.unwrap());
    }
    let probe = async {
        let mut stream = TcpStream::connect(address).await.unwrap();
        stream.write_all(b"GET /healthz HTTP/1.1\r\nHost: test\r\n\r\n").await.unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await.unwrap();
        answer
    };
    // A kubelet waits for a second by default; the silent ones stay longer.
    let answer = within(Duration::from_secs(3), probe).await;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    drop(silent);
}

#[tokio::test]
async fn one_address_cannot_take_all_connections() {
    let limits = ConnectionLimits { max_actors: 1, ..ConnectionLimits::default() };
    let all = limits.max_connections();
    let world = World::limited(limits).await;
    let mut taken = Vec::new();
    for _ in 0..all {
        taken.push(connect_from([127, 0, 0, 2], socket_address(&world)).await);
    }
    let mut actor = within(LIMIT, world.actor(70)).await;
    let mut unrolls = actor.stream().await;
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    drop(taken);
}

fn report(json: &str) -> EvaluationReport {
    EvaluationReport { run: Some(RUN), learner_epoch: EPOCH, json: json.into(), ..EvaluationReport::default() }
}

#[tokio::test]
async fn an_evaluation_names_the_run_that_it_belongs_to() {
    let world = World::start().await;
    let mut client = world.client().await;
    for run in [None, Some(RUN + 1)] {
        let refused = client.report_evaluation(EvaluationReport { run, ..report("{}") }).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument, "{run:?}");
        assert!(refused.message().contains("run"), "{refused}");
    }
    client.report_evaluation(report("{}")).await.unwrap();
    assert_eq!(world.service.trainer().take_evaluations().len(), 1);
}

/// Such a report would make its checkpoint the best one for ever.
#[tokio::test]
async fn an_evaluation_cannot_claim_more_than_the_task_pays() {
    let world = World::start().await;
    let mut client = world.client().await;
    for claimed in ["1e300", "1.01", "\"much\""] {
        let json = format!(r#"{{"overall": {{"normalised_reward": {claimed}}}}}"#);
        let refused = client.report_evaluation(report(&json)).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument, "{claimed}");
        assert!(refused.message().contains("normalised_reward"), "{refused}");
    }
    for possible in ["1.0", "0.55", "-3.0"] {
        let json = format!(r#"{{"overall": {{"normalised_reward": {possible}}}}}"#);
        client.report_evaluation(report(&json)).await.unwrap();
    }
}

#[tokio::test]
async fn evaluations_are_reported_at_a_limited_rate() {
    let world = World::start().await;
    let mut client = world.client().await;
    let mut reported = 0;
    let refused = loop {
        match client.report_evaluation(report("{}")).await {
            Ok(_) => reported += 1,
            Err(refused) => break refused,
        }
        assert!(reported < 1000, "no limit");
        world.service.trainer().take_evaluations();
    };
    assert_eq!(refused.code(), Code::ResourceExhausted);
    assert!(refused.message().contains("evaluations a minute"), "{refused}");
}

#[tokio::test]
async fn a_name_joins_at_a_limited_rate_and_other_names_are_not_disturbed() {
    let world = World::start().await;
    let mut client = world.client().await;
    let request = |name: &str| JoinRequest { name: name.into(), ..joining(70) };
    let mut joined = 0;
    let refused = loop {
        match client.join(request("crashing")).await {
            Ok(_) => joined += 1,
            Err(refused) => break refused,
        }
        assert!(joined < 1000, "no limit");
    };
    assert_eq!(refused.code(), Code::ResourceExhausted, "the actor tries again");
    assert!(refused.message().contains("joins a minute"), "{refused}");
    client.join(JoinRequest { name: "calm".into(), ..joining(71) }).await.unwrap();
}

/// Sums of the accounting that are near their end would make the learner refuse honest unrolls.
#[tokio::test]
async fn an_actor_cannot_claim_more_lost_unrolls_than_an_actor_can_make() {
    let world = World::start().await;
    let mut client = world.client().await;
    let refused = client.join(JoinRequest { acknowledged: MAX_SEQUENCE, ..joining(71) }).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains("start the actor again"), "{refused}");
    let mut actor = world.actor(70).await;
    let mut unrolls = actor.stream().await;
    assert_eq!(unrolls.verdict(actor.unroll(MAX_SEQUENCE - 1)).await, Verdict::Invalid);
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    assert_eq!(actor.accounting().await.produced, 1);
}

/// An authority, a learner's certificate and the clients' ones of these names, in a directory.
fn certificates(directory: &Path, clients: [&str; 2]) {
    let key = KeyPair::generate().unwrap();
    let mut authority = CertificateParams::default();
    authority.is_ca = IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
    std::fs::write(directory.join("ca.pem"), authority.self_signed(&key).unwrap().pem()).unwrap();
    let issuer = Issuer::new(authority, key);
    let server = ("server", "localhost", ExtendedKeyUsagePurpose::ServerAuth);
    let clients = clients.map(|name| (name, name, ExtendedKeyUsagePurpose::ClientAuth));
    for (file, name, usage) in std::iter::once(server).chain(clients) {
        let mut params = CertificateParams::new(vec![name.to_owned()]).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        params.extended_key_usages = vec![usage];
        let key = KeyPair::generate().unwrap();
        std::fs::write(directory.join(format!("{file}.pem")), params.signed_by(&key, &issuer).unwrap().pem()).unwrap();
        std::fs::write(directory.join(format!("{file}-key.pem")), key.serialize_pem()).unwrap();
    }
}

#[tokio::test]
async fn an_actors_name_belongs_to_the_certificate_that_used_it_first() {
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str| directory.path().join(name);
    certificates(directory.path(), ["honest", "greedy"]);
    let tls = Tls::new(&file("server.pem"), &file("server-key.pem"), Some(&file("ca.pem"))).unwrap();
    let world = World::secured(Security { tls: Some(tls), tokens: None }).await;
    let access = |name: &str| Access {
        ca: Some(file("ca.pem")),
        cert: Some(file(&format!("{name}.pem"))),
        key: Some(file(&format!("{name}-key.pem"))),
        token_file: None,
    };
    let request = |incarnation| JoinRequest { name: "comic-actor-0".into(), ..joining(incarnation) };
    let mut honest = world.client_with(&access("honest")).await.unwrap();
    honest.join(request(70)).await.unwrap();
    let mut greedy = world.client_with(&access("greedy")).await.unwrap();
    let refused = greedy.join(request(71)).await.unwrap_err();
    assert_eq!(refused.code(), Code::PermissionDenied);
    assert!(refused.message().contains("certificate"), "{refused}");
    honest.join(request(70)).await.expect("the first one was not superseded");
    while greedy.join(request(71)).await.unwrap_err().code() != Code::ResourceExhausted {}
    honest.join(request(70)).await.expect("the joins of another certificate do not count");
    honest.join(request(72)).await.expect("its next process has the same certificate");
    greedy.join(JoinRequest { name: "another".into(), ..joining(73) }).await.unwrap();
    greedy.get_status(StatusRequest {}).await.unwrap();
}
