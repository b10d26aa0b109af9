//! The names of all fields, and the search for a field that no experiment has.

use toml::{Table, Value};

use crate::document::{Complement, Experiment};
use crate::nearest::nearest;
use crate::tasks::TaskName;

/// A field that no experiment has.
pub(crate) struct Unknown {
    pub(crate) field: String,
    pub(crate) hint: String,
}

/// # Errors
/// The first field of `table` that no experiment has.
pub(crate) fn refuse_unknown(table: &Table) -> Result<(), Unknown> {
    // TOML can write all default values, so this never returns early.
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
            // Serde refuses a value of the wrong type.
            _ => {}
        }
    }
    Ok(())
}

pub(crate) fn join(prefix: &str, key: &str) -> String {
    if prefix.is_empty() { key.to_string() } else { format!("{prefix}.{key}") }
}

/// Names the same field in other sections, or else the nearest name in this section, or else all names of this section.
fn hint(prefix: &str, key: &str, known: &Table, everything: &Table) -> String {
    let mut intended = Vec::new();
    elsewhere("", key, everything, &mut intended);
    if intended.is_empty() {
        intended.extend(nearest(key, known.keys().map(String::as_str)).map(|name| join(prefix, name)));
    }
    match &intended[..] {
        [_, ..] => format!("; did you mean `{}`?", intended.join("` or `")),
        [] => format!("; known here are {}", known.keys().cloned().collect::<Vec<_>>().join(", ")),
    }
}

fn elsewhere(prefix: &str, key: &str, table: &Table, found: &mut Vec<String>) {
    if table.contains_key(key) {
        found.push(join(prefix, key));
    }
    for (name, value) in table {
        if let Value::Table(section) = value {
            elsewhere(&join(prefix, name), key, section, found);
        }
    }
}
