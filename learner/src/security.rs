//! Who may talk to the learner: TLS, client certificates, tokens, and the rule for its address.
//!
//! # Layout
//! - `watched` reads files again when they change. [`Tls`] and [`Tokens`] are made of such files, so certificates and
//!   tokens are renewed without a restart.
//! - [`ConnectionLimits`] is how much of the learner everybody together may take.

mod limits;
mod tls;
mod tokens;
mod watched;

use std::net::IpAddr;
use std::path::PathBuf;

use clap::Args;

use crate::error::{Error, Result};

pub use limits::ConnectionLimits;
pub use tls::Tls;
pub use tokens::Tokens;

/// The command line's security.
#[derive(Clone, Debug, Default, Args)]
pub struct SecurityOptions {
    /// The learner's certificate chain (PEM): with it, actors connect by https://.
    #[arg(long, value_name = "FILE", requires = "key", help_heading = "Security")]
    pub cert: Option<PathBuf>,
    /// Private key (PEM) of the certificate.
    #[arg(long, value_name = "FILE", requires = "cert", help_heading = "Security")]
    pub key: Option<PathBuf>,
    /// Certificates (PEM) of the authority that signs the actors': without one of these nobody gets in.
    #[arg(long, value_name = "FILE", requires = "cert", help_heading = "Security")]
    pub client_ca: Option<PathBuf>,
    /// File with the tokens that are accepted, one a line; without one the token is what COMIC_TOKEN holds.
    #[arg(long, value_name = "FILE", env = "COMIC_TOKEN_FILE", help_heading = "Security")]
    pub token_file: Option<PathBuf>,
    /// Serve on an address that others can reach without TLS and without a token.
    #[arg(long, help_heading = "Security")]
    pub insecure: bool,
}

/// What a connection and a call have to show.
#[derive(Debug, Default)]
pub struct Security {
    /// TLS, where it is on.
    pub tls: Option<Tls>,
    /// The tokens one of which every call has to bear, where they are on.
    pub tokens: Option<Tokens>,
}

impl Security {
    /// Reads certificates and tokens, and refuses to be reachable without either.
    ///
    /// # Errors
    /// [`Error::Configuration`] or [`Error::Access`]: certificates or tokens that cannot be used, or an
    /// address that others can reach with nothing to protect it.
    pub fn new(options: &SecurityOptions, address: IpAddr) -> Result<Self> {
        let tls = match (&options.cert, &options.key) {
            (Some(cert), Some(key)) => Some(Tls::new(cert, key, options.client_ca.as_deref())?),
            _ => None,
        };
        let tokens = Tokens::new(options.token_file.as_deref())?;
        let security = Self { tls, tokens };
        if address.is_loopback() {
            return Ok(security);
        }
        let authenticates = security.tokens.is_some() || options.client_ca.is_some();
        if !authenticates && security.tls.is_none() && !options.insecure {
            return Err(Error::configuration(format!(
                "--address {address} can be reached by others, and nothing keeps them out: give --token-file FILE, or \
                 --cert and --key FILE with --client-ca FILE (`comic-learner certs` makes some), or --insecure where \
                 the network itself is trusted"
            )));
        }
        if !authenticates {
            tracing::warn!(%address, "whoever reaches this address may act, report and read: there is neither --token-file nor --client-ca");
        } else if security.tls.is_none() {
            tracing::warn!(%address, "the token crosses the network in the clear: --cert and --key would encrypt it");
        }
        Ok(security)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_that_others_reach_wants_protection_or_to_be_told() {
        let anywhere = IpAddr::from([0, 0, 0, 0]);
        let refused = Security::new(&SecurityOptions::default(), anywhere).unwrap_err();
        assert_eq!(refused.exit_code(), 2);
        for remedy in ["--token-file", "--cert", "--insecure"] {
            assert!(refused.to_string().contains(remedy), "{refused}");
        }
        assert!(Security::new(&SecurityOptions::default(), IpAddr::from([127, 0, 0, 1])).is_ok());
        let told = SecurityOptions { insecure: true, ..SecurityOptions::default() };
        assert!(Security::new(&told, anywhere).is_ok());
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "open-sesame").unwrap();
        let token = SecurityOptions { token_file: Some(file.path().into()), ..SecurityOptions::default() };
        assert!(Security::new(&token, anywhere).is_ok());
    }
}
