//! What can be wrong with a document.

/// Why a document is not an experiment. Every message names the document and, where there is one, line, field and remedy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No preset has this name, and it is no readable file.
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
        /// The parser's message, with line and column.
        message: String,
    },
    /// A field that no experiment has.
    #[error("{origin}: unknown field `{field}`{hint}")]
    UnknownField {
        /// The file and line, the preset, or the `--set` argument.
        origin: String,
        /// Its dotted name. A number is a place in an array, as in `--set clips.0.weight=2`.
        field: String,
        /// "; did you mean `…`?", or the names of the section's fields.
        hint: String,
    },
    /// A short name that matches the end of several fields' names.
    #[error("{origin}: `{field}` could be {candidates}; write one of them")]
    AmbiguousField {
        /// Where the name was written.
        origin: String,
        /// As it was written.
        field: String,
        /// The fields that end like this.
        candidates: String,
    },
    /// `--set` without `=`.
    #[error("--set {argument}: expected FIELD=VALUE, for instance --set vmpo.epsilon_eta=0.2")]
    Override {
        /// The argument as given.
        argument: String,
    },
    /// A meaningless value.
    #[error("{origin}: {field} = {value}: {remedy}")]
    Value {
        /// The file and line, the preset, or the `--set` argument.
        origin: String,
        /// Dotted name.
        field: String,
        /// The value given.
        value: String,
        /// What is allowed.
        remedy: String,
    },
    /// A checkpoint of another release.
    #[error(
        "the checkpoint has format {found}, and this release reads format {known}: continue the run with the release that wrote \
         it, or export its policy there (`comic-learner export`), which this release reads"
    )]
    Format {
        /// The checkpoint's format.
        found: u32,
        /// The format of this release.
        known: u32,
    },
}
