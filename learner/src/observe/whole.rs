//! A file that grows by whole records.

use std::fs::{File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::FileExt as _;
use std::path::Path;

/// Bytes that are read at once in search of the last line's end.
const BLOCK: u64 = 64 * 1024;

/// A file that is only appended to, by whole records: a reader stops at half a record.
#[derive(Debug)]
pub(super) struct Whole {
    file: File,
    /// Bytes of whole records.
    length: u64,
    /// Whether there may be a part of a record behind them.
    torn: bool,
}

impl Whole {
    /// Opens the file, or makes it.
    ///
    /// # Errors
    /// When it cannot be opened.
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().create(true).read(true).append(true).open(path)?;
        Ok(Self { length: file.metadata()?.len(), file, torn: false })
    }

    /// Opens a file of lines. A last line that a kill cut off is removed.
    ///
    /// # Errors
    /// When it cannot be opened or repaired.
    pub(super) fn open_lines(path: &Path) -> io::Result<Self> {
        let mut whole = Self::open(path)?;
        let lines = end_of_lines(&whole.file, whole.length)?;
        if lines < whole.length {
            tracing::warn!("{}: the last line is cut off, and is removed", path.display());
            whole.file.set_len(lines)?;
            whole.length = lines;
        }
        Ok(whole)
    }

    /// Appends all of these bytes or none.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(super) fn append(&mut self, record: &[u8]) -> io::Result<()> {
        if self.torn {
            self.file.set_len(self.length)?;
            self.torn = false;
        }
        let written = self.file.write_all(record);
        match &written {
            Ok(()) => self.length += record.len() as u64,
            Err(_) => self.torn = self.file.set_len(self.length).is_err(),
        }
        written
    }
}

/// The number of bytes up to the end of the last whole line.
fn end_of_lines(file: &File, length: u64) -> io::Result<u64> {
    let mut end = length;
    while end > 0 {
        let begin = end.saturating_sub(BLOCK);
        let mut block = vec![0; (end - begin) as usize];
        file.read_exact_at(&mut block, begin)?;
        if let Some(last) = block.iter().rposition(|byte| *byte == b'\n') {
            return Ok(begin + last as u64 + 1);
        }
        end = begin;
    }
    Ok(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_last_line_that_was_cut_off_is_removed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        let long = "x".repeat(3 * BLOCK as usize);
        for (left, whole) in [
            (String::new(), String::new()),
            ("torn".into(), String::new()),
            ("one\ntwo\n".into(), "one\ntwo\n".into()),
            ("one\ntw".into(), "one\n".into()),
            (format!("one\n{long}"), "one\n".into()),
            (format!("{long}\n{long}"), format!("{long}\n")),
        ] {
            std::fs::write(&path, left).unwrap();
            Whole::open_lines(&path).unwrap().append(b"next\n").unwrap();
            assert!(std::fs::read_to_string(&path).unwrap() == format!("{whole}next\n"));
        }
    }
}
