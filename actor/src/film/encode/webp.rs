//! Animated WebP without loss: each frame is a still image of the `image-webp` crate, which writes no animations; this
//! file writes the container around them (WebP Container Specification, "Animation").

use std::fs::File;
use std::io::{self, BufWriter, Seek as _, SeekFrom, Write as _};
use std::time::Duration;

use comic_tasks::film::Size;
use image_webp::{ColorType, WebPEncoder};

use super::{Clock, Encoder, written};

/// Bytes before the chunks of a file: `RIFF`, the file's size, `WEBP`.
const HEADER: usize = 12;
/// Flag of `VP8X`: the file is an animation.
const ANIMATION: u8 = 0b10;
/// Flag of `ANMF`: the frame replaces the one before.
const NO_BLENDING: u8 = 0b10;
/// Bytes of `ANMF` before the image's own chunks.
const FRAME_HEADER: u32 = 16;

pub(super) struct WebP {
    writer: BufWriter<File>,
    size: Size,
    clock: Clock,
}

impl WebP {
    pub(super) fn new(file: File, size: Size, frame_time: Duration) -> io::Result<Self> {
        let mut writer = BufWriter::new(file);
        // The file's size is written at the end.
        writer.write_all(b"RIFF\0\0\0\0WEBP")?;
        writer.write_all(b"VP8X\x0a\0\0\0")?;
        writer.write_all(&[ANIMATION, 0, 0, 0])?;
        writer.write_all(&canvas(size))?;
        // A black background, and endless repetition.
        writer.write_all(b"ANIM\x06\0\0\0\0\0\0\xff\0\0")?;
        Ok(Self { writer, size, clock: Clock::new(frame_time, Duration::from_millis(1)) })
    }
}

impl Encoder for WebP {
    fn frame(&mut self, picture: &[u8]) -> io::Result<()> {
        let mut still = Vec::new();
        let (width, height) = (self.size.width().into(), self.size.height().into());
        WebPEncoder::new(&mut still).encode(picture, width, height, ColorType::Rgb8).map_err(io::Error::other)?;
        let chunks = still.get(HEADER..).unwrap_or_default();
        let length = u32::try_from(chunks.len()).map_err(io::Error::other)?;
        let end = self.writer.stream_position()? + u64::from(length) + u64::from(FRAME_HEADER) + 8;
        if end > u64::from(u32::MAX) {
            let remedy = "ask for an .mp4, fewer --seconds, a smaller --size or less --fps";
            return Err(io::Error::other(format!("a WebP file has at most 4 GiB: {remedy}")));
        }
        self.writer.write_all(b"ANMF")?;
        self.writer.write_all(&(FRAME_HEADER + length).to_le_bytes())?;
        // At the canvas's corner.
        self.writer.write_all(&[0; 6])?;
        self.writer.write_all(&canvas(self.size))?;
        self.writer.write_all(&self.clock.tick().to_le_bytes()[..3])?;
        self.writer.write_all(&[NO_BLENDING])?;
        self.writer.write_all(chunks)
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        let length = self.writer.stream_position()?;
        let length = u32::try_from(length - 8).map_err(|_| io::Error::other("a WebP file has at most 4 GiB"))?;
        self.writer.seek(SeekFrom::Start(4))?;
        self.writer.write_all(&length.to_le_bytes())?;
        written(self.writer)
    }
}

/// Width and height less one, three bytes each.
fn canvas(size: Size) -> [u8; 6] {
    let [[a, b], [c, d]] = [size.width() - 1, size.height() - 1].map(u16::to_le_bytes);
    [a, b, 0, c, d, 0]
}
