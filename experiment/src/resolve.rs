//! From a preset or a file, and `--set` overrides, to an [`Experiment`].

use std::path::Path;

use toml::{Table, Value};

use crate::check::check;
use crate::clips::ClipSource;
use crate::document::Experiment;
use crate::error::Error;
use crate::lines::line_of;
use crate::presets;
use crate::vocabulary::{Unknown, refuse_unknown};

/// Resolves `document`, which is a preset's name or the path of a TOML file. Then applies `overrides` of the form
/// `field.path=value` in order. A number names an element of an array: `clips.0.weight=2`. An override of `algorithm` comes
/// before all others, and gives what the new algorithm does not read its default.
///
/// # Errors
/// [`Error`], naming file, line and field.
pub fn resolve(document: &str, overrides: &[String]) -> Result<Experiment, Error> {
    let (origin, text) = read(document)?;
    overridden(decode(&origin, &text)?, overrides, |field| at(&origin, &text, field))
}

/// Applies and checks overrides. `origin` says where a field stands that none of them names.
fn overridden(
    experiment: Experiment,
    overrides: &[String],
    origin: impl Fn(&str) -> String,
) -> Result<Experiment, Error> {
    let (choices, others): (Vec<_>, Vec<_>) = overrides.iter().partition(|argument| path_of(argument) == "algorithm");
    let choose = |experiment, argument: &String| with_unread_at_defaults(&apply_override(&experiment, argument)?);
    let experiment = choices.into_iter().try_fold(experiment, choose)?;
    let experiment =
        others.into_iter().try_fold(experiment, |experiment, argument| apply_override(&experiment, argument))?;
    check(&experiment).map_err(|fault| {
        let argument = overrides.iter().rev().find(|argument| names(argument, &fault.field));
        let origin = argument.map_or_else(|| origin(&fault.field), |argument| format!("--set {argument}"));
        Error::Value { origin, field: fault.field, value: fault.value, remedy: fault.remedy }
    })?;
    Ok(experiment)
}

impl Experiment {
    /// The experiment with other clips. `sources` has the form of the command line ([`ClipSource::parse`]). An empty list
    /// changes nothing.
    #[must_use]
    pub fn with_clips(mut self, sources: &[String]) -> Self {
        if !sources.is_empty() {
            self.clips = sources.iter().map(|source| ClipSource::parse(source)).collect();
        }
        self
    }

    /// The experiment with overrides, as [`resolve`] applies them.
    ///
    /// # Errors
    /// [`Error`], naming the override and the field.
    pub fn with_overrides(self, overrides: &[String]) -> Result<Self, Error> {
        overridden(self, overrides, |_| "the checkpoint's experiment".into())
    }

    /// Reads a resolved document, for instance one from the wire. Errors call it `origin`.
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

    /// As [`from_toml`](Self::from_toml), with the default of every field that the algorithm does not read.
    pub(crate) fn from_toml_with_unread(origin: &str, text: &str) -> Result<Self, Error> {
        Self::from_toml(origin, &with_unread_at_defaults(&decode(origin, text)?)?.to_toml()?)
    }

    /// The whole document with every field.
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

/// Turns text into values. It checks syntax, names and types; [`check`] checks what the values mean.
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

/// `origin:line` of a field, or of the deepest part of its path in the text.
fn at(origin: &str, text: &str, field: &str) -> String {
    line_of(text, field).map_or_else(|| origin.to_string(), |line| format!("{origin}:{line}"))
}

/// Whether `argument` sets `field`, a part of it, or a section that contains it.
fn names(argument: &str, field: &str) -> bool {
    let path = path_of(argument);
    let within = |outer: &str, inner: &str| {
        inner.strip_prefix(outer).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    within(path, field) || within(field, path)
}

/// The field that `argument` sets.
fn path_of(argument: &str) -> &str {
    argument.split_once('=').map_or(argument, |(path, _)| path).trim()
}

/// The experiment with the default of every field that its algorithm does not read.
fn with_unread_at_defaults(experiment: &Experiment) -> Result<Experiment, Error> {
    let mut document = Value::Table(experiment.to_table()?);
    let defaults = Value::Table(Experiment::default().to_table()?);
    // Without its other tasks the experiment would be another one, so that is refused.
    for name in experiment.unread().into_iter().filter(|name| *name != "joint") {
        let default = name.split('.').try_fold(&defaults, |place, part| place.get(part));
        if let (Some(place), Some(default)) = (place(&mut document, name), default) {
            *place = default.clone();
        }
    }
    document.try_into().map_err(|error| malformed("experiment", &on_one_line(&error)))
}

/// Applies one `--set`. Its name and type are checked here, so that an error can name the argument.
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
    // Text that is not a TOML value is a string: `--set name=mine` needs no quotes. Neither does `--set name=7`.
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

/// The value at a dotted path. Creates missing sections on the path, but no elements of arrays.
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
