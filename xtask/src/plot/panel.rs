//! One panel of a picture: axes, lines with their bands, labels.

use std::ops::Range;

use anyhow::{Result, anyhow};
use plotters::coord::Shift;
use plotters::prelude::*;

/// What a line shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// Episodes of training, with the acting policy's noise.
    Training,
    /// Evaluations without noise.
    Evaluation,
}

/// A line with a label, and the band around it.
pub(super) struct Series {
    label: String,
    kind: Kind,
    /// The colour's index. Training and evaluation of the same runs have the same colour.
    colour: usize,
    /// (x, y).
    pub(super) line: Vec<(f64, f64)>,
    /// (x, lower edge, upper edge); empty for a line without a band.
    pub(super) band: Vec<(f64, f64, f64)>,
}

impl Series {
    /// A line without points.
    pub(super) fn new(name: &str, kind: Kind, colour: usize) -> Self {
        let noise = match kind {
            Kind::Training => "with noise",
            Kind::Evaluation => "without noise",
        };
        Self { label: format!("{name} ({noise})"), kind, colour, line: Vec::new(), band: Vec::new() }
    }

    /// The same with these points.
    pub(super) fn with_line(self, points: impl Iterator<Item = (f64, f64)>) -> Self {
        Self { line: points.collect(), ..self }
    }

    /// The band's outline: forward along its upper edge, back along its lower edge.
    fn outline(&self) -> Vec<(f64, f64)> {
        let upper = self.band.iter().map(|(x, _, high)| (*x, *high));
        upper.chain(self.band.iter().rev().map(|(x, low, _)| (*x, *low))).collect()
    }
}

/// Draws the series. Where there is an evaluation, it is stronger than its training's line.
pub(super) fn panel<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    series: &[Series],
    x_label: &str,
    y_label: &str,
) -> Result<()> {
    let outlines: Vec<_> = series.iter().map(Series::outline).collect();
    let points = || series.iter().map(|series| &series.line).chain(&outlines).flatten();
    let x_range = 0.0..points().map(|point| point.0).fold(1e-6, f64::max);
    let y_range = range_of(points().map(|point| point.1));
    let failed = |error: String| anyhow!(error);
    let mut chart = ChartBuilder::on(area)
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(x_range, y_range)
        .map_err(|error| failed(error.to_string()))?;
    chart
        .configure_mesh()
        .x_desc(x_label)
        .y_desc(y_label)
        .light_line_style(TRANSPARENT)
        .draw()
        .map_err(|error| failed(error.to_string()))?;
    let evaluated =
        |colour: usize| series.iter().any(|series| series.kind == Kind::Evaluation && series.colour == colour);
    for (series, outline) in series.iter().zip(outlines) {
        let colour = Palette99::pick(series.colour).to_rgba();
        let faint = series.kind == Kind::Training && evaluated(series.colour);
        let style = colour.mix(if faint { 0.45 } else { 1.0 }).filled().stroke_width(2);
        // A mean over several runs has no points of its own.
        let marks = if series.kind == Kind::Evaluation && series.band.is_empty() { 3 } else { 0 };
        chart.draw_series([Polygon::new(outline, colour.mix(0.2))]).map_err(|error| failed(error.to_string()))?;
        chart
            .draw_series(LineSeries::new(series.line.iter().copied(), style).point_size(marks))
            .map_err(|error| failed(error.to_string()))?
            .label(&series.label)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], style));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::LowerRight)
        .background_style(WHITE.mix(0.8))
        .draw()
        .map_err(|error| failed(error.to_string()))
}

/// From 0, or the smallest value if that is negative, to 5 % above the largest value.
fn range_of(values: impl Iterator<Item = f64> + Clone) -> Range<f64> {
    let low = values.clone().fold(0.0, f64::min);
    let high = values.fold(low + 1e-6, f64::max);
    low..high + 0.05 * (high - low)
}
