//! Animated GIF, 256 colours a frame.

use std::fs::File;
use std::io::{self, BufWriter};
use std::time::Duration;

use ::gif::{EncodingError, Frame, Repeat};
use comic_tasks::film::Size;

use super::{Clock, Encoder, written};

/// Between 1 (slow, best colours) and 30: the quantiser's own recommendation.
const QUANTISER_SPEED: i32 = 10;

pub(super) struct Gif {
    encoder: ::gif::Encoder<BufWriter<File>>,
    size: Size,
    clock: Clock,
}

impl Gif {
    pub(super) fn new(file: File, size: Size, frame_time: Duration) -> io::Result<Self> {
        let mut encoder =
            ::gif::Encoder::new(BufWriter::new(file), size.width(), size.height(), &[]).map_err(failed)?;
        encoder.set_repeat(Repeat::Infinite).map_err(failed)?;
        Ok(Self { encoder, size, clock: Clock::new(frame_time, Duration::from_millis(10)) })
    }
}

impl Encoder for Gif {
    fn frame(&mut self, picture: &[u8]) -> io::Result<()> {
        let mut frame = Frame::from_rgb_speed(self.size.width(), self.size.height(), picture, QUANTISER_SPEED);
        frame.delay = u16::try_from(self.clock.tick()).unwrap_or(u16::MAX);
        self.encoder.write_frame(&frame).map_err(failed)
    }

    fn finish(self: Box<Self>) -> io::Result<()> {
        written(self.encoder.into_inner().map_err(failed)?)
    }
}

fn failed(error: EncodingError) -> io::Error {
    match error {
        EncodingError::Io(error) => error,
        other => io::Error::other(other),
    }
}
