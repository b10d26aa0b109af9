//! The learner's side of TLS, by rustls.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use rustls::{RootCertStore, ServerConfig};
use tokio_rustls::TlsAcceptor;

use super::watched::Watched;
use crate::error::{Error, Result};

/// Certificates that are read again when they change. Files that cannot be used, as between the two writes of a renewal, leave
/// the last ones in use.
#[derive(Debug)]
pub struct Tls(Watched<ServerConfig>);

impl Tls {
    /// Serves with this certificate chain. With `client_ca`, only clients with a certificate of this authority are accepted.
    ///
    /// # Errors
    /// [`Error::Configuration`] when a file cannot be read or used.
    pub fn new(cert: &Path, key: &Path, client_ca: Option<&Path>) -> Result<Self> {
        let (cert, key, client_ca) = (cert.to_path_buf(), key.to_path_buf(), client_ca.map(Path::to_path_buf));
        let files: Vec<PathBuf> = [&cert, &key].into_iter().chain(&client_ca).cloned().collect();
        let watched = Watched::new(files, move || configuration(&cert, &key, client_ca.as_deref()))?;
        Ok(Self(watched))
    }

    /// The acceptor for a connection that arrives now.
    pub(crate) fn acceptor(&self) -> TlsAcceptor {
        TlsAcceptor::from(self.0.last_usable())
    }
}

fn configuration(cert: &Path, key: &Path, client_ca: Option<&Path>) -> Result<ServerConfig> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let unusable = |error: rustls::Error| {
        Error::configuration(format!("the certificate {} cannot be used with its key: {error}", cert.display()))
    };
    let builder = ServerConfig::builder_with_provider(provider.clone())
        .with_safe_default_protocol_versions()
        .map_err(unusable)?;
    let builder = match client_ca {
        None => builder.with_no_client_auth(),
        Some(ca) => {
            let unusable = |error: &dyn std::fmt::Display| {
                Error::configuration(format!("the clients' authority {} cannot be used: {error}", ca.display()))
            };
            let mut roots = RootCertStore::empty();
            for certificate in certificates(ca)? {
                roots.add(certificate).map_err(|error| unusable(&error))?;
            }
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
            builder.with_client_cert_verifier(verifier.build().map_err(|error| unusable(&error))?)
        }
    };
    let private = PrivateKeyDer::from_pem_file(key)
        .map_err(|error| Error::configuration(format!("the key {} cannot be read: {error}", key.display())))?;
    let mut configuration = builder.with_single_cert(certificates(cert)?, private).map_err(unusable)?;
    configuration.alpn_protocols = vec![b"h2".to_vec()];
    // Every connection makes a full handshake, because a resumed session would outlive its certificate. Actors connect rarely.
    configuration.session_storage = Arc::new(NoServerSessionStorage {});
    configuration.send_tls13_tickets = 0;
    Ok(configuration)
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>> {
    let unusable = |error| Error::configuration(format!("the certificate {} cannot be read: {error}", path.display()));
    let found: Vec<_> =
        CertificateDer::pem_file_iter(path).map_err(unusable)?.collect::<Result<_, _>>().map_err(unusable)?;
    if found.is_empty() {
        return Err(Error::configuration(format!("{} holds no certificate", path.display())));
    }
    Ok(found)
}
