//! A report as a table.

use std::collections::BTreeMap;
use std::fmt;

use super::{ClipReport, Report};

const FIXED: [&str; 9] =
    ["episodes", "return", "normalised", "per step", "survived", "success", "length", "error", "head"];

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = |values: &BTreeMap<String, f64>| values.keys().cloned().collect::<Vec<_>>();
        let (measures, terms) = (names(&self.overall.measures), names(&self.overall.reward_terms));
        let row = |clip: &ClipReport| row(clip, &measures);
        let mut rows = vec![header(&measures, &terms)];
        rows.extend(self.clips.iter().map(row));
        // A task of one clip already has a row.
        if self.clips.len() > self.tasks.len() {
            rows.extend(self.tasks.iter().map(row));
        }
        // With one clip the overall row would repeat the clip's row.
        if self.clips.len() != 1 {
            rows.push(row(&self.overall));
        }
        let columns = rows[0].len();
        let widths: Vec<usize> =
            (0..columns).map(|column| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0)).collect();
        for row in &rows {
            write!(f, "{:<width$}", row[0], width = widths[0])?;
            for (cell, width) in row.iter().zip(&widths).skip(1) {
                write!(f, "  {cell:>width$}")?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

fn header(measures: &[String], terms: &[String]) -> Vec<String> {
    let fixed = ["clip"].into_iter().chain(FIXED).map(str::to_owned);
    fixed.chain(measures.iter().chain(terms).cloned()).collect()
}

/// A row with these measures. In joint training a task has only some of them.
fn row(clip: &ClipReport, measures: &[String]) -> Vec<String> {
    let mut cells = vec![
        clip.clip.clone(),
        clip.episodes.to_string(),
        format!("{:.2}", clip.return_mean),
        format!("{:.3}", clip.normalised_reward),
        format!("{:.3}", clip.reward_per_step),
        format!("{:.3}", clip.fraction_survived),
        format!("{:.3}", clip.success_rate),
        format!("{:.1}", clip.length_mean),
        clip.tracking_error.map_or("–".into(), |error| format!("{:.0} mm", error.position_mm)),
        format!("{:.2} m", clip.head_height),
    ];
    cells.extend(measures.iter().map(|name| clip.measures.get(name).map_or("–".into(), |value| format!("{value:.2}"))));
    cells.extend(clip.reward_terms.values().map(|value| format!("{value:.3}")));
    cells
}
