//! Reads the file of a sweep.

use std::num::NonZeroUsize;
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use comic_experiment::{find_field, nearest};
use serde::Deserialize;
use toml::{Table, Value};

/// Every name that a file may have at the top level.
const NAMES: [&str; 7] = ["preset", "clips", "actors", "parallel", "seeds", "set", "grid"];

/// A sweep as it is written in its file.
#[derive(Debug, Deserialize)]
struct Written {
    preset: String,
    #[serde(default)]
    clips: Vec<String>,
    #[serde(default = "two")]
    actors: u16,
    #[serde(default = "one")]
    parallel: NonZeroUsize,
    #[serde(default = "first_seed")]
    seeds: Vec<u64>,
    #[serde(default)]
    set: Table,
    #[serde(default)]
    grid: Table,
}

fn two() -> u16 {
    2
}

fn one() -> NonZeroUsize {
    NonZeroUsize::MIN
}

fn first_seed() -> Vec<u64> {
    vec![1]
}

/// A sweep: an experiment, the fields that all runs change, and the fields that vary between runs.
#[derive(Debug)]
pub(super) struct Document {
    /// A preset's name or the path of an experiment file.
    pub(super) preset: String,
    /// Clips instead of the experiment's, as on the command line.
    pub(super) clips: Vec<String>,
    /// Actor processes of a run.
    pub(super) actors: u16,
    /// Runs at the same time.
    pub(super) parallel: NonZeroUsize,
    pub(super) seeds: Vec<u64>,
    /// Fields by their full names, and the value in every run.
    pub(super) set: Vec<(String, Value)>,
    /// Fields by their full names, and the values that are tried.
    pub(super) grid: Vec<(String, Vec<Value>)>,
}

impl Document {
    pub(super) fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&path.display().to_string(), &text)
    }

    /// `origin` names the file in errors.
    pub(super) fn parse(origin: &str, text: &str) -> Result<Self> {
        let malformed = |error: toml::de::Error| anyhow!("{origin}: {}", error.to_string().trim_end());
        let table: Table = text.parse().map_err(malformed)?;
        if let Some(unknown) = table.keys().find(|key| !NAMES.contains(&key.as_str())) {
            match nearest(unknown, NAMES) {
                Some(name) => bail!("{origin}: unknown field `{unknown}`; did you mean `{name}`?"),
                None => bail!("{origin}: unknown field `{unknown}`; known are {}", NAMES.join(", ")),
            }
        }
        let written: Written = toml::from_str(text).map_err(malformed)?;
        let document = Self {
            preset: written.preset,
            clips: written.clips,
            actors: written.actors,
            parallel: written.parallel,
            seeds: written.seeds,
            set: fields(&format!("{origin}: set"), &written.set)?,
            grid: fields(&format!("{origin}: grid"), &written.grid)?
                .into_iter()
                .map(|(field, values)| match values {
                    Value::Array(values) if !values.is_empty() => Ok((field, values)),
                    _ => bail!("{origin}: grid: `{field}` must be a list of values, for instance [0, 1e-4]"),
                })
                .collect::<Result<_>>()?,
        };
        document.check().with_context(|| origin.to_owned())?;
        Ok(document)
    }

    fn check(&self) -> Result<()> {
        if !(1..=1024).contains(&self.actors) {
            bail!("actors = {}: must be 1 to 1024", self.actors);
        }
        if self.seeds.is_empty() {
            bail!("seeds = []: name one or more, for instance [1, 2, 3]");
        }
        let varied = || self.grid.iter().map(|(field, _)| field);
        if let Some((field, _)) = self.set.iter().find(|(field, _)| varied().any(|varied| varied == field)) {
            bail!("`{field}` is in `set` and in `grid`: remove one of them");
        }
        if self.set.iter().map(|(field, _)| field).chain(varied()).any(|field| field == "seed") {
            bail!("`seed` is not a field to set: write the seeds as `seeds = [1, 2, 3]`");
        }
        Ok(())
    }
}

/// The fields of a table, written as `"latent.beta" = 0` or as sections, sorted by their full names. So a run's directory
/// does not depend on the way in which they are written.
fn fields(origin: &str, table: &Table) -> Result<Vec<(String, Value)>> {
    let mut written = Vec::new();
    flatten("", table, &mut written);
    let mut fields: Vec<(String, Value)> = Vec::new();
    for (name, value) in written {
        let field = find_field(origin, &name)?;
        if fields.iter().any(|(known, _)| *known == field) {
            bail!("{origin}: `{field}` occurs twice: remove one of them");
        }
        fields.push((field, value));
    }
    fields.sort_by(|(one, _), (other, _)| one.cmp(other));
    Ok(fields)
}

fn flatten(prefix: &str, table: &Table, fields: &mut Vec<(String, Value)>) {
    for (key, value) in table {
        match value {
            Value::Table(section) => flatten(&format!("{prefix}{key}."), section, fields),
            value => fields.push((format!("{prefix}{key}"), value.clone())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(text: &str) -> String {
        format!("{:#}", Document::parse("sweep.toml", text).unwrap_err())
    }

    #[test]
    fn fields_may_be_written_by_their_endings_or_in_sections() {
        let text = "preset = \"quickstart\"\n[set]\nbudget.minutes = 1\n[grid]\n\"latent.beta\" = [0, 1e-4]\n";
        let document = Document::parse("sweep.toml", text).unwrap();
        assert_eq!(document.set, [("budget.minutes".to_owned(), Value::Integer(1))]);
        let betas = vec![Value::Integer(0), Value::Float(1e-4)];
        assert_eq!(document.grid, [("network.latent.beta".to_owned(), betas)]);
    }

    #[test]
    fn the_defaults_are_two_actors_one_run_at_a_time_and_the_first_seed() {
        let document = Document::parse("sweep.toml", "preset = \"quickstart\"").unwrap();
        assert_eq!((document.actors, document.parallel.get(), document.seeds), (2, 1, vec![1]));
    }

    #[test]
    fn a_misspelt_name_is_refused_with_the_nearest() {
        assert_eq!(refused("sedes = [1]"), "sweep.toml: unknown field `sedes`; did you mean `seeds`?");
        assert_eq!(
            refused("preset = \"quickstart\"\n[grid]\n\"latent.bata\" = [0]"),
            "sweep.toml: grid: unknown field `latent.bata`; did you mean `network.latent.beta`?"
        );
    }

    #[test]
    fn a_missing_preset_is_refused() {
        assert!(refused("seeds = [1]").contains("missing field `preset`"));
    }

    #[test]
    fn invalid_values_are_refused_by_name() {
        for (text, words) in [
            ("seeds = []", "seeds = []: name one or more"),
            ("actors = 0", "actors = 0: must be 1 to 1024"),
            ("parallel = 0", "parallel"),
            ("[grid]\n\"latent.beta\" = 0", "`network.latent.beta` must be a list of values"),
            ("[grid]\n\"latent.beta\" = []", "`network.latent.beta` must be a list of values"),
            ("[grid]\nbeta = [0]\n\"latent.beta\" = [0]", "`network.latent.beta` occurs twice"),
            ("[set]\nbeta = 0\n[grid]\n\"latent.beta\" = [0]", "is in `set` and in `grid`"),
            ("[grid]\nseed = [1, 2]", "write the seeds as `seeds"),
        ] {
            let message = refused(&format!("preset = \"quickstart\"\n{text}\n"));
            assert!(message.starts_with("sweep.toml: ") && message.contains(words), "{message}");
        }
    }
}
