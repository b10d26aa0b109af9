//! The humanoid's surroundings: dm_control's arenas (`locomotion/arenas`).

mod base;
pub(crate) mod corridor;
pub(crate) mod floor;
