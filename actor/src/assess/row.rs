//! What one source of latents does: the statistics of its episodes.

use serde::Serialize;

/// A spread of fewer episodes says too little (D).
pub(super) const FEWEST: usize = 8;

/// An episode that is over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fallen {
    /// Seconds until the fall, or until the time limit.
    pub(super) seconds: f64,
    /// Whether it was upright at the time limit.
    pub(super) upright: bool,
    /// Horizontal distance between the root's first and last place, m.
    pub(super) metres: f64,
    /// Where the root was after three seconds, m: ahead and to the left of where it began. `None` if it had fallen.
    pub(super) place: Option<[f64; 2]>,
}

/// What one source of latents does.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct Row {
    /// The source.
    pub(super) latents: &'static str,
    pub(super) episodes: usize,
    /// Mean seconds until the head is below 1.2 m, or until the time limit.
    pub(super) seconds_upright: f64,
    /// Their median.
    pub(super) median_seconds_upright: f64,
    /// Share of the episodes that are upright at the time limit.
    pub(super) upright_to_the_end: f64,
    /// Mean horizontal distance between the start and the place where the episode ended, m.
    pub(super) metres: f64,
    /// Episodes that are upright after three seconds. The two numbers below are over them.
    pub(super) upright_at_3_s: usize,
    /// Circular standard deviation of the headings after three seconds, degrees. A heading is the direction from the start
    /// to the root, relative to the root's direction at the start. Absent if fewer than eight episodes are upright.
    pub(super) heading_std: Option<f64>,
    /// Standard deviation of the places after three seconds, m: the root of the trace of their covariance, in the frame of
    /// the start. Absent as `heading_std`.
    pub(super) place_std: Option<f64>,
}

impl Row {
    pub(super) fn new(latents: &'static str, finished: &[Fallen]) -> Self {
        let mean_of = |of: &dyn Fn(&Fallen) -> f64| mean(&finished.iter().map(of).collect::<Vec<_>>());
        let places: Vec<[f64; 2]> = finished.iter().filter_map(|one| one.place).collect();
        let enough = places.len() >= FEWEST;
        Self {
            latents,
            episodes: finished.len(),
            seconds_upright: mean_of(&|one| one.seconds),
            median_seconds_upright: median(finished.iter().map(|one| one.seconds).collect()),
            upright_to_the_end: mean_of(&|one| f64::from(u8::from(one.upright))),
            metres: mean_of(&|one| one.metres),
            upright_at_3_s: places.len(),
            heading_std: enough.then(|| heading_std(&places)),
            place_std: enough.then(|| place_std(&places)),
        }
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// The middle value, or the mean of the two in the middle; 0 without any.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let at = |place: usize| values.get(place).copied().unwrap_or(0.0);
    f64::midpoint(at(values.len().saturating_sub(1) / 2), at(values.len() / 2))
}

/// √(−2 ln R) of the directions of these places, degrees. R is the length of the mean of the unit vectors (Mardia and Jupp).
fn heading_std(places: &[[f64; 2]]) -> f64 {
    let headings: Vec<f64> = places.iter().map(|[ahead, left]| left.atan2(*ahead)).collect();
    let part = |of: fn(f64) -> f64| mean(&headings.iter().copied().map(of).collect::<Vec<_>>());
    // By rounding the length can be more than 1, and JSON has no infinity.
    let length = part(f64::cos).hypot(part(f64::sin)).clamp(f64::MIN_POSITIVE, 1.0);
    (-2.0 * length.ln()).max(0.0).sqrt().to_degrees()
}

/// √(trace of the covariance), m.
fn place_std(places: &[[f64; 2]]) -> f64 {
    let variance = |axis: usize| {
        let middle = mean(&places.iter().map(|place| place[axis]).collect::<Vec<_>>());
        mean(&places.iter().map(|place| (place[axis] - middle).powi(2)).collect::<Vec<_>>())
    };
    (variance(0) + variance(1)).sqrt()
}

/// The rows as a table.
pub(super) fn table(rows: &[Row]) -> String {
    const HEADER: [&str; 8] =
        ["episodes", "upright", "median", "to the end", "walked", "upright at 3 s", "heading_std", "place_std"];
    let known = |value: Option<f64>, digits: usize, unit: &str| {
        value.map_or("–".into(), |value| format!("{value:.digits$} {unit}"))
    };
    let line = |name: &str, cells: &[String]| {
        let cells: String = cells.iter().map(|cell| format!("{cell:>16}")).collect();
        format!("{name:<20}{cells}\n")
    };
    let mut text = line("latents", &HEADER.map(str::to_owned));
    for row in rows {
        let cells = [
            row.episodes.to_string(),
            format!("{:.2} s", row.seconds_upright),
            format!("{:.2} s", row.median_seconds_upright),
            format!("{:.0} %", 100.0 * row.upright_to_the_end),
            format!("{:.2} m", row.metres),
            row.upright_at_3_s.to_string(),
            known(row.heading_std, 1, "°"),
            known(row.place_std, 2, "m"),
        ];
        text += &line(row.latents, &cells);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fallen(seconds: f64, place: Option<[f64; 2]>) -> Fallen {
        Fallen { seconds, upright: seconds >= 10.0, metres: 2.0 * seconds, place }
    }

    #[test]
    fn the_formulas_by_hand() {
        // Four episodes a metre ahead, and four a metre to the left: R is 1/√2, so −2 ln R is ln 2. Each axis has variance 1/4.
        let ways = [[1.0, 0.0], [0.0, 1.0]].repeat(4);
        let mut finished: Vec<Fallen> = ways.iter().map(|place| fallen(10.0, Some(*place))).collect();
        finished.extend([fallen(1.0, None), fallen(3.0, None)]);
        let row = Row::new("any", &finished);
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} is not {b}");
        assert_eq!((row.episodes, row.upright_at_3_s), (10, 8));
        close(row.seconds_upright, 8.4);
        close(row.median_seconds_upright, 10.0);
        close(row.upright_to_the_end, 0.8);
        close(row.metres, 16.8);
        close(row.heading_std.unwrap(), std::f64::consts::LN_2.sqrt().to_degrees());
        close(row.place_std.unwrap(), 0.5_f64.sqrt());
    }

    #[test]
    fn the_spread_of_fewer_than_eight_episodes_is_unknown() {
        let upright = |count| vec![fallen(4.0, Some([1.0, 0.0])); count];
        let (seven, eight) = (Row::new("any", &upright(7)), Row::new("any", &upright(8)));
        assert_eq!((seven.upright_at_3_s, seven.heading_std, seven.place_std), (7, None, None));
        assert_eq!((eight.heading_std, eight.place_std), (Some(0.0), Some(0.0)));
        assert_eq!(Row::new("any", &[]).median_seconds_upright, 0.0);
    }

    #[test]
    fn headings_wrap_around_and_opposite_ones_are_finite() {
        // 170° and 190° are 20° apart: nearly a standard deviation of 10°.
        let behind = |degrees: f64| [degrees.to_radians().cos(), degrees.to_radians().sin()];
        assert!((heading_std(&[170.0, 190.0].map(behind)) - 10.0).abs() < 0.1);
        assert!(heading_std(&[[1.0, 0.0], [-1.0, 0.0]]).is_finite());
    }

    #[test]
    fn the_median_is_in_the_middle() {
        assert_eq!([vec![3.0, 1.0, 9.0], vec![4.0, 1.0, 9.0, 2.0], vec![5.0]].map(median), [3.0, 3.0, 5.0]);
    }
}
