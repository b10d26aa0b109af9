//! MP4 through the program ffmpeg, which is given raw pictures.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{self, Read as _, Seek as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use comic_tasks::film::Size;

use super::Encoder;
use crate::Error;

const PROGRAM: &str = "ffmpeg";
/// Bytes of its error messages that are shown.
const LONGEST_COMPLAINT: u64 = 4096;

/// A running ffmpeg; it is stopped when this is dropped.
#[derive(Debug)]
pub(super) struct Mp4 {
    child: Child,
    /// Its error messages.
    messages: File,
}

impl Mp4 {
    pub(super) fn new(out: &Path, size: Size, frame_time: Duration) -> Result<Self, Error> {
        let program = find(&std::env::var_os("PATH").unwrap_or_default())?;
        // A file, not a pipe: a full pipe would block ffmpeg.
        let messages = tempfile::tempfile().map_err(Error::file(PROGRAM))?;
        let child = Command::new(&program)
            .args(["-hide_banner", "-loglevel", "error", "-y"])
            .args(["-f", "rawvideo", "-pix_fmt", "rgb24"])
            .args(["-video_size", &format!("{}x{}", size.width(), size.height())])
            .args(["-framerate", &format!("1000000/{}", frame_time.as_micros().max(1))])
            .args(["-i", "-"])
            // Players need yuv420p, for which width and height must be even.
            .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-movflags", "+faststart"])
            .args(["-f", "mp4"])
            .arg(out)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(messages.try_clone().map_err(Error::file(PROGRAM))?)
            .spawn()
            .map_err(Error::file(program))?;
        Ok(Self { child, messages })
    }

    /// Waits for ffmpeg's end; an error has its messages.
    fn end(&mut self) -> io::Result<()> {
        drop(self.child.stdin.take());
        let status = self.child.wait()?;
        if status.success() {
            return Ok(());
        }
        let mut message = String::new();
        self.messages.rewind()?;
        (&self.messages).take(LONGEST_COMPLAINT).read_to_string(&mut message)?;
        Err(io::Error::other(format!("{PROGRAM} failed ({status}): {}", message.trim())))
    }
}

impl Encoder for Mp4 {
    fn frame(&mut self, picture: &[u8]) -> io::Result<()> {
        let Some(pipe) = &mut self.child.stdin else { return Ok(()) };
        match pipe.write_all(picture) {
            // ffmpeg has ended early: its messages say more than a broken pipe.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => self.end().and(Err(error)),
            written => written,
        }
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        self.end()
    }
}

impl Drop for Mp4 {
    fn drop(&mut self) {
        // This does nothing after a wait.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The program, in the directories of `path`.
pub(super) fn find(path: &OsStr) -> Result<PathBuf, Error> {
    let found = std::env::split_paths(path).map(|directory| directory.join(PROGRAM)).find(|program| program.is_file());
    found.ok_or_else(|| {
        Error::Usage(format!(
            "an .mp4 is written through {PROGRAM}, which is not in PATH: install it (Debian's package {PROGRAM}), or ask \
             for a .gif or a .webp, which need nothing"
        ))
    })
}
