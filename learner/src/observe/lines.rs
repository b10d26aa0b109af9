//! Lines of a file that earlier learner epochs wrote.

use std::fs::File;
use std::io::{self, BufRead as _, BufReader, Read as _};
use std::path::Path;

/// Bytes of the longest line that is read. A report comes in one message, and most are far smaller.
const LONGEST: u64 = 64 << 20;

/// Calls `each` with every line of a file, one after another, so that a long run takes no memory. A line that is too long is
/// left out. A file that does not exist has no lines.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn for_each(path: &Path, each: impl FnMut(&[u8])) -> io::Result<()> {
    for_each_up_to(LONGEST, path, each)
}

fn for_each_up_to(longest: u64, path: &Path, mut each: impl FnMut(&[u8])) -> io::Result<()> {
    let file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        file => file?,
    };
    let length = file.metadata()?.len();
    let mut reader = BufReader::new(file.take(length));
    let mut line = Vec::new();
    while reader.by_ref().take(longest).read_until(b'\n', &mut line)? > 0 {
        match line.last() {
            Some(b'\n') => each(&line),
            // The file's end, or a line that is too long.
            _ if reader.skip_until(b'\n')? == 0 => each(&line),
            _ => {}
        }
        line.clear();
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(text: &str) -> Vec<String> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("metrics.jsonl");
        std::fs::write(&path, text).unwrap();
        let mut lines = Vec::new();
        for_each_up_to(8, &path, |line| lines.push(String::from_utf8_lossy(line).into_owned())).unwrap();
        lines
    }

    #[test]
    fn a_line_that_is_too_long_is_left_out_and_the_others_are_read() {
        assert_eq!(lines("one\ntwo\n"), ["one\n", "two\n"]);
        assert_eq!(lines("one\n0123456789\n0123456\ntwo"), ["one\n", "0123456\n", "two"]);
        assert_eq!(lines("one\n01234567\ntwo\n"), ["one\n", "two\n"]);
    }

    #[test]
    fn a_file_that_does_not_exist_has_no_lines() {
        let directory = tempfile::tempdir().unwrap();
        for_each(&directory.path().join("none"), |_| panic!("a line")).unwrap();
    }

    #[test]
    fn a_device_without_an_end_has_no_lines() {
        for_each(Path::new("/dev/full"), |_| panic!("a line")).unwrap();
    }
}
