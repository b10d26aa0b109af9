//! What people have saved: the format of checkpoints, and documents of the release before.

use toml::{Table, Value};

use crate::document::Experiment;
use crate::error::Error;

/// Version of the format of checkpoints. It changes when a learner cannot resume from those before. Checkpoints of format 1 do
/// not name it.
pub const CHECKPOINT_FORMAT: u32 = 2;

/// Checks the format that a checkpoint names.
///
/// # Errors
/// [`Error::Format`] when this release does not read it.
pub fn check_checkpoint_format(named: Option<u32>) -> Result<(), Error> {
    match named.unwrap_or(1) {
        CHECKPOINT_FORMAT => Ok(()),
        found => Err(Error::Format { found, known: CHECKPOINT_FORMAT }),
    }
}

/// Fields and sections of the release before, each with its name in this one. Those without a name are gone: policies that were
/// learned with them act without them.
const RENAMED: [(&str, Option<&str>); 7] = [
    ("transfer.algorithm", Some("algorithm")),
    ("svg0.replay_steps", None),
    ("svg0.replay_mib", None),
    ("svg0.samples_per_insert", None),
    ("svg0.begin_at", None),
    ("svg0.learning_rate", None),
    ("warm_start", None),
];

impl Experiment {
    /// Reads a resolved document of the release before, as exported files of format 1 hold it. Errors call it `origin`.
    ///
    /// # Errors
    /// As of [`from_toml`](Self::from_toml).
    pub fn from_earlier_toml(origin: &str, text: &str) -> Result<Self, Error> {
        let mut document: Table = text.parse().map_err(|error: toml::de::Error| Error::Malformed {
            origin: origin.to_string(),
            message: error.to_string().trim_end().to_string(),
        })?;
        for (before, now) in RENAMED {
            let Some(value) = take(&mut document, before) else { continue };
            if let Some(now) = now {
                put(&mut document, now, value);
            }
        }
        // SVG(0) had the deviation of the other networks.
        if document.get("algorithm").and_then(Value::as_str) == Some("svg0") {
            for field in ["initial_std", "min_std"] {
                if let Some(value) = take(&mut document, &format!("network.{field}")) {
                    put(&mut document, &format!("svg0.{field}"), value);
                }
            }
        }
        let text = toml::to_string(&document)
            .map_err(|error| Error::Malformed { origin: origin.to_string(), message: error.to_string() })?;
        Self::from_toml_with_unread(origin, &text)
    }
}

/// Removes the value at a dotted path.
fn take(document: &mut Table, path: &str) -> Option<Value> {
    match path.split_once('.') {
        Some((section, field)) => take(document.get_mut(section)?.as_table_mut()?, field),
        None => document.remove(path),
    }
}

/// Puts a value at a dotted path, in sections that are created where they are missing.
fn put(document: &mut Table, path: &str, value: Value) {
    let Some((section, field)) = path.split_once('.') else {
        document.insert(path.to_string(), value);
        return;
    };
    let section = document.entry(section).or_insert_with(|| Value::Table(Table::new()));
    if let Some(section) = section.as_table_mut() {
        put(section, field, value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_document_of_the_release_before_is_read_by_the_new_names() {
        let text = "[transfer]\nalgorithm = \"svg0\"\n[svg0]\nlearning_rate = 0.5\nreplay_steps = 32000\nbegin_at = 640\n\
            samples_per_insert = 4.0\nreplay_mib = 16384\n[warm_start]\nsteps = 0\n[vmpo]\nlambda = 0.9\n\
            [network]\nmin_std = 0.125\n";
        let experiment = Experiment::from_earlier_toml("its experiment", text).unwrap();
        assert_eq!(experiment.algorithm.name(), "svg0");
        assert_eq!(experiment.replay, crate::replay::Replay::default());
        // Below `[svg0]`, and not below `[network]`.
        let written = experiment.to_table().unwrap();
        assert_eq!(written["svg0"]["min_std"].as_float(), Some(0.125));
        // What the algorithm does not read had no effect then.
        assert!(!experiment.to_toml().unwrap().contains("lambda = 0.9"));
        assert!(Experiment::from_toml("its experiment", text).is_err());
        let unknown = Experiment::from_earlier_toml("its experiment", "discont = 1").unwrap_err().to_string();
        assert!(unknown.contains("unknown field `discont`"), "{unknown}");
    }

    #[test]
    fn a_checkpoint_of_another_format_is_refused_with_both_formats_and_the_remedy() {
        assert!(check_checkpoint_format(Some(CHECKPOINT_FORMAT)).is_ok());
        for (named, found) in [(None, "format 1"), (Some(7), "format 7")] {
            let refused = check_checkpoint_format(named).unwrap_err().to_string();
            for part in [found, "format 2", "comic-learner export"] {
                assert!(refused.contains(part), "{refused}");
            }
        }
    }
}
