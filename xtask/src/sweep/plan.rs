//! The runs of a sweep: every combination of the grid's values with every seed, each in a directory with its name.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Context, Result, bail};
use comic_experiment::Experiment;
use toml::Value;

use super::document::Document;
use super::outcome::Outcome;
use crate::train::{self, Job};

/// Bytes that the name of a directory may have on every common file system.
const LONGEST_NAME: usize = 255;

/// One of the grid's fields and one of its values.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Setting {
    /// The field's full name.
    pub(super) field: String,
    /// The shortest name that differs from those of the grid's other fields.
    pub(super) short: String,
    pub(super) value: Value,
}

/// A value for each of the grid's fields.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Point(pub(super) Vec<Setting>);

impl Point {
    /// `beta=1e-4,size=20`, or "all" where only the seed varies.
    pub(super) fn name(&self) -> String {
        let settings: Vec<_> =
            self.0.iter().map(|setting| format!("{}={}", setting.short, text(&setting.value))).collect();
        if settings.is_empty() { "all".to_owned() } else { settings.join(",") }
    }
}

/// One run: a grid point with a seed.
pub(super) struct Run {
    /// `beta=1e-4,seed=2`, which is also the name of its directory.
    pub(super) name: String,
    /// The index of the grid point.
    pub(super) point: usize,
    pub(super) seed: u64,
    pub(super) job: Job,
}

impl Run {
    /// The result; an error while the run is not finished.
    pub(super) fn outcome(&self) -> Result<Outcome> {
        Outcome::read(self.job.path())
    }

    pub(super) fn finished(&self) -> bool {
        self.outcome().is_ok()
    }
}

/// Every combination of the grid's values. The values of the last field change fastest.
pub(super) fn points(document: &Document) -> Vec<Point> {
    let short = |field: &str| {
        let end = |field: &str| field.rsplit('.').next().unwrap_or_default().to_owned();
        let alike = document.grid.iter().filter(|(other, _)| end(other) == end(field)).count();
        if alike > 1 { field.to_owned() } else { end(field) }
    };
    document.grid.iter().fold(vec![Point(Vec::new())], |points, (field, values)| {
        let with = |point: &Point, value: &Value| {
            let setting = Setting { field: field.clone(), short: short(field), value: value.clone() };
            Point(point.0.iter().cloned().chain([setting]).collect())
        };
        points.iter().flat_map(|point| values.iter().map(move |value| with(point, value))).collect()
    })
}

/// The runs of `points` with every seed, below `directory`. Resolves all of them, and compares them with existing
/// directories.
pub(super) fn runs(document: &Document, points: &[Point], directory: &Path) -> Result<Vec<Run>> {
    let mut names = BTreeSet::new();
    let mut runs = Vec::new();
    for (index, point) in points.iter().enumerate() {
        for &seed in &document.seeds {
            let seed_name = format!("seed={seed}");
            let name = if point.0.is_empty() { seed_name } else { format!("{},{seed_name}", point.name()) };
            if name.len() > LONGEST_NAME {
                bail!(
                    "{name}: the name of a directory may have {LONGEST_NAME} bytes: put the values into preset files"
                );
            }
            if !names.insert(name.clone()) {
                bail!("{name}: two runs would have this name: remove the value or seed that occurs twice");
            }
            let job = job(document, point, seed, &directory.join(&name)).with_context(|| name.clone())?;
            runs.push(Run { name, point: index, seed, job });
        }
    }
    Ok(runs)
}

/// The run, as `cargo xtask train` would start or resume it.
fn job(document: &Document, point: &Point, seed: u64, directory: &Path) -> Result<Job> {
    let varied = point.0.iter().map(|setting| (&setting.field, &setting.value));
    let set = document.set.iter().map(|(field, value)| (field, value));
    let job = Job::new(train::Options {
        preset: document.preset.clone(),
        clips: document.clips.clone(),
        overrides: set
            .chain(varied)
            .map(|(field, value)| format!("{field}={value}"))
            .chain([format!("seed={seed}")])
            .collect(),
        actors: document.actors,
        run: Some(directory.to_owned()),
        port: None,
        minutes: None,
        episodes: None,
        // The runs are compared after equal times, and some share their cores.
        no_evaluator: true,
        resume: directory.join("checkpoints").is_dir(),
    })?;
    refuse_another_experiment(job.experiment(), directory)?;
    Ok(job)
}

/// Refuses an existing run with another experiment, for instance of another sweep with the same name.
fn refuse_another_experiment(wanted: &Experiment, directory: &Path) -> Result<()> {
    let path = directory.join("experiment.toml");
    let Ok(text) = std::fs::read_to_string(&path) else { return Ok(()) };
    let made = Experiment::from_toml(&path.display().to_string(), &text)?;
    if let Some(difference) = made.differences(wanted)?.into_iter().next() {
        bail!(
            "{} has `{} = {}`, and the sweep has `{}`: restore the old value, remove that directory, or choose another \
             directory for the sweep with --out",
            directory.display(),
            difference.field,
            difference.ours,
            difference.theirs
        );
    }
    Ok(())
}

/// A value as part of a file name: `1e-4`, `reference-mean`, `64-64`.
pub(super) fn text(value: &Value) -> String {
    let text = match value {
        Value::Float(number) => {
            let (plain, scientific) = (number.to_string(), format!("{number:e}"));
            if scientific.len() < plain.len() { scientific } else { plain }
        }
        Value::String(text) => text.clone(),
        value => value.to_string(),
    };
    let plain = |letter: char| letter.is_alphanumeric() || "+-._".contains(letter);
    text.split(|letter| !plain(letter)).filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn document(text: &str) -> Document {
        Document::parse("sweep.toml", &format!("preset = \"quickstart\"\n{text}")).unwrap()
    }

    fn names(text: &str) -> Result<Vec<String>> {
        let (document, directory) = (document(text), tempfile::tempdir().unwrap());
        let runs = runs(&document, &points(&document), directory.path())?;
        Ok(runs.into_iter().map(|run| run.name).collect())
    }

    #[test]
    fn every_combination_has_a_run_with_every_seed() {
        let names = names("seeds = [1, 2]\n[grid]\n\"latent.beta\" = [0, 1e-4]\n\"latent.size\" = [20, 60]").unwrap();
        assert_eq!(
            names,
            [
                "beta=0,size=20,seed=1",
                "beta=0,size=20,seed=2",
                "beta=0,size=60,seed=1",
                "beta=0,size=60,seed=2",
                "beta=1e-4,size=20,seed=1",
                "beta=1e-4,size=20,seed=2",
                "beta=1e-4,size=60,seed=1",
                "beta=1e-4,size=60,seed=2",
            ]
        );
    }

    #[test]
    fn without_a_grid_only_seeds_differ() {
        assert_eq!(names("seeds = [3, 4]").unwrap(), ["seed=3", "seed=4"]);
    }

    #[test]
    fn fields_with_the_same_ending_have_full_names() {
        let names = names("[grid]\n\"network.initial_std\" = [0.1]\n\"latent.initial_std\" = [0.2]").unwrap();
        assert_eq!(names, ["network.initial_std=0.1,network.latent.initial_std=0.2,seed=1"]);
    }

    #[test]
    fn values_are_short_and_usable_in_file_names() {
        for (value, name) in [
            (Value::Float(1e-4), "1e-4"),
            (Value::Float(0.1), "0.1"),
            (Value::Float(0.0), "0"),
            (Value::Float(-1.0), "-1"),
            (Value::Integer(300_000), "300000"),
            (Value::Array(vec![64.into(), 64.into()]), "64-64"),
            ("reference-mean".into(), "reference-mean"),
            ("../a b/c".into(), "..-a-b-c"),
        ] {
            assert_eq!(text(&value), name);
        }
    }

    #[test]
    fn two_runs_with_the_same_name_are_refused() {
        for text in ["seeds = [1, 1]", "[grid]\n\"latent.beta\" = [1e-4, 0.0001]"] {
            assert!(names(text).unwrap_err().to_string().contains("two runs would have this name"));
        }
    }

    #[test]
    fn an_invalid_value_is_refused_with_its_run() {
        let error = format!("{:#}", names("[grid]\n\"latent.beta\" = [0, -1]").unwrap_err());
        assert!(error.starts_with("beta=-1,seed=1: ") && error.contains("must be 0 or more"), "{error}");
    }

    #[test]
    fn a_directory_with_the_same_experiment_is_used_and_with_another_one_refused() {
        let document = document("[grid]\n\"latent.beta\" = [0.5]");
        let directory = tempfile::tempdir().unwrap();
        let made = |beta: &str| {
            let experiment = comic_experiment::resolve("quickstart", &[format!("network.latent.beta={beta}")]).unwrap();
            let run = directory.path().join("beta=0.5,seed=1");
            fs::create_dir_all(run.join("checkpoints")).unwrap();
            fs::write(run.join("experiment.toml"), experiment.to_toml().unwrap()).unwrap();
            runs(&document, &points(&document), directory.path())
        };
        assert!(made("0.5").is_ok());
        let error = format!("{:#}", made("0.25").err().unwrap());
        assert!(error.contains("has `network.latent.beta = 0.25`, and the sweep has `0.5`"), "{error}");
    }
}
