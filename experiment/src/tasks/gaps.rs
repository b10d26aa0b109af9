//! The corridor with gaps.

use serde::{Deserialize, Serialize};

use super::corridor::{Corridor, OBSERVATIONS, REWARD_TERMS};
use super::{TaskParameters, Vision, fixed};
use crate::fault::{Fault, Section};

/// The corridor with gaps (`locomotion/arenas/corridors.py`, `GapsCorridor`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Gaps {
    /// Range of a platform's length, m (S).
    pub platform: [f64; 2],
    /// Range of a gap's length, m (S; dm_control's example: 0.5 to 1.25).
    pub gap: [f64; 2],
    /// The parameters of both corridors.
    pub corridor: Corridor,
}

impl Default for Gaps {
    fn default() -> Self {
        Self { platform: [0.3, 2.5], gap: [0.75, 1.25], corridor: Corridor::default() }
    }
}

impl TaskParameters for Gaps {
    fn check(&self, section: Section) -> Result<(), Fault> {
        section.range("platform", self.platform, [0.1, 1000.0])?;
        section.range("gap", self.gap, [0.0, 1000.0])?;
        self.corridor.check(section)
    }

    fn reward_terms(&self) -> &'static [&'static str] {
        &REWARD_TERMS
    }

    fn observations(&self) -> Result<Vec<(String, usize)>, String> {
        Ok(fixed(&OBSERVATIONS))
    }

    fn max_reward(&self) -> f64 {
        1.0
    }

    fn vision(&self) -> Option<(&'static str, Vision)> {
        Some(("corridor.vision", self.corridor.vision))
    }
}
