//! Tokens, compared in constant time.

use std::path::Path;

use comic_proto::Token;
use sha2::{Digest as _, Sha256};
use subtle::{Choice, ConstantTimeEq as _};

use super::watched::Watched;
use crate::error::Result;

/// The tokens of a file, or the token of the environment. Only their SHA-256 is kept. While the file is gone or cannot be used,
/// no token is accepted: who deletes it wants to refuse its tokens.
#[derive(Debug)]
pub struct Tokens(Watched<Vec<[u8; 32]>>);

/// The SHA-256 of an accepted token.
#[derive(Clone, Copy, Debug)]
pub struct Shown([u8; 32]);

impl Tokens {
    /// The tokens in `file`, which may change later, or the one in `COMIC_TOKEN`; `None` without either.
    ///
    /// # Errors
    /// [`Error::Access`](crate::error::Error::Access) when there is no usable token where there should be.
    pub fn new(file: Option<&Path>) -> Result<Option<Self>> {
        let path = file.map(Path::to_path_buf);
        let files = path.iter().cloned().collect();
        let load = move || {
            let tokens = Token::read(path.as_deref())?;
            Ok(tokens.iter().map(|token| Sha256::digest(token.secret()).into()).collect::<Vec<[u8; 32]>>())
        };
        let watched = Watched::new(files, load)?;
        Ok(if watched.last_usable().is_empty() { None } else { Some(Self(watched)) })
    }

    /// The token in the header `authorization`, if it is one of the tokens.
    pub fn accept(&self, authorization: Option<&[u8]>) -> Option<Shown> {
        let shown = Shown(Sha256::digest(authorization?.strip_prefix(b"Bearer ")?).into());
        self.still_accept(&shown).then_some(shown)
    }

    /// Whether a token is still one of the tokens. All hashes have the same length, and each is compared as a whole. The time
    /// taken therefore does not depend on the length of a token, on how much of it was right, or on which it was.
    pub fn still_accept(&self, shown: &Shown) -> bool {
        let tokens = self.0.current().unwrap_or_default();
        tokens.iter().fold(Choice::from(0), |found, token| found | token.ct_eq(&shown.0)).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_tokens_of_the_file_are_accepted_also_after_it_changed() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "first\nsecond\n").unwrap();
        let tokens = Tokens::new(Some(file.path())).unwrap().unwrap();
        let accepts = |header: &[u8]| tokens.accept(Some(header)).is_some();
        assert!(accepts(b"Bearer first") && accepts(b"Bearer second"));
        for wrong in [&b"first"[..], b"Bearer ", b"Bearer", b"Bearer firs", b"Bearer first ", b"Basic first", b"\xff"] {
            assert!(!accepts(wrong), "{wrong:?}");
        }
        assert!(tokens.accept(None).is_none());
        let shown = tokens.accept(Some(b"Bearer first")).unwrap();
        std::fs::write(file.path(), "third").unwrap();
        assert!(accepts(b"Bearer third") && !accepts(b"Bearer first") && !tokens.still_accept(&shown));
        std::fs::remove_file(file.path()).unwrap();
        assert!(!accepts(b"Bearer third"));
    }
}
