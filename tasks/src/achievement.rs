//! What an episode achieved, by the task's own definition.

/// The largest number of measures of any task.
const MAX_MEASURES: usize = 2;

/// What an episode achieved. Each task defines its success and its measures (`docs/tasks.md`).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Achievement {
    /// Whether the episode reached the task's goal.
    pub success: bool,
    names: &'static [&'static str],
    values: [f64; MAX_MEASURES],
}

impl Achievement {
    /// An achievement without measures.
    pub const fn new(success: bool) -> Self {
        Self { success, names: &[], values: [0.0; MAX_MEASURES] }
    }

    /// With these measures.
    ///
    /// A task always has the same names, in the same order.
    pub fn measuring<const N: usize>(self, names: &'static [&'static str; N], measured: [f64; N]) -> Self {
        const { assert!(N <= MAX_MEASURES, "MAX_MEASURES is too small") };
        let mut values = [0.0; MAX_MEASURES];
        values[..N].copy_from_slice(&measured);
        Self { names, values, ..self }
    }

    /// The measures: name and value. The task defines their units.
    pub fn measures(&self) -> impl Iterator<Item = (&'static str, f64)> {
        self.names.iter().copied().zip(self.values)
    }

    /// The same measures without success: nothing counts as success in a simulation that diverged.
    pub(crate) fn of_divergence(self) -> Self {
        Self { success: false, ..self }
    }
}
