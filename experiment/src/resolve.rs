//! From a preset or a file, and `--set` overrides, to an [`Experiment`].

use std::path::Path;

use toml::{Table, Value};

use crate::{Experiment, presets};

/// Why a document is not an experiment.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Neither a preset's name nor a readable file.
    #[error("no preset or file `{name}` ({reason}); presets are {presets}")]
    NotFound {
        /// What was asked for.
        name: String,
        /// Why it could not be read.
        reason: String,
        /// The presets' names.
        presets: String,
    },
    /// Not TOML, or a field of the wrong type.
    #[error("{origin}: {message}")]
    Malformed {
        /// The file or preset.
        origin: String,
        /// The parser's words, with line and column.
        message: String,
    },
    /// A field no experiment has.
    #[error("{origin}: unknown field `{field}`{hint}")]
    UnknownField {
        /// The file, preset or `--set` it stands in.
        origin: String,
        /// Its dotted name.
        field: String,
        /// "; did you mean `…`?", or nothing.
        hint: String,
    },
    /// `--set` without `=`.
    #[error("--set {argument}: expected FIELD=VALUE, for instance --set vmpo.epsilon_eta=0.2")]
    Override {
        /// The argument as given.
        argument: String,
    },
    /// A value outside its meaning.
    #[error("{field} = {value}: {remedy}")]
    Value {
        /// Dotted name.
        field: &'static str,
        /// The value given.
        value: String,
        /// What is allowed.
        remedy: &'static str,
    },
}

/// Resolves `document`, a preset's name or the path of a TOML file, with `overrides` of the form `field.path=value`
/// applied in order.
///
/// # Errors
/// [`Error`], naming file, line and field.
pub fn resolve(document: &str, overrides: &[String]) -> Result<Experiment, Error> {
    let (origin, text) = read(document)?;
    let mut table = parse(&origin, &text)?;
    for argument in overrides {
        apply_override(&mut table, argument)?;
    }
    decode(&origin, table)
}

impl Experiment {
    /// Reads a resolved document, for instance one that came over the wire.
    ///
    /// # Errors
    /// [`Error`], naming line and field.
    pub fn from_toml(origin: &str, text: &str) -> Result<Self, Error> {
        decode(origin, parse(origin, text)?)
    }

    /// The whole document, every field written out.
    ///
    /// # Errors
    /// [`Error::Malformed`] when a number is beyond what TOML can write.
    pub fn to_toml(&self) -> Result<String, Error> {
        toml::to_string(self)
            .map_err(|error| Error::Malformed { origin: "experiment".into(), message: error.to_string() })
    }
}

fn read(document: &str) -> Result<(String, String), Error> {
    if let Some((name, text)) = presets::ALL.iter().find(|(name, _)| *name == document) {
        return Ok((format!("preset {name}"), (*text).to_string()));
    }
    match std::fs::read_to_string(Path::new(document)) {
        Ok(text) => Ok((document.to_string(), text)),
        Err(error) => Err(Error::NotFound {
            name: document.to_string(),
            reason: error.to_string(),
            presets: presets::ALL.map(|(name, _)| name).join(", "),
        }),
    }
}

fn parse(origin: &str, text: &str) -> Result<Table, Error> {
    text.parse::<Table>()
        .map_err(|error| Error::Malformed { origin: origin.to_string(), message: error.to_string() })
}

/// Decodes without line numbers (they are lost once overrides are merged) but with the field's whole path.
fn decode(origin: &str, table: Table) -> Result<Experiment, Error> {
    refuse_unknown(origin, "", &table, &known()?)?;
    let experiment: Experiment = Value::Table(table)
        .try_into()
        .map_err(|error: toml::de::Error| Error::Malformed { origin: origin.to_string(), message: error.to_string() })?;
    check(&experiment)?;
    Ok(experiment)
}

/// The default document with every optional field present: the vocabulary of names.
fn known() -> Result<Table, Error> {
    let mut everything = Experiment::default();
    for clip in &mut everything.clips {
        clip.subset = Some(String::new());
        clip.ids = vec![String::new()];
        clip.end_step = Some(0);
    }
    Table::try_from(&everything)
        .map_err(|error| Error::Malformed { origin: "default experiment".into(), message: error.to_string() })
}

fn refuse_unknown(origin: &str, prefix: &str, table: &Table, known: &Table) -> Result<(), Error> {
    for (key, value) in table {
        let field = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        let Some(model) = known.get(key) else {
            return Err(Error::UnknownField { origin: origin.to_string(), hint: hint(prefix, key, known), field });
        };
        match (value, model) {
            (Value::Table(inner), Value::Table(names)) => refuse_unknown(origin, &field, inner, names)?,
            (Value::Array(items), Value::Array(models)) => {
                if let Some(Value::Table(names)) = models.first() {
                    for item in items.iter().filter_map(Value::as_table) {
                        refuse_unknown(origin, &field, item, names)?;
                    }
                }
            }
            _ => {}
        }
    }
    Ok(())
}

fn hint(prefix: &str, key: &str, known: &Table) -> String {
    let nearest = known.keys().max_by(|a, b| strsim::jaro_winkler(a, key).total_cmp(&strsim::jaro_winkler(b, key)));
    match nearest {
        Some(name) if strsim::jaro_winkler(name, key) > 0.7 => {
            let path = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
            format!("; did you mean `{path}`?")
        }
        _ => format!("; known here are {}", known.keys().cloned().collect::<Vec<_>>().join(", ")),
    }
}

fn apply_override(table: &mut Table, argument: &str) -> Result<(), Error> {
    let malformed = || Error::Override { argument: argument.to_string() };
    let (path, value) = argument.split_once('=').ok_or_else(malformed)?;
    let (path, value) = (path.trim(), value.trim());
    if path.is_empty() || path.split('.').any(str::is_empty) {
        return Err(malformed());
    }
    // Anything that is no TOML value is a string, so `--set name=mine` needs no quotes.
    let value = format!("value = {value}")
        .parse::<Table>()
        .ok()
        .and_then(|mut parsed| parsed.remove("value"))
        .unwrap_or_else(|| Value::String(value.to_string()));
    let mut place = table;
    let mut parts = path.split('.').peekable();
    while let Some(part) = parts.next() {
        if parts.peek().is_none() {
            place.insert(part.to_string(), value);
            return Ok(());
        }
        place = place
            .entry(part)
            .or_insert_with(|| Value::Table(Table::new()))
            .as_table_mut()
            .ok_or_else(malformed)?;
    }
    Ok(())
}

/// Values that parse but mean nothing.
fn check(experiment: &Experiment) -> Result<(), Error> {
    let Experiment { clips, task, network, vmpo, optimiser, unroll, actor, warm_start, learner, .. } = experiment;
    let positive = "must be at least 1";
    let rules: [(&'static str, String, bool, &'static str); 24] = [
        ("clips", clips.len().to_string(), !clips.is_empty(), "name at least one clip source"),
        ("task.reference_steps", format!("{:?}", task.reference_steps), (1..=64).contains(&task.reference_steps.len()) && task.reference_steps.iter().all(|step| (1..=1000).contains(step)), "must be 1 to 64 numbers of frames ahead, each 1 to 1000"),
        ("task.termination_threshold", task.termination_threshold.to_string(), task.termination_threshold > 0.0, "must be positive"),
        ("task.time_limit", task.time_limit.to_string(), task.time_limit > 0.0, "must be positive seconds"),
        ("network.latent.size", network.latent.size.to_string(), (1..=4096).contains(&network.latent.size), "must be 1 to 4096"),
        ("network.latent.min_std", network.latent.min_std.to_string(), network.latent.min_std > 0.0, "must be positive"),
        ("network.latent.initial_std", network.latent.initial_std.to_string(), network.latent.initial_std > network.latent.min_std, "must exceed network.latent.min_std"),
        ("network.min_std", network.min_std.to_string(), network.min_std > 0.0, "must be positive"),
        ("network.initial_std", network.initial_std.to_string(), network.initial_std > network.min_std, "must exceed network.min_std"),
        ("network.*", "sizes".into(), [&network.encoder, &network.low_level, &network.value].iter().all(|sizes| !sizes.is_empty() && sizes.iter().all(|size| (1..=16384).contains(size))), "encoder, low_level and value need one or more layers of 1 to 16384 units"),
        ("vmpo.discount", vmpo.discount.to_string(), (0.0..1.0).contains(&vmpo.discount), "must be in [0, 1)"),
        ("vmpo.lambda", vmpo.lambda.to_string(), (0.0..=1.0).contains(&vmpo.lambda), "must be in [0, 1]"),
        ("vmpo.top_fraction", vmpo.top_fraction.to_string(), vmpo.top_fraction > 0.0 && vmpo.top_fraction <= 1.0, "must be in (0, 1]"),
        ("vmpo.target_period", vmpo.target_period.to_string(), vmpo.target_period > 0, positive),
        ("vmpo.gradient_steps", vmpo.gradient_steps.to_string(), vmpo.gradient_steps > 0, positive),
        ("vmpo.minibatch_unrolls", vmpo.minibatch_unrolls.to_string(), vmpo.minibatch_unrolls > 0 && unroll.batch.is_multiple_of(vmpo.minibatch_unrolls), "must divide unroll.batch"),
        ("vmpo.epsilon_*", "limits".into(), [vmpo.epsilon_eta, vmpo.epsilon_mean, vmpo.epsilon_std].iter().all(|limit| *limit > 0.0), "limits must be positive"),
        ("optimiser.learning_rate", optimiser.learning_rate.to_string(), optimiser.learning_rate > 0.0 && optimiser.multiplier_learning_rate > 0.0, "learning rates must be positive"),
        ("unroll.length", unroll.length.to_string(), (1..=4096).contains(&unroll.length), "must be 1 to 4096"),
        ("unroll.batch", unroll.batch.to_string(), (1..=65536).contains(&unroll.batch), "must be 1 to 65536"),
        ("actor.threads", actor.threads.to_string(), (1..=1024).contains(&actor.threads), "must be 1 to 1024"),
        ("actor.environments", actor.environments.to_string(), (1..=4096).contains(&actor.environments), "must be 1 to 4096"),
        ("warm_start.noise", warm_start.noise.to_string(), warm_start.noise > 0.0 && warm_start.minibatch_unrolls > 0, "noise must be positive and minibatch_unrolls at least 1"),
        ("learner.threads", learner.threads.to_string(), learner.threads > 0 && learner.checkpoints_kept > 0 && learner.checkpoint_seconds > 0.0 && learner.metrics_seconds > 0.0, "threads and checkpoints_kept must be at least 1, intervals positive"),
    ];
    for (field, value, holds, remedy) in rules {
        if !holds {
            return Err(Error::Value { field, value, remedy });
        }
    }
    Ok(())
}
