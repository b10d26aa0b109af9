//! Fields by their dotted names: found by how they end, guessed when misspelt, compared between two experiments.

use toml::{Table, Value};

use crate::resolve::{join, vocabulary};
use crate::{Error, Experiment};

/// Of `known`, the name that `name` is most likely a misspelling of.
pub fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    /// Jaro-Winkler similarity from which a name is taken for a misspelling.
    const SIMILAR: f64 = 0.7;
    let scored = known.into_iter().map(|known| (strsim::jaro_winkler(known, name), known));
    let (similarity, known) = scored.max_by(|a, b| a.0.total_cmp(&b.0))?;
    (similarity > SIMILAR).then_some(known)
}

/// The whole name of the field that `name` means. A name that begins with a section is whole already, and whether there
/// is such a field is for [`resolve`](crate::resolve) to say; any other is the end of exactly one field's name, as
/// `latent.beta` is of `network.latent.beta`. `origin` is where it stands, for errors.
///
/// # Errors
/// [`Error::UnknownField`] with the nearest name when no field's name ends like this; [`Error::AmbiguousField`] when
/// several do.
pub fn find_field(origin: &str, name: &str) -> Result<String, Error> {
    // The defaults have every name there is, and TOML can write them all.
    let everything = vocabulary().unwrap_or_default();
    let first = name.split('.').next().unwrap_or(name);
    if everything.contains_key(first) {
        return Ok(name.to_string());
    }
    let mut fields = Vec::new();
    collect_fields("", &everything, &mut fields);
    let depth = name.split('.').count();
    let ends: Vec<&str> = fields.iter().map(|field| end_of(field, depth)).collect();
    let meant = |end: &str| -> Vec<&str> {
        fields.iter().zip(&ends).filter(|(_, other)| **other == end).map(|(field, _)| field.as_str()).collect()
    };
    match meant(name)[..] {
        [field] => Ok(field.to_string()),
        [] => Err(Error::UnknownField {
            origin: origin.to_string(),
            field: name.to_string(),
            hint: match nearest(name, ends.iter().copied()) {
                Some(end) => format!("; did you mean `{}`?", meant(end).join("` or `")),
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

/// The whole name of every field that is no section.
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

/// A field in which two experiments differ, and its values as TOML.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// Dotted name.
    pub field: String,
    /// The one's value; "nothing" where the field is absent.
    pub ours: String,
    /// The other's.
    pub theirs: String,
}

impl Experiment {
    /// Every field in which `other` is another experiment.
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
