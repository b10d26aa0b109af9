//! The results of a sweep: a row for each grid point, with mean and range over its seeds.

use serde::Serialize;
use serde_json::{Map, Value, json};

use super::outcome::Outcome;
use super::plan::{Point, Run, text};

/// A column: its key in JSON, its heading in Markdown, its decimals, and its value.
type Column = (&'static str, &'static str, usize, fn(&Outcome) -> Option<f64>);

const COLUMNS: [Column; 6] = [
    ("normalised_reward", "normalised reward", 3, |outcome| Some(outcome.normalised_reward)),
    ("reward_per_step", "reward per step / largest", 3, |outcome| Some(outcome.reward_per_step)),
    ("episode_length", "episode length", 1, |outcome| Some(outcome.episode_length)),
    ("latent_kl", "latent KL, nats per step", 2, |outcome| outcome.latent_kl),
    ("environment_steps", "environment steps", 0, |outcome| Some(outcome.environment_steps)),
    ("minutes", "minutes", 1, |outcome| Some(outcome.minutes)),
];

/// Mean and range over seeds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
struct Spread {
    mean: f64,
    min: f64,
    max: f64,
}

impl Spread {
    /// `None` of no values.
    fn of(values: &[f64]) -> Option<Self> {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let min = values.iter().copied().reduce(f64::min)?;
        let max = values.iter().copied().reduce(f64::max)?;
        Some(Self { mean, min, max })
    }

    /// `0.402 (0.388–0.416)`, or only the mean where all values are equal.
    fn text(self, decimals: usize) -> String {
        let [mean, min, max] = [self.mean, self.min, self.max].map(|value| format!("{value:.decimals$}"));
        if min == max { mean } else { format!("{mean} ({min}–{max})") }
    }
}

/// A grid point and its finished runs, by seed.
pub(super) struct Row<'a> {
    pub(super) point: &'a Point,
    pub(super) outcomes: Vec<(u64, Outcome)>,
}

impl<'a> Row<'a> {
    /// A row for each point, from the runs that are finished.
    pub(super) fn all(points: &'a [Point], runs: &[Run]) -> Vec<Self> {
        let row = |(index, point)| {
            let runs = runs.iter().filter(|run| run.point == index);
            Self { point, outcomes: runs.filter_map(|run| Some((run.seed, run.outcome().ok()?))).collect() }
        };
        points.iter().enumerate().map(row).collect()
    }

    fn spread(&self, of: fn(&Outcome) -> Option<f64>) -> Option<Spread> {
        Spread::of(&self.outcomes.iter().filter_map(|(_, outcome)| of(outcome)).collect::<Vec<_>>())
    }
}

/// A row for each grid point, a column for each of its fields and for each result.
pub(super) fn markdown(rows: &[Row]) -> String {
    let Some(first) = rows.first() else { return String::new() };
    let fields = first.point.0.iter().map(|setting| setting.short.as_str());
    let figures = COLUMNS.iter().map(|(_, head, ..)| *head);
    let head: Vec<&str> = fields.chain(["seeds"]).chain(figures).collect();
    let line = |values: &[String]| format!("| {} |\n", values.join(" | "));
    let mut table = line(&head.iter().map(ToString::to_string).collect::<Vec<_>>());
    table += &line(&vec!["---".to_owned(); head.len()]);
    for row in rows {
        let values = row.point.0.iter().map(|setting| text(&setting.value));
        let seeds = row.outcomes.iter().map(|(seed, _)| seed.to_string()).collect::<Vec<_>>().join(", ");
        let figures = COLUMNS.iter().map(|(_, _, decimals, of)| {
            row.spread(*of).map_or_else(|| "–".to_owned(), |spread| spread.text(*decimals))
        });
        table += &line(&values.chain([seeds]).chain(figures).collect::<Vec<_>>());
    }
    table
        + "\nMean over the finished seeds (minimum–maximum). Rewards and lengths are those of the trained policy without \
             noise over every start; the KL is that of the last updates.\n"
}

/// The same table in JSON, an object for each grid point.
pub(super) fn json(rows: &[Row]) -> Value {
    let row = |row: &Row| {
        let point: Map<String, Value> =
            row.point.0.iter().map(|setting| (setting.field.clone(), json!(setting.value))).collect();
        let seeds: Vec<u64> = row.outcomes.iter().map(|(seed, _)| *seed).collect();
        let mut object = json!({ "point": point, "seeds": seeds });
        for (key, _, _, of) in COLUMNS {
            object[key] = json!(row.spread(of));
        }
        object
    };
    rows.iter().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::super::plan::Setting;
    use super::*;

    fn point() -> Point {
        let value = toml::Value::Float(1e-4);
        Point(vec![Setting { field: "network.latent.beta".into(), short: "beta".into(), value }])
    }

    fn row<'a>(point: &'a Point, rewards: &[f64]) -> Vec<Row<'a>> {
        let outcome = |reward: &f64| Outcome { normalised_reward: *reward, ..Outcome::default() };
        vec![Row { point, outcomes: (1..).zip(rewards.iter().map(outcome)).collect() }]
    }

    #[test]
    fn a_row_has_mean_and_range_over_seeds() {
        let table = markdown(&row(&point(), &[0.375, 0.5, 0.25]));
        assert!(table.starts_with("| beta | seeds | normalised reward | "), "{table}");
        assert!(table.contains("\n| 1e-4 | 1, 2, 3 | 0.375 (0.250–0.500) | 0.000 | 0.0 | – | 0 | 0.0 |\n"), "{table}");
    }

    #[test]
    fn a_point_without_a_finished_run_has_an_empty_row() {
        assert!(markdown(&row(&point(), &[])).contains("\n| 1e-4 |  | – | – | – | – | – | – |\n"));
    }

    #[test]
    fn json_has_full_names_and_numbers() {
        let rows = json(&row(&point(), &[0.25, 0.75]));
        assert_eq!(rows[0]["point"], json!({ "network.latent.beta": 1e-4 }));
        assert_eq!(rows[0]["seeds"], json!([1, 2]));
        assert_eq!(rows[0]["normalised_reward"], json!({ "mean": 0.5, "min": 0.25, "max": 0.75 }));
        assert_eq!(rows[0]["latent_kl"], Value::Null);
    }
}
