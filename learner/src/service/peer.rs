//! What calls know of the connection that they came on.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rand::Rng as _;
use rustls::pki_types::CertificateDer;
use sha2::{Digest as _, Sha256};
use tokio::time::Instant;
use webpki::EndEntityCert;

use crate::security::ConnectionLimits;

/// The ages of connections differ by this share, so that actors that came together do not come back together.
const JITTER: f64 = 0.1;

/// The owner of a client certificate: a hash of its subject and its DNS names, which stay when it is renewed.
pub(super) type Owner = [u8; 32];

/// The peer of a connection; a handle that can be cloned.
#[derive(Clone, Debug)]
pub(super) struct Peer {
    pub(super) address: SocketAddr,
    /// If it showed a certificate.
    pub(super) owner: Option<Owner>,
    /// When the connection must be made anew.
    pub(super) expires: Instant,
    authenticated: Arc<AtomicBool>,
    /// Until when it must be.
    authenticates_until: Instant,
}

impl Peer {
    /// The peer of a connection that begins now.
    pub(super) fn new(address: SocketAddr, limits: &ConnectionLimits) -> Self {
        let now = Instant::now();
        let age = limits.max_connection_age.mul_f64(rand::rng().random_range(1.0 - JITTER..=1.0 + JITTER));
        Self {
            address,
            owner: None,
            expires: now + age,
            authenticated: Arc::default(),
            authenticates_until: now + limits.authentication_timeout,
        }
    }

    /// Notes that a call of this peer was accepted.
    pub(super) fn authenticate(&self) {
        self.authenticated.store(true, Ordering::Relaxed);
    }

    /// Whether a call of this peer was accepted.
    pub(super) fn is_authenticated(&self) -> bool {
        self.authenticated.load(Ordering::Relaxed)
    }

    /// Until when the connection may stay open. `linger` is how long calls may go on beyond its age.
    pub(super) fn closes_at(&self, linger: Duration) -> Instant {
        if self.is_authenticated() { self.expires + linger } else { self.authenticates_until }
    }

    /// Until when the first accepted call must have come.
    pub(super) fn authenticates_until(&self) -> Instant {
        self.authenticates_until
    }
}

/// The owner of a certificate that was verified.
pub(super) fn owner(certificate: &CertificateDer<'_>) -> Option<Owner> {
    let certificate = EndEntityCert::try_from(certificate).ok()?;
    let mut hash = Sha256::new_with_prefix(certificate.subject());
    let mut names: Vec<_> = certificate.valid_dns_names().collect();
    // An authority may write them in another order when it renews the certificate.
    names.sort_unstable();
    for name in names {
        // No name has a zero byte.
        hash.update([0]);
        hash.update(name);
    }
    Some(hash.finalize().into())
}
