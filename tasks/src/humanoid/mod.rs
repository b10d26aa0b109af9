//! The CMU humanoid on a floor, built with MuJoCo's model editing from dm_control's own XML files.
//!
//! What dm_control does in Python to `humanoid_CMU_V2020.xml` (`locomotion/walkers/cmu_humanoid.py`, `rescale.py`,
//! `composer/arena.py`, `locomotion/arenas/floors.py`) happens here to the parsed specification, in the same order and
//! with the same arithmetic, so that every array of the compiled model is equal bit for bit. No edited XML is stored.

mod arena;
mod assets;
mod body;
mod servos;

use comic_clips::WalkerModel;
use mujoco_rs::prelude::*;

use crate::error::Error;
use crate::silence;

/// Prefix of every name that belongs to the humanoid.
pub const PREFIX: &str = "walker/";
/// Seconds of one physics step (`DEFAULT_PHYSICS_TIMESTEP` of `reference_pose/tracking.py`).
pub const PHYSICS_TIMESTEP: f64 = 0.005;
/// Bodies whose origins are the end effectors, in the order of the observation (`cmu_humanoid.py`).
pub const END_EFFECTORS: [&str; 4] = ["rradius", "lradius", "rfoot", "lfoot"];

/// Builds the humanoid on the floor: body `walker/` with a free joint at the origin, everything of the humanoid under
/// it and named with [`PREFIX`].
///
/// # Errors
/// [`Error::Asset`] when dm_control's XML is not found, [`Error::Model`] when MuJoCo refuses it.
pub fn build(model: WalkerModel) -> Result<MjModel, Error> {
    silence::install();
    let directory = assets::directory()?;
    let mut walker = body::humanoid(&directory, model)?;
    let mut floor = arena::floor(&directory)?;
    arena::attach(&mut floor, &mut walker)?;
    floor.compile().map_err(refused("compiling the humanoid on the floor"))
}

/// Turns MuJoCo's refusal into this crate's error, with what was being done.
fn refused(doing: &'static str) -> impl Fn(MjEditError) -> Error {
    move |error| Error::Model { doing, reason: error.to_string() }
}

/// An element that the edits rely on and the XML does not have.
fn missing(kind: &'static str, name: &str) -> Error {
    Error::Model { doing: "editing the humanoid", reason: format!("the XML has no {kind} `{name}`") }
}
