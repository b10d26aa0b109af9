//! Who may use the learner: TLS, client certificates, tokens, and the rule for its address.
//!
//! # Layout
//! - `watched` reads files again when they change. [`Tls`] and [`Tokens`] use such files, so certificates and tokens are
//!   renewed without a restart.
//! - [`ConnectionLimits`] is how much of the learner all peers together may use.

mod limit_arguments;
mod tls;
mod tokens;
mod watched;

use std::net::IpAddr;
use std::path::PathBuf;

use clap::Args;

use crate::error::{Error, Result};

pub use limit_arguments::ConnectionLimits;
pub use tls::Tls;
pub use tokens::{Shown, Tokens};

/// The arguments for security.
#[derive(Clone, Debug, Default, Args)]
pub struct SecurityArguments {
    /// The learner's certificate chain (PEM). Actors then connect by https://.
    #[arg(long, value_name = "FILE", requires = "key", help_heading = "Security")]
    pub cert: Option<PathBuf>,
    /// Private key (PEM) of the certificate.
    #[arg(long, value_name = "FILE", requires = "cert", help_heading = "Security")]
    pub key: Option<PathBuf>,
    /// Certificates (PEM) of the authority that signs the actors' certificates. Peers without such a certificate are refused.
    #[arg(long, value_name = "FILE", requires = "cert", help_heading = "Security")]
    pub client_ca: Option<PathBuf>,
    /// File with the accepted tokens, one a line [default: the token in COMIC_TOKEN].
    #[arg(long, value_name = "FILE", env = "COMIC_TOKEN_FILE", help_heading = "Security")]
    pub token_file: Option<PathBuf>,
    /// Serve without TLS and without a token on an address that other machines can reach.
    #[arg(long, help_heading = "Security")]
    pub insecure: bool,
}

/// What connections and calls must show.
#[derive(Debug, Default)]
pub struct Security {
    /// TLS, if it is on.
    pub tls: Option<Tls>,
    /// The accepted tokens, if calls must have one.
    pub tokens: Option<Tokens>,
}

impl Security {
    /// Reads certificates and tokens. An address that other machines can reach needs one of them.
    ///
    /// # Errors
    /// [`Error::Configuration`] or [`Error::Access`]: certificates or tokens that cannot be used, or an
    /// address that others can reach with nothing to protect it.
    pub fn new(arguments: &SecurityArguments, address: IpAddr) -> Result<Self> {
        let tls = match (&arguments.cert, &arguments.key) {
            (Some(cert), Some(key)) => Some(Tls::new(cert, key, arguments.client_ca.as_deref())?),
            _ => None,
        };
        let tokens = Tokens::new(arguments.token_file.as_deref())?;
        let security = Self { tls, tokens };
        if address.is_loopback() {
            return Ok(security);
        }
        let authenticates = security.tokens.is_some() || arguments.client_ca.is_some();
        if !authenticates && security.tls.is_none() && !arguments.insecure {
            return Err(Error::configuration(format!(
                "--address {address} can be reached by other machines, and nothing restricts access: give --token-file FILE, or \
                 --cert and --key FILE with --client-ca FILE (`comic-learner certs` makes some), or --insecure where \
                 the network itself is trusted"
            )));
        }
        if !authenticates {
            tracing::warn!(%address, "every peer that reaches this address can act, report and read: there is neither --token-file nor --client-ca");
        } else if security.tls.is_none() {
            tracing::warn!(%address, "the token crosses the network unencrypted: --cert and --key would encrypt it");
        }
        Ok(security)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_that_others_reach_needs_protection_or_insecure() {
        let anywhere = IpAddr::from([0, 0, 0, 0]);
        let refused = Security::new(&SecurityArguments::default(), anywhere).unwrap_err();
        assert_eq!(refused.exit_code(), 2);
        for remedy in ["--token-file", "--cert", "--insecure"] {
            assert!(refused.to_string().contains(remedy), "{refused}");
        }
        assert!(Security::new(&SecurityArguments::default(), IpAddr::from([127, 0, 0, 1])).is_ok());
        let insecure = SecurityArguments { insecure: true, ..SecurityArguments::default() };
        assert!(Security::new(&insecure, anywhere).is_ok());
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "open-sesame").unwrap();
        let token = SecurityArguments { token_file: Some(file.path().into()), ..SecurityArguments::default() };
        assert!(Security::new(&token, anywhere).is_ok());
    }
}
