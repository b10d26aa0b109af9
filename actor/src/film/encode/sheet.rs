//! A contact sheet: frames of a whole film side by side, in one PNG.

use std::fs::File;
use std::io::{self, BufWriter};

use comic_tasks::film::Size;

use super::{Encoder, written};

/// Most columns and rows.
const COLUMNS: usize = 4;
const ROWS: usize = 3;
const TILES: usize = COLUMNS * ROWS;

/// Keeps every n-th frame. When there are twice as many as the sheet has tiles, n doubles and every other frame is
/// dropped, so that memory is bounded for films of any length.
pub(super) struct Sheet {
    file: File,
    size: Size,
    kept: Vec<Vec<u8>>,
    every: usize,
    seen: usize,
}

impl Sheet {
    pub(super) fn new(file: File, size: Size) -> Self {
        Self { file, size, kept: Vec::new(), every: 1, seen: 0 }
    }

    #[cfg(test)]
    pub(super) fn kept(&self) -> usize {
        self.kept.len()
    }

    /// As many tiles as fit, evenly spread over the film.
    pub(super) fn tiles(&self) -> Vec<&[u8]> {
        let count = self.kept.len().min(TILES);
        let place = |tile: usize| tile * (self.kept.len() - 1) / (count - 1).max(1);
        (0..count).map(|tile| self.kept[place(tile)].as_slice()).collect()
    }
}

impl Encoder for Sheet {
    fn frame(&mut self, picture: &[u8]) -> io::Result<()> {
        if self.seen.is_multiple_of(self.every) {
            if self.kept.len() == 2 * TILES {
                let mut place = 0..;
                self.kept.retain(|_| place.next().is_some_and(|place: usize| place.is_multiple_of(2)));
                self.every *= 2;
            }
            // After the doubling this frame may not be kept.
            if self.seen.is_multiple_of(self.every) {
                self.kept.push(picture.to_vec());
            }
        }
        self.seen += 1;
        Ok(())
    }

    fn finish(self: Box<Self>) -> io::Result<()> {
        let tiles = self.tiles();
        if tiles.is_empty() {
            return Err(io::Error::other("a film without a frame"));
        }
        let (columns, rows) = (tiles.len().min(COLUMNS), tiles.len().div_ceil(COLUMNS));
        let row_bytes = 3 * usize::from(self.size.width());
        let mut sheet = vec![0; columns * rows * self.size.bytes()];
        for (number, tile) in tiles.iter().enumerate() {
            let corner = (number / COLUMNS) * columns * self.size.bytes() + (number % COLUMNS) * row_bytes;
            for (row, pixels) in tile.chunks_exact(row_bytes).enumerate() {
                sheet[corner + row * columns * row_bytes..][..row_bytes].copy_from_slice(pixels);
            }
        }
        let (width, height) =
            (columns as u32 * u32::from(self.size.width()), rows as u32 * u32::from(self.size.height()));
        let mut writer = BufWriter::new(self.file.try_clone()?);
        let mut encoder = png::Encoder::new(&mut writer, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut image = encoder.write_header().map_err(io::Error::from)?;
        image.write_image_data(&sheet).map_err(io::Error::from)?;
        image.finish().map_err(io::Error::from)?;
        written(writer)
    }
}
