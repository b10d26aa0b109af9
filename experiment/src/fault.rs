//! The first field with a meaningless value, and the checks that find it. NaN passes none of them.

use std::fmt::{Debug, Display};

/// A field with a meaningless value.
pub(crate) struct Fault {
    /// Dotted name.
    pub(crate) field: String,
    pub(crate) value: String,
    /// What is allowed.
    pub(crate) remedy: String,
}

pub(crate) const AT_LEAST_ONE: &str = "must be at least 1";
pub(crate) const POSITIVE: &str = "must be positive";
pub(crate) const NOT_NEGATIVE: &str = "must be 0 or more";
/// The longest episode, s. A larger number is a typing error.
const LONGEST_EPISODE: f64 = 3600.0;

/// # Errors
/// The fault, unless the condition holds.
pub(crate) fn ensure(field: &str, value: impl Debug, holds: bool, remedy: impl Display) -> Result<(), Fault> {
    if holds {
        return Ok(());
    }
    Err(Fault { field: field.to_string(), value: format!("{value:?}"), remedy: remedy.to_string() })
}

/// Whether the number is finite and above 0.
pub(crate) fn positive(number: f64) -> bool {
    number > 0.0 && number.is_finite()
}

/// Whether the number is finite and at least 0.
pub(crate) fn not_negative(number: f64) -> bool {
    number >= 0.0 && number.is_finite()
}

/// A section of the document. Its methods check one field each, by the field's name inside the section.
#[derive(Clone, Copy)]
pub(crate) struct Section(pub(crate) &'static str);

impl Section {
    /// The field's whole name.
    pub(crate) fn field(self, name: &str) -> String {
        format!("{}.{name}", self.0)
    }

    pub(crate) fn ensure(self, name: &str, value: impl Debug, holds: bool, remedy: impl Display) -> Result<(), Fault> {
        ensure(&self.field(name), value, holds, remedy)
    }

    /// The length of an episode.
    pub(crate) fn seconds(self, name: &str, value: f64) -> Result<(), Fault> {
        self.ensure(name, value, value > 0.0 && value <= LONGEST_EPISODE, "must be positive seconds, at most 3600")
    }

    pub(crate) fn metres(self, name: &str, value: f64) -> Result<(), Fault> {
        self.ensure(name, value, value > 0.0 && value <= 1e4, "must be positive metres, at most 10000")
    }

    /// `[low, high]` within the limits.
    pub(crate) fn range(self, name: &str, value: [f64; 2], [least, most]: [f64; 2]) -> Result<(), Fault> {
        let [low, high] = value;
        let holds = least <= low && low <= high && high <= most;
        self.ensure(name, value, holds, format!("must be [low, high] within {least} to {most}"))
    }

    /// A standard deviation.
    pub(crate) fn deviation(self, name: &str, value: f64) -> Result<(), Fault> {
        self.ensure(name, value, (0.0..=100.0).contains(&value), "must be 0 to 100")
    }
}
