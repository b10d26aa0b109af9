//! The CMU humanoid on a floor, built with MuJoCo's model editing from dm_control's own XML files.
//!
//! What dm_control does in Python to `humanoid_CMU_V2020.xml` (`locomotion/walkers/cmu_humanoid.py`, `rescale.py`,
//! `composer/arena.py`, `locomotion/arenas/floors.py`) happens here to the parsed specification, in the same order and
//! with the same arithmetic, so that every array of the compiled model is equal bit for bit. No edited XML is stored.

mod body;
mod servos;

use std::cell::RefCell;
use std::path::Path;

use comic_clips::WalkerModel;
use mujoco_rs::prelude::*;

use crate::error::Error;
use crate::{arenas, assets, silence};

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
    compile(&body::humanoid(&directory, model)?, arenas::floor::floor(&directory)?, |_| Ok(()))
}

thread_local! {
    /// The V2020 humanoid alone, made at a thread's first arena: the specification cannot go from thread to thread,
    /// and arenas are compiled many times in a training run.
    static HUMANOID: RefCell<Option<MjSpec>> = const { RefCell::new(None) };
}

/// As [`build`], for the V2020 humanoid in another arena. `arena` is told where dm_control's XML files are.
pub(crate) fn build_in(arena: impl FnOnce(&Path) -> Result<MjSpec, Error>) -> Result<MjModel, Error> {
    build_with(arena, |_| Ok(()))
}

/// As [`build_in`], with something added after the humanoid.
pub(crate) fn build_with(
    arena: impl FnOnce(&Path) -> Result<MjSpec, Error>,
    add: impl FnOnce(&mut MjSpec) -> Result<(), Error>,
) -> Result<MjModel, Error> {
    silence::install();
    let directory = assets::directory()?;
    let arena = arena(&directory)?;
    HUMANOID.with_borrow_mut(|kept| {
        let humanoid = match kept {
            Some(humanoid) => humanoid,
            None => kept.insert(body::humanoid(&directory, WalkerModel::Cmu2020)?),
        };
        compile(humanoid, arena, add)
    })
}

fn compile(
    humanoid: &MjSpec,
    mut arena: MjSpec,
    add: impl FnOnce(&mut MjSpec) -> Result<(), Error>,
) -> Result<MjModel, Error> {
    arenas::attach(&mut arena, humanoid)?;
    add(&mut arena)?;
    arena.compile().map_err(refused("compiling the humanoid in its arena"))
}

/// Turns MuJoCo's refusal into this crate's error, with what was being done.
pub(crate) fn refused(doing: &'static str) -> impl Fn(MjEditError) -> Error {
    move |error| Error::Model { doing, reason: error.to_string() }
}

/// An element that the edits rely on and the XML does not have.
pub(crate) fn missing(kind: &'static str, name: &str) -> Error {
    Error::Model { doing: "editing the humanoid", reason: format!("the XML has no {kind} `{name}`") }
}
