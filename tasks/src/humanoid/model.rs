//! The compiled model: the humanoid in an arena, made with MuJoCo's model editing from dm_control's own XML files.
//!
//! dm_control edits `humanoid_CMU_V2020.xml` in Python (`locomotion/walkers/cmu_humanoid.py`, `rescale.py`,
//! `composer/arena.py`, `locomotion/arenas/floors.py`). This crate makes the same edits of the parsed specification, in the
//! same order and with the same arithmetic, so that every array of the compiled model is equal bit for bit. No edited XML
//! is stored.

use std::cell::RefCell;

use comic_clips::WalkerModel;
use mujoco_rs::prelude::*;

use super::body::humanoid;
use super::names::PREFIX;
use crate::arenas::floor;
use crate::error::{Error, refused};

/// Builds the humanoid on the floor. Body `walker/` has a free joint and is at the origin. It contains the whole humanoid,
/// whose names begin with [`PREFIX`].
///
/// # Errors
/// [`Error::Model`]: MuJoCo refuses the XML.
pub fn build(model: WalkerModel) -> Result<MjModel, Error> {
    compile(&humanoid(model)?, floor::floor()?, |_| Ok(()))
}

thread_local! {
    /// The V2020 humanoid alone, kept because a training run compiles many arenas. Each thread has its own, because a
    /// specification cannot be sent to another thread.
    static HUMANOID: RefCell<Option<MjSpec>> = const { RefCell::new(None) };
}

/// Builds the V2020 humanoid in another arena.
pub(crate) fn build_in(arena: MjSpec) -> Result<MjModel, Error> {
    build_with(arena, |_| Ok(()))
}

/// Builds the V2020 humanoid in another arena and adds something after the humanoid.
pub(crate) fn build_with(arena: MjSpec, add: impl FnOnce(&mut MjSpec) -> Result<(), Error>) -> Result<MjModel, Error> {
    HUMANOID.with_borrow_mut(|kept| {
        let walker = match kept {
            Some(walker) => walker,
            None => kept.insert(humanoid(WalkerModel::Cmu2020)?),
        };
        compile(walker, arena, add)
    })
}

fn compile(
    walker: &MjSpec,
    mut arena: MjSpec,
    add: impl FnOnce(&mut MjSpec) -> Result<(), Error>,
) -> Result<MjModel, Error> {
    attach(&mut arena, walker)?;
    add(&mut arena)?;
    arena.compile().map_err(refused("compiling the humanoid in its arena"))
}

/// Adds the humanoid to an arena with a free joint, as `composer.Entity.attach` and `add_free_entity` do.
fn attach(arena: &mut MjSpec, walker: &MjSpec) -> Result<(), Error> {
    // MuJoCo adds a frame around an attached specification and around its original, too. A copy protects the kept
    // humanoid, which is attached thousands of times.
    let mut walker = walker.try_clone().map_err(refused("copying the humanoid"))?;
    // In dm_control the compiler settings of the arena (`composer/arena.xml`) hold for all elements. In MuJoCo elements
    // keep their own settings, so the humanoid gets the arena's.
    let settings = arena.compiler();
    let (degree, mass, inertia) = (settings.degree(), settings.boundmass(), settings.boundinertia());
    walker.compiler_mut().set_degree(degree);
    walker.compiler_mut().set_boundmass(mass);
    walker.compiler_mut().set_boundinertia(inertia);
    let place = arena.world_body_mut().add_body();
    place.set_name(PREFIX).map_err(refused("adding the humanoid's frame"))?;
    place.add_free_joint().set_name(PREFIX).map_err(refused("adding the humanoid's free joint"))?;
    place.attach_by_deep_copy(&mut walker, PREFIX, "").map_err(refused("attaching the humanoid to its arena"))
}
