//! Fields by their dotted names: finds a field by the end of its name, and compares two experiments field by field.

use toml::{Table, Value};

use crate::document::Experiment;
use crate::error::Error;
use crate::nearest::nearest;
use crate::vocabulary::{join, vocabulary};

/// The whole name of the field that `name` means. A name that begins with a section is returned as it is, without a check
/// that the field exists. Any other name must be the end of exactly one field's name: `latent.beta` means
/// `network.latent.beta`. Errors say that the name was written in `origin`.
///
/// # Errors
/// [`Error::UnknownField`] with the nearest name when no field's name ends like this; [`Error::AmbiguousField`] when
/// several do.
pub fn find_field(origin: &str, name: &str) -> Result<String, Error> {
    // TOML can write all default values, so the vocabulary is never empty.
    let everything = vocabulary().unwrap_or_default();
    let first = name.split('.').next().unwrap_or(name);
    if everything.contains_key(first) {
        return Ok(name.to_string());
    }
    let mut fields = Vec::new();
    collect_fields("", &everything, &mut fields);
    let depth = name.split('.').count();
    let ends: Vec<&str> = fields.iter().map(|field| end_of(field, depth)).collect();
    let ending_with = |end: &str| -> Vec<&str> {
        fields.iter().zip(&ends).filter(|(_, other)| **other == end).map(|(field, _)| field.as_str()).collect()
    };
    match ending_with(name)[..] {
        [field] => Ok(field.to_string()),
        [] => Err(Error::UnknownField {
            origin: origin.to_string(),
            field: name.to_string(),
            hint: match nearest(name, ends.iter().copied()) {
                Some(end) => format!("; did you mean `{}`?", ending_with(end).join("` or `")),
                None => format!("; sections are {}", everything.keys().cloned().collect::<Vec<_>>().join(", ")),
            },
        }),
        ref several => Err(Error::AmbiguousField {
            origin: origin.to_string(),
            field: name.to_string(),
            candidates: format!("`{}`", several.join("` or `")),
        }),
    }
}

/// Collects the whole name of every field that is not a section.
fn collect_fields(prefix: &str, table: &Table, fields: &mut Vec<String>) {
    for (key, value) in table {
        let name = join(prefix, key);
        match value {
            Value::Table(section) => collect_fields(&name, section, fields),
            _ => fields.push(name),
        }
    }
}

/// The last `depth` parts of a dotted name.
fn end_of(field: &str, depth: usize) -> &str {
    field.rmatch_indices('.').nth(depth.saturating_sub(1)).map_or(field, |(dot, _)| &field[dot + 1..])
}

/// A field with different values in two experiments.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// Dotted name.
    pub field: String,
    /// The first experiment's value as TOML; "nothing" when it does not have the field.
    pub ours: String,
    /// The second experiment's value as TOML.
    pub theirs: String,
}

impl Experiment {
    /// Every field that `other` has with another value.
    ///
    /// # Errors
    /// [`Error::Malformed`] when a number is beyond what TOML can write.
    pub fn differences(&self, other: &Self) -> Result<Vec<Difference>, Error> {
        let [ours, theirs] = [self.to_table()?, other.to_table()?];
        let mut differences = Vec::new();
        collect_differences("", &ours, &theirs, &mut differences);
        Ok(differences)
    }
}

fn collect_differences(prefix: &str, ours: &Table, theirs: &Table, differences: &mut Vec<Difference>) {
    for key in ours.keys().chain(theirs.keys().filter(|key| !ours.contains_key(*key))) {
        let field = join(prefix, key);
        match (ours.get(key), theirs.get(key)) {
            (Some(Value::Table(ours)), Some(Value::Table(theirs))) => {
                collect_differences(&field, ours, theirs, differences);
            }
            (ours, theirs) if ours == theirs => {}
            (ours, theirs) => {
                let text = |value: Option<&Value>| value.map_or_else(|| "nothing".to_string(), Value::to_string);
                differences.push(Difference { field, ours: text(ours), theirs: text(theirs) });
            }
        }
    }
}
