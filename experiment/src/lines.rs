//! Finds the line of a field in a document.

use toml::de::{DeTable, DeValue};

/// The line, counted from 1, of the field with this dotted name, or of the deepest part of its path in the text. `None`
/// when the text has no part of the path.
pub(crate) fn line_of(text: &str, field: &str) -> Option<usize> {
    let document = DeTable::parse(text).ok()?;
    let mut found = None;
    let mut place = Place::Table(document.get_ref());
    for part in field.split('.') {
        let (offset, value) = match place {
            Place::Table(table) => {
                let Some((key, value)) = table.iter().find(|(key, _)| key.get_ref() == part) else { break };
                (key.span().start, value.get_ref())
            }
            Place::Value(DeValue::Array(items)) => {
                let Some(item) = part.parse().ok().and_then(|index: usize| items.get(index)) else { break };
                (item.span().start, item.get_ref())
            }
            Place::Value(_) => break,
        };
        found = Some(offset);
        place = match value {
            DeValue::Table(table) => Place::Table(table),
            value => Place::Value(value),
        };
    }
    let before = text.get(..found?)?;
    Some(1 + before.matches('\n').count())
}

enum Place<'a, 'text> {
    Table(&'a DeTable<'text>),
    Value(&'a DeValue<'text>),
}
