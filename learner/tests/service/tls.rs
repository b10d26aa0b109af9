//! TLS: both sides check certificates, and renewed certificates take effect without a restart.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::io::ErrorKind;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use crate::support::{World, within};
use comic_learner::commands::certs::Certs;
use comic_learner::security::{ConnectionLimits, Security, Tls};
use comic_proto::v1::StatusRequest;
use comic_proto::{Access, distrusted};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject as _;
use rustls::{ClientConfig, RootCertStore};
use tokio::io::AsyncReadExt as _;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

fn certificates(directory: &Path) {
    let (out, names) = (directory.into(), vec!["localhost".into()]);
    let certs = Certs { out, names, days: 1, token: false, copy_for_learner: None, copy_for_actors: None };
    certs.run().unwrap();
}

/// A learner that requires client certificates if `mutual`.
fn security(directory: &Path, mutual: bool) -> Security {
    let ca = directory.join("ca.pem");
    let tls = Tls::new(&directory.join("server.pem"), &directory.join("server-key.pem"), mutual.then_some(&ca));
    Security { tls: Some(tls.unwrap()), tokens: None }
}

async fn world(directory: &Path, mutual: bool) -> World {
    World::secured(security(directory, mutual)).await
}

/// Access of a client that trusts the authority of one directory and shows the certificate of another.
fn access(trusted: &Path, shown: Option<&Path>) -> Access {
    Access {
        ca: Some(trusted.join("ca.pem")),
        cert: shown.map(|shown| shown.join("client.pem")),
        key: shown.map(|shown| shown.join("client-key.pem")),
        token_file: None,
    }
}

/// Whether a call succeeds. If it fails, a certificate was not accepted.
async fn succeeds(world: &World, access: &Access) -> bool {
    let mut client = match world.client_with(access).await {
        Ok(client) => client,
        Err(error) => {
            assert!(distrusted(error.as_ref()), "{error:?}");
            return false;
        }
    };
    match client.get_status(StatusRequest {}).await {
        Ok(_) => true,
        Err(status) => {
            assert!(distrusted(&status), "{status:?}");
            false
        }
    }
}

#[tokio::test]
async fn a_client_accepts_only_a_learner_that_it_trusts() {
    let (own, foreign) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    certificates(own.path());
    certificates(foreign.path());
    let world = world(own.path(), false).await;
    assert!(succeeds(&world, &access(own.path(), None)).await);
    assert!(!succeeds(&world, &access(foreign.path(), None)).await);
}

#[tokio::test]
async fn a_learner_that_requires_certificates_accepts_only_those_of_its_authority() {
    let (own, foreign) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    certificates(own.path());
    certificates(foreign.path());
    let world = world(own.path(), true).await;
    assert!(succeeds(&world, &access(own.path(), Some(own.path()))).await);
    // Often enough to see a reset that overtakes the alert, if the connection were closed too early.
    for _ in 0..20 {
        assert!(!succeeds(&world, &access(own.path(), None)).await);
        assert!(!succeeds(&world, &access(own.path(), Some(foreign.path()))).await);
    }
}

#[tokio::test]
async fn a_peer_without_tls_is_refused_and_delays_no_other() {
    let own = tempfile::tempdir().unwrap();
    certificates(own.path());
    let world = world(own.path(), false).await;
    let address = world.address.trim_start_matches("http://").to_owned();
    let _silent = TcpStream::connect(&address).await.unwrap();
    let answered = match world.client_with(&Access::default()).await {
        Ok(mut client) => client.get_status(StatusRequest {}).await.is_ok(),
        Err(_) => false,
    };
    assert!(!answered);
    assert!(succeeds(&world, &access(own.path(), None)).await);
}

/// A silent connection would keep a place that others need.
#[tokio::test]
async fn a_peer_that_is_silent_after_the_tls_handshake_is_disconnected() {
    let own = tempfile::tempdir().unwrap();
    certificates(own.path());
    let limits = ConnectionLimits { authentication_timeout: Duration::from_secs(2), ..ConnectionLimits::default() };
    let world = World::guarded(8, Vec::new(), security(own.path(), false), limits).await;
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(own.path().join("ca.pem")).unwrap()).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let versions = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions().unwrap();
    let mut trusting = versions.with_root_certificates(roots).with_no_client_auth();
    trusting.alpn_protocols = vec![b"h2".to_vec()];
    let stream = TcpStream::connect(world.address.trim_start_matches("http://")).await.unwrap();
    let connector = TlsConnector::from(Arc::new(trusting));
    let mut silent = connector.connect("localhost".try_into().unwrap(), stream).await.unwrap();
    let ended = within(Duration::from_secs(30), silent.read_to_end(&mut Vec::new())).await;
    // The learner may close TLS in order or just the socket.
    let gone = |error: std::io::Error| matches!(error.kind(), ErrorKind::ConnectionReset | ErrorKind::UnexpectedEof);
    assert!(ended.is_ok() || ended.is_err_and(gone));
}

#[tokio::test]
async fn renewed_certificates_are_used_without_a_restart() {
    let (old, new) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    certificates(old.path());
    certificates(new.path());
    let world = world(old.path(), false).await;
    assert!(!succeeds(&world, &access(new.path(), None)).await);
    std::fs::copy(new.path().join("server-key.pem"), old.path().join("server-key.pem")).unwrap();
    assert!(succeeds(&world, &access(old.path(), None)).await, "half a renewal changes nothing");
    std::fs::copy(new.path().join("server.pem"), old.path().join("server.pem")).unwrap();
    assert!(succeeds(&world, &access(new.path(), None)).await);
}
