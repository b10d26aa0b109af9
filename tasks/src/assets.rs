//! dm_control's XML files (Apache License 2.0, see NOTICE). They are part of the program, so an actor needs no file beside it.
//!
//! `cargo xtask setup` takes them from dm_control's wheel, and `.cargo/config.toml` sets the variable at build time.

macro_rules! file {
    ($name:literal) => {
        include_str!(concat!(env!("COMIC_DM_CONTROL_DIR"), "/", $name))
    };
}

/// The composer's arena.
pub(crate) const ARENA: &str = file!("arena.xml");
/// The humanoid of `CMUHumanoidPositionControlled`.
pub(crate) const HUMANOID_2019: &str = file!("humanoid_CMU_V2019.xml");
/// The humanoid of `CMUHumanoidPositionControlledV2020`.
pub(crate) const HUMANOID_2020: &str = file!("humanoid_CMU_V2020.xml");
