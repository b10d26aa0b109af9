//! Reads a text file line by line, in bounded memory for any content.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};

use crate::error::Error;

/// Greatest length of a line, bytes. CMU's lines are shorter than 200.
const LONGEST: u64 = 4096;

/// The lines of a file, with the number of the current line for errors.
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

    /// The words of the next line that is not empty and does not begin with `#`; `None` at the end.
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
                return Err(self.error(format!("a line of {LONGEST} bytes or more: is this a text file?")));
            }
            // Only comments have characters that are not ASCII.
            let line = String::from_utf8_lossy(&line);
            let words: Vec<String> = line.split_whitespace().map(String::from).collect();
            if words.first().is_some_and(|word| !word.starts_with('#')) {
                return Ok(Some(words));
            }
        }
    }

    /// An error about the line that was read last.
    pub(super) fn error(&self, reason: impl Into<String>) -> Error {
        Error::Line { path: self.path.clone(), line: self.number, reason: reason.into() }
    }

    /// Parses a number. Its absolute value is at most a million; lengths and angles of recordings are far smaller.
    pub(super) fn number(&self, word: &str) -> Result<f64, Error> {
        match word.parse::<f64>() {
            Ok(number) if number.abs() <= 1e6 => Ok(number),
            Ok(number) => Err(self.error(format!("{number} is too large for a length or angle of a recording"))),
            Err(_) => Err(self.error(format!("`{word}` is not a number"))),
        }
    }
}
