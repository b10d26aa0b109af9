//! Guesses which name a misspelt one means.

/// The one of `known` that is most like `name`; `None` when none is similar.
pub fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    /// Jaro-Winkler similarity above which a name counts as a misspelling.
    const SIMILAR: f64 = 0.7;
    let scored = known.into_iter().map(|known| (strsim::jaro_winkler(known, name), known));
    let (similarity, known) = scored.max_by(|a, b| a.0.total_cmp(&b.0))?;
    (similarity > SIMILAR).then_some(known)
}
