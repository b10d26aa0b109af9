//! Suggestions of similar names for a name that is unknown.

use strsim::normalized_damerau_levenshtein;

/// Least similarity of a suggested name.
const SIMILAR: f64 = 0.55;

/// ` (did you mean `a`, `b` or `c`?)` with the most similar names first, or an empty string if no name is similar.
pub(crate) fn hint<'a>(wanted: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    let lower = wanted.to_lowercase();
    let mut near: Vec<(f64, &str)> = known
        .into_iter()
        .map(|name| (normalized_damerau_levenshtein(&lower, &name.to_lowercase()), name))
        .filter(|(similarity, _)| *similarity >= SIMILAR)
        .collect();
    // Among equally similar names, the one with the longest common beginning is first: CMU's names begin with the
    // subject.
    let alike = |name: &str| lower.chars().zip(name.to_lowercase().chars()).take_while(|(a, b)| a == b).count();
    near.sort_by(|a, b| b.0.total_cmp(&a.0).then(alike(b.1).cmp(&alike(a.1))).then(a.1.cmp(b.1)));
    let names: Vec<String> = near.iter().take(3).map(|(_, name)| format!("`{name}`")).collect();
    match names.split_last() {
        None => String::new(),
        Some((only, [])) => format!(" (did you mean {only}?)"),
        Some((last, others)) => format!(" (did you mean {} or {last}?)", others.join(", ")),
    }
}
