//! The evaluations of a run, clip by clip, as a heat map: what the policy has learned, and what it has forgotten.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::Path;

use anyhow::{Context, Result, anyhow};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::evaluations::{self, Line};

/// Pixels of the whole picture.
const WIDTH: u32 = 1000;
/// Pixels of a clip.
const ROW_HEIGHT: u32 = 16;
/// Pixels above and below the rows: title, margins, the axis with its labels.
const FRAME_HEIGHT: u32 = 90;
/// Pixels of the smallest height of all rows together. The colour bar needs them.
const LEAST_HEIGHT: u32 = 120;
/// Pixels on the right for the colour bar and its labels.
const BAR_WIDTH: u32 = 80;
/// Rectangles of the colour bar.
const BAR_PIECES: u8 = 50;

/// matplotlib's viridis at 0, 0.25, 0.5, 0.75 and 1. Its brightness rises evenly, so it is also readable in grey.
const COLOURS: [(u8, u8, u8); 5] = [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)];

/// Draws the evaluations without noise in the file `evaluations`: a row for each clip, a column for each evaluation. Returns
/// whether it drew: there is no picture of one clip, or without an evaluation.
///
/// # Errors
/// The file cannot be read, or `out` cannot be written.
pub(crate) fn draw(evaluations: &Path, out: &Path) -> Result<bool> {
    let map = HeatMap::of(&evaluations::read(evaluations)?);
    if map.rows.len() < 2 {
        return Ok(false);
    }
    map.draw(out).with_context(|| format!("cannot draw {}", out.display()))?;
    Ok(true)
}

/// The normalised rewards of a run's clips.
struct HeatMap {
    /// The columns' edges, million environment steps: one more than columns.
    edges: Vec<f64>,
    /// From the bottom to the top: each clip with its value in each column. The newest values increase.
    rows: Vec<(String, Vec<Option<f64>>)>,
}

impl HeatMap {
    /// A column for each line. The lines are in the order of their environment steps.
    fn of(lines: &[Line]) -> Self {
        let mut rows: BTreeMap<&str, Vec<Option<f64>>> = BTreeMap::new();
        for (column, line) in lines.iter().enumerate() {
            for clip in &line.evaluation.clips {
                let values = rows.entry(&clip.clip).or_insert_with(|| vec![None; lines.len()]);
                values[column] = Some(clip.normalised_reward);
            }
        }
        let mut rows: Vec<_> = rows.into_iter().map(|(clip, values)| (clip.to_owned(), values)).collect();
        let newest = |values: &[Option<f64>]| values.iter().rev().find_map(|value| *value).unwrap_or_default();
        rows.sort_by(|(_, one), (_, other)| newest(one).total_cmp(&newest(other)));
        let steps: Vec<f64> = lines.iter().map(|line| line.environment_steps as f64 / 1e6).collect();
        // A column reaches half-way to its neighbours, the first one to the beginning of the run.
        let between = steps.windows(2).map(|pair| f64::midpoint(pair[0], pair[1]));
        let edges = [0.0].into_iter().chain(between).chain(steps.last().copied()).collect();
        Self { edges, rows }
    }

    fn draw(&self, out: &Path) -> Result<()> {
        let height = (self.rows.len() as u32 * ROW_HEIGHT).max(LEAST_HEIGHT) + FRAME_HEIGHT;
        let root = SVGBackend::new(out, (WIDTH, height)).into_drawing_area();
        root.fill(&WHITE).map_err(failed)?;
        let letters = self.rows.iter().map(|(clip, _)| clip.chars().count()).max().unwrap_or_default();
        let end = self.edges.last().copied().unwrap_or_default();
        let mut chart = ChartBuilder::on(&root)
            .caption("normalised reward of each clip (without noise)", ("sans-serif", 15))
            .margin(12)
            .margin_right(BAR_WIDTH)
            .x_label_area_size(36)
            .y_label_area_size((7 * letters as u32 + 12).min(WIDTH / 3))
            .build_cartesian_2d(0.0..end, 0.0..self.rows.len() as f64)
            .map_err(failed)?;
        chart
            .configure_mesh()
            .disable_mesh()
            .disable_y_axis()
            .x_desc("million environment steps")
            .draw()
            .map_err(failed)?;
        let name = label(HPos::Right);
        for (row, (clip, values)) in self.rows.iter().enumerate() {
            let bottom = row as f64;
            let cells = values.iter().zip(self.edges.windows(2)).filter_map(|(value, edges)| {
                let colour = colour((*value)?);
                Some(Rectangle::new([(edges[0], bottom), (edges[1], bottom + 1.0)], colour.filled()))
            });
            chart.draw_series(cells).map_err(failed)?;
            let (x, y) = chart.plotting_area().map_coordinate(&(0.0, bottom + 0.5));
            root.draw_text(clip, &name, (x - 6, y)).map_err(failed)?;
        }
        // The colour bar is as high as the rows.
        let (columns, rows) = chart.plotting_area().get_pixel_range();
        let left = columns.end + 16;
        let y = |value: f64| rows.end - (f64::from(rows.end - rows.start) * value).round() as i32;
        for piece in 0..BAR_PIECES {
            let [from, to] = [piece, piece + 1].map(|edge| f64::from(edge) / f64::from(BAR_PIECES));
            let colour = colour(f64::midpoint(from, to));
            root.draw(&Rectangle::new([(left, y(to)), (left + 14, y(from))], colour.filled())).map_err(failed)?;
        }
        for value in [0.0, 0.5, 1.0] {
            root.draw_text(&format!("{value:.1}"), &label(HPos::Left), (left + 20, y(value))).map_err(failed)?;
        }
        root.present().map_err(failed)
    }
}

/// The style of names and numbers, which stand beside their point at this side.
fn label(side: HPos) -> TextStyle<'static> {
    TextStyle::from(("sans-serif", 13).into_font()).pos(Pos::new(side, VPos::Center))
}

/// The colour of a normalised reward: dark is 0, light is 1.
fn colour(value: f64) -> RGBColor {
    let place = value.clamp(0.0, 1.0) * (COLOURS.len() - 1) as f64;
    let below = (place as usize).min(COLOURS.len() - 2);
    let share = place - below as f64;
    let mix = |low: u8, high: u8| (f64::from(low) + share * (f64::from(high) - f64::from(low))).round() as u8;
    let (low, high) = (COLOURS[below], COLOURS[below + 1]);
    RGBColor(mix(low.0, high.0), mix(low.1, high.1), mix(low.2, high.2))
}

fn failed(error: impl Display) -> anyhow::Error {
    anyhow!("{error}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(text: &[String]) -> Vec<Line> {
        text.iter().map(|line| Line::parse(line).unwrap()).collect()
    }

    #[test]
    fn clips_are_sorted_by_their_newest_value_with_the_best_at_the_top() {
        let first = evaluations::example(1_000_000, &[("crawl", 0.9), ("run", 0.5), ("walk", 0.25)]);
        let second = evaluations::example(3_000_000, &[("run", 0.25), ("walk", 0.75)]);
        let map = HeatMap::of(&lines(&[first, second]));
        assert_eq!(
            map.rows,
            [
                ("run".to_owned(), vec![Some(0.5), Some(0.25)]),
                ("walk".to_owned(), vec![Some(0.25), Some(0.75)]),
                ("crawl".to_owned(), vec![Some(0.9), None]),
            ]
        );
        assert_eq!(map.edges, [0.0, 2.0, 3.0]);
    }

    #[test]
    fn the_colours_reach_from_dark_to_light() {
        assert_eq!(
            [-1.0, 0.0, 0.5, 1.0, 2.0].map(colour),
            [
                RGBColor(68, 1, 84),
                RGBColor(68, 1, 84),
                RGBColor(33, 145, 140),
                RGBColor(253, 231, 37),
                RGBColor(253, 231, 37),
            ]
        );
        assert_eq!(colour(0.125), RGBColor(64, 42, 112));
    }

    #[test]
    fn several_clips_are_drawn_with_their_names_and_one_clip_is_not() {
        let directory = tempfile::tempdir().unwrap();
        let (path, out) = (directory.path().join(evaluations::FILE), directory.path().join("clips.svg"));
        assert!(!draw(&path, &out).unwrap(), "there is no file");
        std::fs::write(&path, evaluations::example(1_000_000, &[("walk", 0.5)])).unwrap();
        assert!(!draw(&path, &out).unwrap());
        std::fs::write(&path, evaluations::example(1_000_000, &[("walk", 0.0), ("run", 1.0)])).unwrap();
        assert!(draw(&path, &out).unwrap());
        let picture = std::fs::read_to_string(out).unwrap();
        for part in ["walk", "run", "million environment steps", "#440154", "#FDE725", "0.5"] {
            assert!(picture.contains(part), "{part} is missing");
        }
    }
}
