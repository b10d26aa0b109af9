//! From a preset or a file, and `--set` overrides, to an [`Experiment`].

use std::path::Path;

use toml::{Table, Value};

use crate::{ClipSource, Complement, Experiment, TaskName, check::check, fields::nearest, lines::line_of, presets};

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
        /// The file and line, preset or `--set` it stands in.
        origin: String,
        /// Its dotted name; a number is a place in an array, as in `--set clips.0.weight=2`.
        field: String,
        /// "; did you mean `…`?", or the names known there.
        hint: String,
    },
    /// The end of several fields' names.
    #[error("{origin}: `{field}` could be {candidates}: write one of them")]
    AmbiguousField {
        /// Where it stands.
        origin: String,
        /// As it was written.
        field: String,
        /// The fields it could be.
        candidates: String,
    },
    /// `--set` without `=`.
    #[error("--set {argument}: expected FIELD=VALUE, for instance --set vmpo.epsilon_eta=0.2")]
    Override {
        /// The argument as given.
        argument: String,
    },
    /// A value outside its meaning.
    #[error("{origin}: {field} = {value}: {remedy}")]
    Value {
        /// The file and line, preset or `--set` it stands in.
        origin: String,
        /// Dotted name.
        field: String,
        /// The value given.
        value: String,
        /// What is allowed.
        remedy: String,
    },
}

/// Resolves `document`, a preset's name or the path of a TOML file, with `overrides` of the form `field.path=value`
/// applied in order. Elements of arrays are named by number: `clips.0.weight=2`.
///
/// # Errors
/// [`Error`], naming file, line and field.
pub fn resolve(document: &str, overrides: &[String]) -> Result<Experiment, Error> {
    let (origin, text) = read(document)?;
    let mut experiment = decode(&origin, &text)?;
    for argument in overrides {
        experiment = apply_override(&experiment, argument)?;
    }
    check(&experiment).map_err(|fault| {
        let overridden = overrides.iter().rev().find(|argument| names(argument, &fault.field));
        let origin =
            overridden.map_or_else(|| at(&origin, &text, &fault.field), |argument| format!("--set {argument}"));
        Error::Value { origin, field: fault.field, value: fault.value, remedy: fault.remedy }
    })?;
    Ok(experiment)
}

impl Experiment {
    /// The same experiment on `sources` in the command line's form, [`ClipSource::parse`]; on its own clips if empty.
    #[must_use]
    pub fn with_clips(mut self, sources: &[String]) -> Self {
        if !sources.is_empty() {
            self.clips = sources.iter().map(|source| ClipSource::parse(source)).collect();
        }
        self
    }

    /// Reads a resolved document, for instance one that came over the wire. `origin` names it in errors.
    ///
    /// # Errors
    /// [`Error`], naming line and field.
    pub fn from_toml(origin: &str, text: &str) -> Result<Self, Error> {
        let experiment = decode(origin, text)?;
        check(&experiment).map_err(|fault| {
            let origin = at(origin, text, &fault.field);
            Error::Value { origin, field: fault.field, value: fault.value, remedy: fault.remedy }
        })?;
        Ok(experiment)
    }

    /// The whole document, every field written out.
    ///
    /// # Errors
    /// [`Error::Malformed`] when a number is beyond what TOML can write.
    pub fn to_toml(&self) -> Result<String, Error> {
        toml::to_string(self).map_err(|error| malformed("experiment", &error))
    }

    pub(crate) fn to_table(&self) -> Result<Table, Error> {
        Table::try_from(self).map_err(|error| malformed("experiment", &error))
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

/// Text to values: syntax, names and types, each with its line; what the values mean is for [`check`].
fn decode(origin: &str, text: &str) -> Result<Experiment, Error> {
    let table: Table = text.parse().map_err(|error| malformed(origin, &error))?;
    refuse_unknown(&table).map_err(|Unknown { field, hint }| {
        let origin = at(origin, text, &field);
        Error::UnknownField { origin, field, hint }
    })?;
    toml::from_str(text).map_err(|error| malformed(origin, &error))
}

fn malformed(origin: &str, error: &impl std::fmt::Display) -> Error {
    Error::Malformed { origin: origin.to_string(), message: error.to_string().trim_end().to_string() }
}

/// `origin:line` of a field, as far as the text names it.
fn at(origin: &str, text: &str, field: &str) -> String {
    line_of(text, field).map_or_else(|| origin.to_string(), |line| format!("{origin}:{line}"))
}

/// Whether `argument` sets `field`, something in it, or something it is in.
fn names(argument: &str, field: &str) -> bool {
    let path = argument.split_once('=').map_or(argument, |(path, _)| path).trim();
    let within = |outer: &str, inner: &str| {
        inner.strip_prefix(outer).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    within(path, field) || within(field, path)
}

struct Unknown {
    field: String,
    hint: String,
}

fn refuse_unknown(table: &Table) -> Result<(), Unknown> {
    // The defaults have every name there is, and TOML can write them all.
    let Ok(everything) = vocabulary() else { return Ok(()) };
    refuse_unknown_in("", table, &everything, &everything)
}

/// The default document with every optional field present.
pub(crate) fn vocabulary() -> Result<Table, toml::ser::Error> {
    let complement = Complement { task: TaskName::GetUp, probability: 0.1 };
    let mut everything = Experiment { joint: vec![complement], ..Experiment::default() };
    for clip in &mut everything.clips {
        clip.subset = Some(String::new());
        clip.ids = vec![String::new()];
        clip.end_step = Some(0);
    }
    Table::try_from(&everything)
}

fn refuse_unknown_in(prefix: &str, table: &Table, known: &Table, everything: &Table) -> Result<(), Unknown> {
    for (key, value) in table {
        let field = join(prefix, key);
        let Some(model) = known.get(key) else {
            return Err(Unknown { hint: hint(prefix, key, known, everything), field });
        };
        match (value, model) {
            (Value::Table(inner), Value::Table(names)) => refuse_unknown_in(&field, inner, names, everything)?,
            (Value::Array(items), Value::Array(models)) => {
                let Some(Value::Table(names)) = models.first() else { continue };
                for (index, item) in items.iter().enumerate() {
                    let Value::Table(item) = item else { continue };
                    refuse_unknown_in(&join(&field, &index.to_string()), item, names, everything)?;
                }
            }
            // A value of the wrong kind is for serde to refuse.
            _ => {}
        }
    }
    Ok(())
}

pub(crate) fn join(prefix: &str, key: &str) -> String {
    if prefix.is_empty() { key.to_string() } else { format!("{prefix}.{key}") }
}

/// The same name in another section, else the nearest in this one, else all names of this one.
fn hint(prefix: &str, key: &str, known: &Table, everything: &Table) -> String {
    let meant = elsewhere("", key, everything)
        .or_else(|| nearest(key, known.keys().map(String::as_str)).map(|name| join(prefix, name)));
    match meant {
        Some(path) => format!("; did you mean `{path}`?"),
        None => format!("; known here are {}", known.keys().cloned().collect::<Vec<_>>().join(", ")),
    }
}

fn elsewhere(prefix: &str, key: &str, table: &Table) -> Option<String> {
    if table.contains_key(key) {
        return Some(join(prefix, key));
    }
    table.iter().find_map(|(name, value)| elsewhere(&join(prefix, name), key, value.as_table()?))
}

/// One `--set`, checked for its name and type on its own, so that an error can name it.
fn apply_override(experiment: &Experiment, argument: &str) -> Result<Experiment, Error> {
    let expected = || Error::Override { argument: argument.to_string() };
    let (path, text) = argument.split_once('=').ok_or_else(expected)?;
    let (path, text) = (path.trim(), text.trim());
    if path.is_empty() || path.split('.').any(str::is_empty) {
        return Err(expected());
    }
    let origin = format!("--set {argument}");
    let document = Table::try_from(experiment).map_err(|error| malformed(&origin, &error))?;
    let with = |value: Value| {
        let mut document = Value::Table(document.clone());
        *place(&mut document, path).ok_or_else(|| malformed(&origin, &format!("no element `{path}`")))? = value;
        if let Value::Table(table) = &document {
            refuse_unknown(table).map_err(|Unknown { field, hint }| Error::UnknownField {
                origin: origin.clone(),
                field,
                hint,
            })?;
        }
        document.try_into::<Experiment>().map_err(|error| malformed(&origin, &on_one_line(&error)))
    };
    // Anything that is no TOML value is a string, so `--set name=mine` needs no quotes; nor does `--set name=7`.
    let string = || with(Value::String(text.to_string()));
    match parse_value(text) {
        Some(value) => with(value).or_else(|error| string().map_err(|_| error)),
        None => string(),
    }
}

fn parse_value(text: &str) -> Option<Value> {
    let mut parsed: Table = format!("value = {text}").parse().ok()?;
    let value = parsed.remove("value");
    value.filter(|_| parsed.is_empty())
}

/// The value at a dotted path; sections on the way are made where there are none, elements of arrays are not.
fn place<'a>(document: &'a mut Value, path: &str) -> Option<&'a mut Value> {
    path.split('.').try_fold(document, |place, part| match place {
        Value::Array(items) => items.get_mut(part.parse::<usize>().ok()?),
        place => {
            if !place.is_table() {
                *place = Value::Table(Table::new());
            }
            Some(place.as_table_mut()?.entry(part).or_insert_with(|| Value::Table(Table::new())))
        }
    })
}

fn on_one_line(error: &toml::de::Error) -> String {
    error.to_string().lines().map(str::trim).filter(|line| !line.is_empty()).collect::<Vec<_>>().join(" ")
}
