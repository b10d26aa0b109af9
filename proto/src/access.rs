//! How a client finds a learner, proves who it is, and knows whom it talks to.

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

/// TCP, and then TLS, have to be there in this time.
const CONNECT: Duration = Duration::from_secs(5);
/// A learner that answers nothing for twice as long is not there any more.
const KEEP_ALIVE: Duration = Duration::from_secs(10);

/// Bytes of the largest HTTP/2 frame that an actor takes.
pub const FRAME_BYTES: usize = 64 * 1024;

/// A client of the learner that sends its token, if it has one, with every call.
pub type Client = LearnerClient<Authorised>;

/// A connection whose calls bear the token.
pub type Authorised = InterceptedService<Channel, Bearer>;

/// A client's side of TLS and tokens. Files are read anew for every connection, so renewed ones are taken up.
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
    /// File with the learner's token in its first line; without one the token is what COMIC_TOKEN holds.
    #[arg(long, value_name = "FILE", env = "COMIC_TOKEN_FILE", help_heading = "Access")]
    pub token_file: Option<PathBuf>,
}

impl Access {
    /// Where `url` leads, with TLS if it begins with `https://`. Connecting is limited to 5 s.
    ///
    /// # Errors
    /// A URL that is none, `https://` without an authority or an authority without `https://`, files that cannot be read.
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

    /// The same for an actor, whose connection lasts as long as it does. Keep-alive while idle: a learner that vanished without
    /// a word is otherwise never noticed. The connection's window exceeds the parameter stream's, so that a version nobody has
    /// read yet cannot stall the acknowledgements, and a frame holds a piece of parameters.
    ///
    /// # Errors
    /// As of [`endpoint`](Self::endpoint).
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
            return Err(AccessError::Tls { reason: format!("{} holds no PEM", ca.display()) });
        }
        let tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(authority)).timeout(CONNECT);
        Ok(match (&self.cert, &self.key) {
            (Some(cert), Some(key)) => tls.identity(Identity::from_pem(read(cert)?, read(key)?)),
            _ => tls,
        })
    }

    /// What puts the token into every call.
    ///
    /// # Errors
    /// A file that cannot be read, or without a usable token.
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

fn read(path: &Path) -> Result<Vec<u8>, AccessError> {
    std::fs::read(path).map_err(|source| AccessError::File { path: path.into(), source })
}

/// Sends the token with every call.
#[derive(Clone, Debug)]
pub struct Bearer {
    /// Marked as sensitive: its `Debug` form is `Sensitive`, and HTTP/2 never puts it into a table.
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

/// Whether TLS failed because one side does not trust the other's certificate, and will not in a minute either. An
/// expired certificate is no such case: both sides take up a renewed one without a restart.
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
        // HTTP/2 keeps of an error off its connection nothing but the text.
        None => DISTRUST.iter().any(|alert| {
            let text = rustls::Error::AlertReceived(*alert).to_string();
            link.to_string().contains(&text)
        }),
    })
}

/// What a peer says that does not take a certificate, or misses one.
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

/// An error and its sources as one line: the transport's own message is `transport error`. Of a status its message is
/// taken, which is for a person.
pub fn chain(error: &(dyn Error + 'static)) -> String {
    let said = |link: &(dyn Error + 'static)| match link.downcast_ref::<Status>() {
        Some(status) => status.message().to_owned(),
        None => link.to_string(),
    };
    let mut parts: Vec<String> = links(error).map(said).collect();
    parts.dedup();
    parts.join(": ")
}

fn links<'a>(error: &'a (dyn Error + 'static)) -> impl Iterator<Item = &'a (dyn Error + 'static)> {
    std::iter::successors(Some(error), |&error| error.source())
}

/// rustls hands its errors on inside those of the socket.
fn tls_error<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a rustls::Error> {
    let inner = || error.downcast_ref::<io::Error>()?.get_ref()?.downcast_ref();
    error.downcast_ref().or_else(inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_that_are_none_are_refused_with_the_remedy() {
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
    fn a_bearer_shows_no_secret() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "open-sesame\n").unwrap();
        let access = Access { token_file: Some(file.path().into()), ..Access::default() };
        let mut bearer = access.bearer().unwrap();
        let request = bearer.call(Request::new(())).unwrap();
        assert_eq!(request.metadata().get("authorization").unwrap(), "Bearer open-sesame");
        assert!(!format!("{bearer:?} {request:?} {access:?}").contains("sesame"));
    }

    #[test]
    fn expiry_is_waited_for_and_distrust_is_not() {
        let failed = |error| io::Error::new(io::ErrorKind::InvalidData, error);
        let lasting = rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer);
        assert!(distrusted(&failed(lasting)));
        assert!(distrusted(&failed(rustls::Error::AlertReceived(AlertDescription::CertificateRequired))));
        assert!(!distrusted(&failed(rustls::Error::InvalidCertificate(CertificateError::Expired))));
        assert!(!distrusted(&failed(rustls::Error::AlertReceived(AlertDescription::CertificateExpired))));
        assert!(!distrusted(&io::Error::from(io::ErrorKind::ConnectionRefused)));
    }
}
