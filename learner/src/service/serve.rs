//! The server, from its first connection to its end.

use std::future::Future;
use std::pin::pin;
use std::time::Duration;

use comic_proto::FILE_DESCRIPTOR_SET;
use comic_proto::v1::learner_server::LearnerServer;
use tokio::net::TcpListener;
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;

use super::assembly::Service;
use super::authorisation::AuthorisationLayer;
use super::calls::Calls;
use super::connections::Acceptor;
use super::framing::router::Router;
use super::http2::server;
use crate::error::{Error, Result};

/// How long the server waits for its streams to end. After it, a connection whose peer reads nothing is abandoned.
const GRACE: Duration = Duration::from_secs(1);
/// Bytes of the largest request for the health, which names a service. Anybody may send it.
const HEALTH_MESSAGE: usize = 1024;
/// The services whose health is reported: the whole server, and the learner's.
const HEALTH: [&str; 2] = ["", "comic.v1.Learner"];

/// Serves actors on this listener until `shutdown`, then ends every stream and returns, after a second at most.
///
/// # Errors
/// [`Error::Server`] when the server stops accepting connections.
pub async fn serve(listener: TcpListener, service: Service, shutdown: impl Future<Output = ()>) -> Result<()> {
    let gate = &service.gate;
    let calls = LearnerServer::from_arc(service.calls.clone()).max_decoding_message_size(gate.message_limit);
    let (reporter, health) = tonic_health::server::health_reporter();
    let health = health.max_decoding_message_size(HEALTH_MESSAGE);
    reporter.set_serving::<LearnerServer<Calls>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .build_v1()
        .map_err(|error| Error::Defect(format!("the protocol's descriptors are damaged: {error}")))?;
    let authorisation = AuthorisationLayer::new(gate.tokens.clone(), &gate.limits, gate.prometheus.clone());
    let acceptor = Acceptor::new(gate.tls.clone(), &gate.limits, gate.prometheus.clone());
    let mut closing = service.shutdown.closing();
    let server = server(gate.window)
        .layer(authorisation)
        .add_service(Router::new(calls, service.unrolls.clone(), service.parameters.clone()))
        .add_service(health)
        .add_service(reflection)
        .serve_with_incoming_shutdown(acceptor.connections(listener), async move {
            closing.given().await;
        });
    let mut server = pin!(server);
    let draining = async {
        service.shutdown.draining().given().await;
        report_not_serving(&reporter).await;
        std::future::pending().await
    };
    tokio::select! {
        served = &mut server => return Ok(served?),
        () = draining => {}
        () = shutdown => {}
    }
    report_not_serving(&reporter).await;
    service.shutdown.close();
    match tokio::time::timeout(GRACE, server).await {
        Ok(served) => Ok(served?),
        Err(_) => {
            tracing::warn!("some actors did not read their streams to the end; their connections are abandoned");
            Ok(())
        }
    }
}

async fn report_not_serving(reporter: &HealthReporter) {
    for service in HEALTH {
        reporter.set_service_status(service, ServingStatus::NotServing).await;
    }
}
