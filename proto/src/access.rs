//! A client's access to a learner: address, TLS, and token.

use std::error::Error;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustls::{AlertDescription, CertificateError};
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Request, Status};

use crate::access_error::AccessError;
use crate::token::Token;
use crate::v1::learner_client::LearnerClient;

/// Time limit of connecting by TCP, and again of the TLS handshake.
const CONNECT: Duration = Duration::from_secs(5);
/// Interval of HTTP/2 pings, and time limit of their answers. A learner without an answer for both is lost.
const KEEP_ALIVE: Duration = Duration::from_secs(10);

/// Size of the largest HTTP/2 frame that an actor accepts, bytes.
pub const FRAME_BYTES: usize = 64 * 1024;

/// A client of the learner that sends its token, if it has one, with every call.
pub type Client = LearnerClient<Authorised>;

/// A connection whose calls have the token.
pub type Authorised = InterceptedService<Channel, Bearer>;

/// TLS and token of a client. Files are read again for every connection, so renewed files are used.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Access {
    /// Certificates (PEM) of the authority that signed the learner's; https:// needs it.
    #[arg(long, value_name = "FILE", env = "COMIC_CA", help_heading = "Access")]
    pub ca: Option<PathBuf>,
    /// Own certificate (PEM), for a learner that asks for one.
    #[arg(long, value_name = "FILE", env = "COMIC_CERT", requires = "key", help_heading = "Access")]
    pub cert: Option<PathBuf>,
    /// Private key (PEM) of the certificate.
    #[arg(long, value_name = "FILE", env = "COMIC_KEY", requires = "cert", help_heading = "Access")]
    pub key: Option<PathBuf>,
    /// File with the learner's token in its first line. Default: the token in COMIC_TOKEN.
    #[arg(long, value_name = "FILE", env = "COMIC_TOKEN_FILE", help_heading = "Access")]
    pub token_file: Option<PathBuf>,
}

impl Access {
    /// The endpoint of `url`, with TLS if it begins with `https://`. The time limit of connecting is 5 s.
    ///
    /// # Errors
    /// [`AccessError`], if the URL is invalid, if `https://` has no authority or an authority is given without
    /// `https://`, or if a file cannot be read.
    pub fn endpoint(&self, url: &str) -> Result<Endpoint, AccessError> {
        let unusable = || AccessError::Url { url: url.to_owned() };
        let endpoint = Endpoint::from_shared(url.to_owned()).map_err(|_| unusable())?.connect_timeout(CONNECT);
        let secure = match endpoint.uri().scheme_str() {
            Some("https") => true,
            Some("http") => false,
            _ => return Err(unusable()),
        };
        if endpoint.uri().host().is_none() {
            return Err(unusable());
        }
        match (secure, &self.ca) {
            (true, Some(ca)) => {
                let tls = self.tls(ca)?;
                endpoint.tls_config(tls).map_err(|error| AccessError::Tls { reason: chain(&error) })
            }
            (true, None) => Err(AccessError::NoAuthority { url: url.to_owned() }),
            (false, Some(_)) => Err(AccessError::NotSecure { url: url.to_owned() }),
            (false, None) => Ok(endpoint),
        }
    }

    /// Like [`endpoint`](Self::endpoint), for the long connection of an actor. It sends pings while it is idle;
    /// otherwise a learner that vanished would never be noticed. The window of the connection is larger than that of
    /// the parameter stream, so unread parameters cannot block the acknowledgements. A piece of parameters fits into
    /// one frame.
    ///
    /// # Errors
    /// As [`endpoint`](Self::endpoint).
    pub fn lasting_endpoint(&self, url: &str) -> Result<Endpoint, AccessError> {
        Ok(self
            .endpoint(url)?
            .tcp_nodelay(true)
            .http2_keep_alive_interval(KEEP_ALIVE)
            .keep_alive_timeout(KEEP_ALIVE)
            .keep_alive_while_idle(true)
            .initial_stream_window_size(1 << 20)
            .initial_connection_window_size(4 << 20)
            .max_frame_size(FRAME_BYTES as u32))
    }

    fn tls(&self, ca: &Path) -> Result<ClientTlsConfig, AccessError> {
        let authority = read(ca)?;
        if !authority.windows(5).any(|window| window == b"BEGIN") {
            return Err(AccessError::Tls { reason: format!("{} is not a PEM file", ca.display()) });
        }
        let tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(authority)).timeout(CONNECT);
        Ok(match (&self.cert, &self.key) {
            (Some(cert), Some(key)) => tls.identity(Identity::from_pem(read(cert)?, read(key)?)),
            _ => tls,
        })
    }

    /// The interceptor that adds the token to every call.
    ///
    /// # Errors
    /// [`AccessError`], if the file cannot be read or has no valid token.
    pub fn bearer(&self) -> Result<Bearer, AccessError> {
        let Some(token) = Token::read(self.token_file.as_deref())?.into_iter().next() else {
            return Ok(Bearer { header: None });
        };
        let mut header: MetadataValue<Ascii> = format!("Bearer {}", token.secret())
            .parse()
            .map_err(|_| AccessError::Token { origin: "the token".into() })?;
        header.set_sensitive(true);
        Ok(Bearer { header: Some(header) })
    }
}

/// The URL of another learner of a run, at `address` (host and port), which is reached as the one at `url` is.
pub fn url_of_sibling(url: &str, address: &str) -> String {
    let scheme = url.split_once("://").map_or("http", |(scheme, _)| scheme);
    format!("{scheme}://{address}")
}

fn read(path: &Path) -> Result<Vec<u8>, AccessError> {
    std::fs::read(path).map_err(|source| AccessError::File { path: path.into(), source })
}

/// Sends the token with every call.
#[derive(Clone, Debug)]
pub struct Bearer {
    /// The value is marked as sensitive: `Debug` prints `Sensitive`, and HTTP/2 never adds it to its header table.
    header: Option<MetadataValue<Ascii>>,
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(header) = &self.header {
            request.metadata_mut().insert("authorization", header.clone());
        }
        Ok(request)
    }
}

/// Whether TLS failed for a permanent reason: one side does not trust the other's certificate. An expired certificate
/// is not permanent, because both sides use a renewed certificate without a restart.
pub fn distrusted(error: &(dyn Error + 'static)) -> bool {
    links(error).any(|link| match tls_error(link) {
        Some(rustls::Error::InvalidCertificate(reason)) => !matches!(
            reason,
            CertificateError::Expired
                | CertificateError::ExpiredContext { .. }
                | CertificateError::NotValidYet
                | CertificateError::NotValidYetContext { .. }
        ),
        Some(rustls::Error::AlertReceived(alert)) => DISTRUST.contains(alert),
        Some(_) => false,
        // HTTP/2 keeps only the text of an error of its connection.
        None => DISTRUST.iter().any(|alert| {
            let text = rustls::Error::AlertReceived(*alert).to_string();
            link.to_string().contains(&text)
        }),
    })
}

/// The alerts of a peer that refuses a certificate or requires one.
const DISTRUST: [AlertDescription; 9] = [
    AlertDescription::AccessDenied,
    AlertDescription::BadCertificate,
    AlertDescription::CertificateRequired,
    AlertDescription::CertificateRevoked,
    AlertDescription::CertificateUnknown,
    AlertDescription::DecryptError,
    AlertDescription::NoCertificate,
    AlertDescription::UnknownCA,
    AlertDescription::UnsupportedCertificate,
];

/// The error of a connection that could not be made, as one line. If TLS failed, the peer has answered. Otherwise the
/// line names the remedy.
pub fn no_connection(error: &(dyn Error + 'static)) -> String {
    let reason = chain(error);
    if links(error).any(|link| tls_error(link).is_some()) {
        return reason;
    }
    format!("nothing answers; is the learner running, and is the address right? ({reason})")
}

/// An error and its sources as one line. The sources are needed because the transport's own message is `transport
/// error`. A gRPC status is represented by its message.
pub fn chain(error: &(dyn Error + 'static)) -> String {
    let text = |link: &(dyn Error + 'static)| match link.downcast_ref::<Status>() {
        Some(status) => status.message().to_owned(),
        None => link.to_string(),
    };
    let mut parts: Vec<String> = links(error).map(text).collect();
    parts.dedup();
    parts.join(": ")
}

/// An error, its source, and so on.
fn links<'a>(error: &'a (dyn Error + 'static)) -> impl Iterator<Item = &'a (dyn Error + 'static)> {
    std::iter::successors(Some(error), |&error| error.source())
}

/// The error of rustls. It may be inside an error of the socket.
fn tls_error<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a rustls::Error> {
    let inner = || error.downcast_ref::<io::Error>()?.get_ref()?.downcast_ref();
    error.downcast_ref().or_else(inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_addresses_are_refused_with_a_remedy() {
        let refused = |url: &str, access: &Access| access.endpoint(url).unwrap_err();
        for url in ["host:7070", "", "http://", "ftp://host", "not a url"] {
            let error = refused(url, &Access::default());
            assert!(matches!(error, AccessError::Url { .. }), "{url}: {error}");
        }
        let error = refused("https://host:7070", &Access::default());
        assert!(error.to_string().contains("--ca"), "{error}");
        let access = Access { ca: Some("ca.pem".into()), ..Access::default() };
        assert!(refused("http://host:7070", &access).to_string().contains("https://"));
        assert!(matches!(refused("https://host:7070", &access), AccessError::File { .. }));
    }

    #[test]
    fn the_debug_form_of_a_bearer_does_not_show_the_token() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "open-sesame\n").unwrap();
        let access = Access { token_file: Some(file.path().into()), ..Access::default() };
        let mut bearer = access.bearer().unwrap();
        let request = bearer.call(Request::new(())).unwrap();
        assert_eq!(request.metadata().get("authorization").unwrap(), "Bearer open-sesame");
        assert!(!format!("{bearer:?} {request:?} {access:?}").contains("sesame"));
    }

    #[test]
    fn an_expired_certificate_is_not_permanent_and_distrust_is() {
        let failed = |error| io::Error::new(io::ErrorKind::InvalidData, error);
        let lasting = rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer);
        assert!(distrusted(&failed(lasting)));
        assert!(distrusted(&failed(rustls::Error::AlertReceived(AlertDescription::CertificateRequired))));
        assert!(!distrusted(&failed(rustls::Error::InvalidCertificate(CertificateError::Expired))));
        assert!(!distrusted(&failed(rustls::Error::AlertReceived(AlertDescription::CertificateExpired))));
        assert!(!distrusted(&io::Error::from(io::ErrorKind::ConnectionRefused)));
    }

    #[test]
    fn the_error_of_a_connection_names_the_remedy_unless_tls_failed() {
        let refused = no_connection(&io::Error::from(io::ErrorKind::ConnectionRefused));
        assert!(refused.contains("is the learner running") && refused.contains("connection refused"), "{refused}");
        let expired = rustls::Error::InvalidCertificate(CertificateError::Expired);
        let expired = no_connection(&io::Error::new(io::ErrorKind::InvalidData, expired));
        assert!(!expired.contains("is the learner running"), "{expired}");
    }
}
