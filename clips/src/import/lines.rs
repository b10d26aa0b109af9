//! A text file, line by line, whatever it holds.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};

use crate::error::Error;

/// Longest line taken, bytes; CMU's are below 200.
const LONGEST: u64 = 4096;

/// Reads lines with bounded memory and knows where it is.
pub(super) struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    number: usize,
}

impl Lines {
    pub(super) fn open(path: &Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(|reason| Error::Unreadable { path: path.into(), reason })?;
        Ok(Self { path: path.into(), reader: BufReader::new(file), number: 0 })
    }

    /// The words of the next line that has any and does not begin with `#`, or `None` at the end.
    pub(super) fn next_words(&mut self) -> Result<Option<Vec<String>>, Error> {
        loop {
            let mut line = Vec::new();
            let unreadable = |reason| Error::Unreadable { path: self.path.clone(), reason };
            let read = self.reader.by_ref().take(LONGEST).read_until(b'\n', &mut line).map_err(unreadable)?;
            if read == 0 {
                return Ok(None);
            }
            self.number += 1;
            if read as u64 == LONGEST {
                return Err(self.error(format!("over {LONGEST} bytes in a line: is this a text file?")));
            }
            // Only comments hold anything beside ASCII.
            let line = String::from_utf8_lossy(&line);
            let words: Vec<String> = line.split_whitespace().map(String::from).collect();
            if words.first().is_some_and(|word| !word.starts_with('#')) {
                return Ok(Some(words));
            }
        }
    }

    /// What is wrong with the line read last.
    pub(super) fn error(&self, reason: impl Into<String>) -> Error {
        Error::Line { path: self.path.clone(), line: self.number, reason: reason.into() }
    }

    /// A number of at most a million, which is beyond any length or angle of a recording.
    pub(super) fn number(&self, word: &str) -> Result<f64, Error> {
        match word.parse::<f64>() {
            Ok(number) if number.abs() <= 1e6 => Ok(number),
            Ok(number) => Err(self.error(format!("{number} is no length or angle of a recording"))),
            Err(_) => Err(self.error(format!("`{word}` is no number"))),
        }
    }
}
