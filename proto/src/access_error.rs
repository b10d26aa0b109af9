//! The errors of a client's access to a learner.

use std::io;
use std::path::PathBuf;

/// What is wrong with a client's URL, certificates or token.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AccessError {
    /// The learner's address is no URL.
    #[error("`{url}` is no address of a learner: give one like http://host:7070")]
    Url {
        /// What was given.
        url: String,
    },
    /// `https://`, and nobody to trust.
    #[error("{url} needs --ca FILE, the authority that signed the learner's certificate")]
    NoAuthority {
        /// The learner's address.
        url: String,
    },
    /// An authority, and nothing to check with it.
    #[error("--ca is given, but {url} does not use TLS: write https://")]
    NotSecure {
        /// The learner's address.
        url: String,
    },
    /// A file cannot be read.
    #[error("cannot read {}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// No token, or none that can stand in a header.
    #[error("{origin} holds no usable token: a token is one line of visible ASCII characters without spaces")]
    Token {
        /// File or variable.
        origin: String,
    },
    /// Certificates or keys that are none, or that do not belong together.
    #[error("the certificates cannot be used: {reason}")]
    Tls {
        /// What rustls says.
        reason: String,
    },
}
