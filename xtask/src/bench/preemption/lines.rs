//! The parts of a line of a log.

/// The value of a field of a line.
pub(super) fn field<'a>(line: &'a str, name: &str) -> Option<&'a str> {
    let (_, rest) = line.split_once(&format!(" {name}="))?;
    rest.split(' ').next()
}

/// A field that is a number.
pub(super) fn number(line: &str, name: &str) -> Option<u64> {
    field(line, name)?.parse().ok()
}

/// An incarnation, as logs have it.
pub(super) fn incarnation(text: &str) -> Option<u64> {
    u64::from_str_radix(text, 16).ok()
}

/// The time of a line, as a text that sorts by time: `2026-01-01T00:00:00.000000Z`.
pub(super) fn time(line: &str) -> Option<&str> {
    let (time, _) = line.split_once(' ')?;
    (time.len() == "2026-01-01T00:00:00.000000Z".len() && time.ends_with('Z')).then_some(time)
}
