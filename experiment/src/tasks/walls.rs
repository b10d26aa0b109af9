//! The corridor with walls.

use serde::{Deserialize, Serialize};

use super::corridor::{Corridor, OBSERVATIONS, REWARD_TERMS};
use super::{TaskParameters, Vision, fixed};
use crate::fault::{Fault, Section};

/// The corridor with walls (`locomotion/arenas/corridors.py`, `WallsCorridor`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Walls {
    /// Distance from wall to wall, m (S; dm_control's example: 4).
    pub spacing: f64,
    /// Range of how far a wall reaches into the corridor, m (S).
    pub wall_width: [f64; 2],
    /// Range of a wall's height, m (S; dm_control's example: 3).
    pub wall_height: [f64; 2],
    /// The side of the walls.
    pub side: WallSide,
    /// Whether walls have random colours (S; dm_control's default: white).
    pub random_colours: bool,
    /// Moves the first wall 4 m further away (on by default in dm_control, off in its example).
    pub initial_padding: bool,
    /// The parameters of both corridors.
    pub corridor: Corridor,
}

impl Default for Walls {
    fn default() -> Self {
        Self {
            spacing: 5.0,
            wall_width: [1.0, 7.0],
            wall_height: [2.5, 4.0],
            side: WallSide::Random,
            random_colours: true,
            initial_padding: false,
            corridor: Corridor::default(),
        }
    }
}

/// The side of the corridor from which a wall reaches into it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WallSide {
    /// A random side for each wall (S: "randomly placed on either side").
    Random,
    /// First left, then right, and so on (dm_control's default).
    Alternate,
}

impl TaskParameters for Walls {
    fn check(&self, section: Section) -> Result<(), Fault> {
        let spacing = self.spacing;
        section.ensure("spacing", spacing, (0.5..=1000.0).contains(&spacing), "must be 0.5 to 1000 metres")?;
        section.range("wall_width", self.wall_width, [0.01, self.corridor.width])?;
        section.range("wall_height", self.wall_height, [0.01, 100.0])?;
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
