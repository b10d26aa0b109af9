//! The errors of a client's access to a learner.

use std::io;
use std::path::PathBuf;

/// An error of a client's URL, certificates or token.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AccessError {
    /// The address of the learner is not a valid URL.
    #[error("`{url}` is not a valid address of a learner: give an address like http://host:7070")]
    Url {
        /// The given address.
        url: String,
    },
    /// The address begins with `https://`, but no authority is given.
    #[error("{url} needs --ca FILE, the authority that signed the learner's certificate")]
    NoAuthority {
        /// The address of the learner.
        url: String,
    },
    /// An authority is given, but the address does not use TLS.
    #[error("--ca is given, but {url} does not use TLS: write https://")]
    NotSecure {
        /// The address of the learner.
        url: String,
    },
    /// A file cannot be read.
    #[error("cannot read {}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// There is no token, or it is not valid in a header.
    #[error("{origin} has no valid token: a token is one line of visible ASCII characters without spaces")]
    Token {
        /// File or variable.
        origin: String,
    },
    /// Certificates or keys are invalid, or do not belong together.
    #[error("the certificates cannot be used: {reason}")]
    Tls {
        /// The message of rustls.
        reason: String,
    },
}
