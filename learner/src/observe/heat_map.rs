//! A picture of a run's evaluations: a row for each clip, a column for each evaluation, and the normalised reward as colour.

use std::io;

use crate::observe::thinned::{Entry, Thinned};

/// Most columns. When there would be more, each two neighbours become one.
const COLUMNS: usize = 256;
/// Most rows.
const ROWS: usize = 256;
/// Pixels of the longer side, as far as a cell's limits allow.
const SIDE: usize = 512;
/// Pixels of a cell's side.
const SMALLEST_CELL: usize = 4;
const LARGEST_CELL: usize = 16;
/// The level of a cell without a result.
const GAP: u8 = 0;
/// The levels of the rewards 0 and 1.
const LOWEST: u8 = 1;
const HIGHEST: u8 = u8::MAX;
/// A grey that the other colours do not contain.
const GAP_COLOUR: [u8; 3] = [128, 128, 128];
/// RGB of the rewards 0, 0.25, 0.5, 0.75 and 1: matplotlib's viridis, whose lightness grows evenly.
const COLOURS: [[u8; 3]; 5] = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

/// An encoded picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Png {
    /// Width and height, pixels.
    pub(super) size: (u16, u16),
    /// The PNG file.
    pub(super) bytes: Vec<u8>,
}

/// The normalised rewards of the evaluations so far, in at most 256 columns and 256 rows. Evaluations that share a column are
/// shown by the newest of them.
#[derive(Clone, Debug)]
pub(super) struct HeatMap {
    /// The rows: clips in the order in which reports named them first.
    clips: Vec<String>,
    columns: Thinned<Column>,
}

/// An evaluation, or several neighbours.
#[derive(Clone, Debug)]
struct Column {
    /// The learner epoch and the environment steps.
    place: (u64, u64),
    /// The level of each row.
    levels: [u8; ROWS],
}

impl Entry for Column {
    fn place(&self) -> (u64, u64) {
        self.place
    }

    fn absorb(&mut self, newer: Self) {
        *self = newer;
    }
}

impl HeatMap {
    /// A map without evaluations.
    pub(super) fn new() -> Self {
        Self { clips: Vec::new(), columns: Thinned::new(COLUMNS) }
    }

    /// Adds an evaluation at this learner epoch and these environment steps: clips and their normalised rewards, in the report's
    /// order. Clips for which no row is left are ignored.
    pub(super) fn add(&mut self, place: (u64, u64), rewards: &[(&str, f64)]) {
        let mut levels = [GAP; ROWS];
        for (clip, reward) in rewards.iter().take(ROWS) {
            if let Some(row) = self.row(clip) {
                levels[row] = level(*reward);
            }
        }
        self.columns.add(Column { place, levels });
    }

    /// The clips, a row each.
    pub(super) fn clips(&self) -> &[String] {
        &self.clips
    }

    /// The environment steps of each column and the levels of its rows, oldest first. A level is 0 where there is no result, and
    /// from 1 to 255 for a normalised reward from 0 to 1.
    pub(super) fn columns(&self) -> impl ExactSizeIterator<Item = (u64, &[u8])> {
        self.columns.iter().map(|column| (column.place.1, &column.levels[..self.clips.len()]))
    }

    /// The row of a clip: its own or a new one. `None` if all rows are taken.
    fn row(&mut self, clip: &str) -> Option<usize> {
        let known = self.clips.iter().position(|known| known == clip);
        if known.is_some() || self.clips.len() == ROWS {
            return known;
        }
        self.clips.push(clip.to_owned());
        Some(self.clips.len() - 1)
    }

    /// Draws the map as a PNG of at most 1,024 × 1,024 pixels.
    ///
    /// # Errors
    /// When the map is empty.
    pub(super) fn draw(&self) -> io::Result<Png> {
        let (columns, rows) = (self.columns().len(), self.clips.len());
        let cell = (SIDE / columns.max(rows).max(1)).clamp(SMALLEST_CELL, LARGEST_CELL);
        let (width, height) = (columns * cell, rows * cell);
        let mut pixels = Vec::with_capacity(width * height);
        for row in 0..rows {
            let levels = self.columns().map(|(_, levels)| levels[row]);
            let line: Vec<u8> = levels.flat_map(|level| std::iter::repeat_n(level, cell)).collect();
            for _ in 0..cell {
                pixels.extend_from_slice(&line);
            }
        }
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_palette(palette());
        let mut image = encoder.write_header()?;
        image.write_image_data(&pixels)?;
        image.finish()?;
        Ok(Png { size: (width as u16, height as u16), bytes })
    }
}

/// The level of a normalised reward. Rewards below 0 and above 1 count as 0 and 1.
fn level(reward: f64) -> u8 {
    let levels = f64::from(HIGHEST - LOWEST);
    LOWEST + (reward.clamp(0.0, 1.0) * levels).round() as u8
}

/// The colour of each level, RGB.
fn palette() -> Vec<u8> {
    let share = |level: u8| f64::from(level - LOWEST) / f64::from(HIGHEST - LOWEST);
    let colours = (LOWEST..=HIGHEST).flat_map(|level| colour(share(level)));
    GAP_COLOUR.into_iter().chain(colours).collect()
}

/// The colour of a reward from 0 to 1, between its neighbours in [`COLOURS`].
fn colour(reward: f64) -> [u8; 3] {
    let place = reward * (COLOURS.len() - 1) as f64;
    let lower = (place as usize).min(COLOURS.len() - 2);
    let share = place - lower as f64;
    std::array::from_fn(|channel| {
        let (from, to) = (f64::from(COLOURS[lower][channel]), f64::from(COLOURS[lower + 1][channel]));
        (from + share * (to - from)).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The colours of the cells, row by row, and the pixels of a cell's side.
    fn cells(png: &Png, columns: usize) -> (Vec<[u8; 3]>, usize) {
        let mut decoder = png::Decoder::new(io::Cursor::new(png.bytes.as_slice()));
        decoder.set_transformations(png::Transformations::EXPAND);
        let mut image = decoder.read_info().unwrap();
        let (width, height) = (image.info().width as usize, image.info().height as usize);
        assert_eq!((width, height), (usize::from(png.size.0), usize::from(png.size.1)));
        let mut pixels = vec![0; image.output_buffer_size().unwrap()];
        image.next_frame(&mut pixels).unwrap();
        let cell = width / columns;
        let middles = |length: usize| (cell / 2..length).step_by(cell);
        let pixel = |y: usize, x: usize| -> [u8; 3] {
            let first = 3 * (y * width + x);
            [pixels[first], pixels[first + 1], pixels[first + 2]]
        };
        let colours = middles(height).flat_map(|y| middles(width).map(move |x| (y, x))).map(|(y, x)| pixel(y, x));
        (colours.collect(), cell)
    }

    #[test]
    fn rows_are_clips_and_columns_are_evaluations_oldest_left() {
        let mut map = HeatMap::new();
        map.add((1, 10), &[("walk", 0.0), ("run", 0.5)]);
        map.add((1, 20), &[("run", 1.0), ("jump", -3.0)]);
        let (colours, cell) = cells(&map.draw().unwrap(), 2);
        let [dark, _, middle, _, bright] = COLOURS;
        assert_eq!(colours, [dark, GAP_COLOUR, middle, bright, GAP_COLOUR, dark]);
        assert_eq!(cell, LARGEST_CELL);
    }

    #[test]
    fn a_higher_reward_is_brighter() {
        // Rec. 709's luma.
        let luma = |[red, green, blue]: [u8; 3]| {
            0.2126 * f64::from(red) + 0.7152 * f64::from(green) + 0.0722 * f64::from(blue)
        };
        let lumas: Vec<f64> = (0..=16).map(|step| luma(colour(f64::from(step) / 16.0))).collect();
        assert!(lumas.windows(2).all(|pair| pair[0] + 5.0 < pair[1]), "{lumas:?}");
        assert_eq!((colour(0.0), colour(1.0)), (COLOURS[0], COLOURS[4]));
        assert_eq!((level(f64::NEG_INFINITY), level(f64::INFINITY)), (LOWEST, HIGHEST));
        assert_eq!(palette().len(), 3 * 256);
    }

    #[test]
    fn the_history_stays_bounded_and_shows_the_newest_evaluation() {
        let mut map = HeatMap::new();
        for evaluation in 0..1000 {
            let reward = evaluation as f64 / 999.0;
            map.add((1, evaluation), &[("walk", reward), ("run", reward)]);
            assert!(map.columns().len() <= COLUMNS, "{evaluation}");
            let (steps, levels) = map.columns().last().unwrap();
            assert_eq!((steps, levels), (evaluation, &[level(reward); 2][..]));
        }
        assert!(map.columns().len() > COLUMNS / 2 && map.columns().is_sorted());
        let picture = map.draw().unwrap();
        assert_eq!(picture.size, ((SMALLEST_CELL * map.columns().len()) as u16, 2 * SMALLEST_CELL as u16));
    }

    #[test]
    fn the_rows_stay_bounded() {
        let names: Vec<String> = (0..600).map(|number| format!("clip {number}")).collect();
        let rewards: Vec<(&str, f64)> = names.iter().map(|name| (name.as_str(), 1.0)).collect();
        let mut map = HeatMap::new();
        map.add((1, 10), &rewards[..300]);
        map.add((1, 20), &rewards[300..]);
        assert_eq!(map.clips(), &names[..ROWS]);
        assert_eq!(map.columns().nth(1), Some((20, &[GAP; ROWS][..])), "no row was left");
    }
}
