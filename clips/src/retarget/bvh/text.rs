//! Reads a BVH file line by line, in bounded memory for any content.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};

use crate::error::Error;

/// Greatest length of a line, bytes. A frame of 100 joints with six channels has about 7,000.
const LONGEST_LINE: u64 = 1 << 17;
/// Greatest length of a file, bytes. Ten minutes of 100 joints at 120 Hz have about 500 million bytes.
const LONGEST_FILE: u64 = 1 << 30;
/// Greatest length of the reason of an error, characters: it may repeat a word of the file.
const LONGEST_REASON: usize = 500;
/// Greatest absolute value of a number. Lengths in mm and angles in degrees are far smaller.
const LARGEST: f64 = 1e6;

/// The lines of a file, with the number of the current line for errors.
pub(super) struct Text {
    path: PathBuf,
    reader: BufReader<File>,
    number: usize,
    bytes: u64,
}

impl Text {
    pub(super) fn open(path: &Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(|reason| Error::Unreadable { path: path.into(), reason })?;
        Ok(Self { path: path.into(), reader: BufReader::new(file), number: 0, bytes: 0 })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// The next line that is not empty; `None` at the end. Names that are not UTF-8 keep their ASCII characters.
    pub(super) fn next_line(&mut self) -> Result<Option<String>, Error> {
        loop {
            let mut line = Vec::new();
            let unreadable = |reason| Error::Unreadable { path: self.path.clone(), reason };
            let read = self.reader.by_ref().take(LONGEST_LINE).read_until(b'\n', &mut line).map_err(unreadable)? as u64;
            if read == 0 {
                return Ok(None);
            }
            self.number += 1;
            self.bytes += read;
            if read == LONGEST_LINE {
                return Err(self.error(format!("a line of {LONGEST_LINE} bytes or more: is this a BVH file?")));
            }
            if self.bytes > LONGEST_FILE {
                return Err(self.error(format!("more than {LONGEST_FILE} bytes: shorten the recording")));
            }
            // A file of Windows can begin with a byte order mark.
            let line = if self.number == 1 { line.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&line) } else { &line };
            let line = String::from_utf8_lossy(line);
            if !line.trim().is_empty() {
                return Ok(Some(line.trim().into()));
            }
        }
    }

    /// An error about the line that was read last. Control characters of the file do not reach a terminal.
    pub(super) fn error(&self, reason: impl Into<String>) -> Error {
        let printed = |letter: char| if letter.is_control() { char::REPLACEMENT_CHARACTER } else { letter };
        let reason = reason.into().chars().take(LONGEST_REASON).map(printed).collect();
        Error::Line { path: self.path.clone(), line: self.number, reason }
    }

    pub(super) fn number(&self, word: &str) -> Result<f64, Error> {
        match word.parse::<f64>() {
            Ok(number) if number.abs() <= LARGEST => Ok(number),
            Ok(number) if number.is_finite() => {
                Err(self.error(format!("{number} is too large for a length or angle of a recording")))
            }
            Ok(number) => Err(self.error(format!("{number}: expected a finite number"))),
            Err(_) if word.contains(',') => {
                Err(self.error(format!("`{word}` is not a number; decimals have a point: 0.5")))
            }
            Err(_) => Err(self.error(format!("`{word}` is not a number"))),
        }
    }
}
