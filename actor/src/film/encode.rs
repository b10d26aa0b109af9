//! Writes pictures into a film; the file's extension chooses the format.

mod gif;
mod mp4;
mod sheet;
mod webp;

use std::fs::File;
use std::io;
use std::path::Path;
use std::time::Duration;

use crate::Error;
use crate::output_file::OutputFile;
use comic_tasks::film::Size;

/// The format of a film.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// 256 colours a frame.
    Gif,
    /// All colours, without loss.
    WebP,
    /// Through ffmpeg.
    Mp4,
    /// A contact sheet: frames from begin to end, side by side.
    Png,
}

impl Format {
    /// The format of the file at `path`.
    ///
    /// # Errors
    /// [`Error::Usage`] when it has none of the known extensions.
    pub fn of(path: &Path) -> Result<Self, Error> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        match extension.as_str() {
            "gif" => Ok(Self::Gif),
            "webp" => Ok(Self::WebP),
            "mp4" => Ok(Self::Mp4),
            "png" => Ok(Self::Png),
            _ => Err(Error::Usage(format!(
                "{}: its extension names no film; known are .html (a page), .gif, .webp, .mp4 (through ffmpeg) and .png (a \
                 contact sheet)",
                path.display()
            ))),
        }
    }

    /// The default size of a picture: smaller in formats with large files, and for a tile of a contact sheet.
    pub fn usual_size(self) -> &'static str {
        match self {
            Self::Gif | Self::WebP => "400x300",
            Self::Png => "320x240",
            Self::Mp4 => "640x480",
        }
    }
}

/// Takes pictures of [`Size::bytes`] bytes each, in display order.
trait Encoder {
    fn frame(&mut self, picture: &[u8]) -> io::Result<()>;

    /// Writes the rest.
    fn finish(self: Box<Self>) -> io::Result<()>;
}

/// A film that is being written. The pictures go to a temporary file in the same directory. It gets its name when the film
/// is finished, and is removed when the film is dropped before.
pub struct Movie {
    // Declared before the file, so that it is dropped before the file is removed.
    encoder: Box<dyn Encoder>,
    file: OutputFile,
}

impl Movie {
    /// Begins a film of pictures of `size`, shown `frame_time` each.
    ///
    /// # Errors
    /// [`Error::Usage`] for an unknown extension or a missing ffmpeg, [`Error::File`] when the file cannot be made.
    pub fn create(out: &Path, size: Size, frame_time: Duration) -> Result<Self, Error> {
        let format = Format::of(out)?;
        let file = OutputFile::create(out).map_err(Error::file(out))?;
        let writer = || file.file().try_clone().map_err(Error::file(out));
        let encoder: Box<dyn Encoder> = match format {
            Format::Gif => Box::new(gif::Gif::new(writer()?, size, frame_time).map_err(Error::file(out))?),
            Format::WebP => Box::new(webp::WebP::new(writer()?, size, frame_time).map_err(Error::file(out))?),
            Format::Png => Box::new(sheet::Sheet::new(writer()?, size)),
            Format::Mp4 => Box::new(mp4::Mp4::new(file.path(), size, frame_time)?),
        };
        Ok(Self { encoder, file })
    }

    /// Adds a picture.
    ///
    /// # Errors
    /// [`Error::File`] when it cannot be written.
    pub fn frame(&mut self, picture: &[u8]) -> Result<(), Error> {
        self.encoder.frame(picture).map_err(Error::file(self.file.out()))
    }

    /// Finishes the film and gives the file its name.
    ///
    /// # Errors
    /// [`Error::File`] when it cannot be written.
    pub fn finish(self) -> Result<(), Error> {
        let Self { encoder, file } = self;
        let out = file.out().to_path_buf();
        encoder.finish().map_err(Error::file(&out))?;
        file.finish().map_err(Error::file(&out))
    }
}

/// Times at which frames change, in a format's own units. Rounding errors do not add up.
struct Clock {
    frame_time: Duration,
    unit: Duration,
    frames: u32,
}

impl Clock {
    fn new(frame_time: Duration, unit: Duration) -> Self {
        Self { frame_time, unit, frames: 0 }
    }

    /// Units for which the next frame is shown.
    fn tick(&mut self) -> u32 {
        let at = |frames: u32| (f64::from(frames) * self.frame_time.as_secs_f64() / self.unit.as_secs_f64()).round();
        let begin = at(self.frames);
        self.frames = self.frames.saturating_add(1);
        (at(self.frames) - begin).max(1.0) as u32
    }
}

/// Flushes a buffered writer.
fn written(writer: io::BufWriter<File>) -> io::Result<()> {
    writer.into_inner().map(drop).map_err(io::IntoInnerError::into_error)
}

#[cfg(test)]
mod tests;
