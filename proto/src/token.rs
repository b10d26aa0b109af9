//! Bearer tokens. They are secret and never printed.

use std::fmt;
use std::path::Path;

use crate::access_error::AccessError;

/// The environment variable with the token, if no file is given.
pub const TOKEN_VARIABLE: &str = "COMIC_TOKEN";

/// A secret that a client sends with every call. Neither `Debug` nor an error message prints it.
#[derive(Clone)]
pub struct Token(String);

impl Token {
    /// The secret.
    pub fn secret(&self) -> &str {
        &self.0
    }

    /// Checks that `text` is valid in a header: visible ASCII, at least one character.
    fn new(text: &str, origin: &str) -> Result<Self, AccessError> {
        if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err(AccessError::Token { origin: origin.to_owned() });
        }
        Ok(Self(text.to_owned()))
    }

    /// The tokens in `file`, one per line. Without a file, the token in `COMIC_TOKEN`, or none. Blank lines are
    /// skipped.
    ///
    /// # Errors
    /// [`AccessError`], if the file cannot be read or has no token, or a token is not valid in a header.
    pub fn read(file: Option<&Path>) -> Result<Vec<Self>, AccessError> {
        let Some(path) = file else {
            return match std::env::var(TOKEN_VARIABLE) {
                Ok(text) => Ok(vec![Self::new(text.trim(), TOKEN_VARIABLE)?]),
                Err(std::env::VarError::NotPresent) => Ok(Vec::new()),
                Err(std::env::VarError::NotUnicode(_)) => Err(AccessError::Token { origin: TOKEN_VARIABLE.into() }),
            };
        };
        let origin = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| AccessError::File { path: path.into(), source })?;
        let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        let tokens = lines.map(|line| Self::new(line, &origin)).collect::<Result<Vec<_>, _>>()?;
        if tokens.is_empty() { Err(AccessError::Token { origin }) } else { Ok(tokens) }
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Token(…)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> Result<Vec<Token>, AccessError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        Token::read(Some(file.path()))
    }

    #[test]
    fn a_file_has_one_token_per_line() {
        let tokens = file("one\n\n  two \n").unwrap();
        assert_eq!(tokens.iter().map(Token::secret).collect::<Vec<_>>(), ["one", "two"]);
    }

    #[test]
    fn an_invalid_token_is_refused_and_not_printed() {
        for text in ["", "\n \n", "half a secret", "schlüssel"] {
            let error = file(text).unwrap_err();
            assert!(matches!(error, AccessError::Token { .. }), "{error:?}");
            let said = format!("{error} {error:?}");
            assert!(text.trim().is_empty() || !said.contains(text.trim()), "{said}");
        }
    }

    #[test]
    fn the_debug_form_does_not_show_the_token() {
        assert_eq!(format!("{:?}", Token("open sesame".into())), "Token(…)");
    }
}
