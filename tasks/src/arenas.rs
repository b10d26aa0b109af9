//! Where the humanoid is: dm_control's arenas (`locomotion/arenas`), each over its `composer/arena.xml`.

pub(crate) mod corridor;
pub(crate) mod floor;

use std::path::Path;

use mujoco_rs::prelude::*;

use crate::assets;
use crate::error::Error;
use crate::humanoid::{PHYSICS_TIMESTEP, PREFIX, refused};

/// `<size njmax nconmax>` of the humanoid's XML, which dm_control merges into the arena's.
const MAX_CONSTRAINTS: i32 = 500;

/// What every arena starts from.
fn base(directory: &Path, name: &str) -> Result<MjSpec, Error> {
    let path = assets::file(directory, "arena.xml")?;
    let mut spec = MjSpec::from_xml(path).map_err(refused("reading arena.xml"))?;
    spec.set_modelname(name);
    spec.option_mut().timestep = PHYSICS_TIMESTEP;
    let headlight = &mut spec.visual_mut().headlight;
    headlight.ambient = [0.4; 3];
    headlight.diffuse = [0.8; 3];
    headlight.specular = [0.1; 3];
    set_sizes(&mut spec);
    Ok(spec)
}

#[allow(unsafe_code)]
fn set_sizes(spec: &mut MjSpec) {
    // SAFETY: two plain integers of a specification that this function borrows alone; the wrapper has no setter.
    let raw = unsafe { spec.ffi_mut() };
    raw.njmax = MAX_CONSTRAINTS;
    raw.nconmax = MAX_CONSTRAINTS;
}

/// Puts the humanoid into an arena, free to move: what `composer.Entity.attach` and `add_free_entity` do.
pub(crate) fn attach(arena: &mut MjSpec, walker: &MjSpec) -> Result<(), Error> {
    // MuJoCo wraps what it attaches in one more frame, in the original too: only a copy of it keeps a humanoid that is
    // attached thousands of times as flat as it was.
    let mut walker = walker.try_clone().map_err(refused("copying the humanoid"))?;
    // In dm_control the arena's compiler settings (`composer/arena.xml`) hold for everything; in MuJoCo elements keep
    // those they came with, so the humanoid gets the arena's.
    let settings = arena.compiler();
    let (degree, mass, inertia) = (settings.degree(), settings.boundmass(), settings.boundinertia());
    walker.compiler_mut().set_degree(degree);
    walker.compiler_mut().set_boundmass(mass);
    walker.compiler_mut().set_boundinertia(inertia);
    let place = arena.world_body_mut().add_body();
    place.set_name(PREFIX).map_err(refused("adding the humanoid's place"))?;
    place.add_free_joint().set_name(PREFIX).map_err(refused("freeing the humanoid"))?;
    place.attach_by_deep_copy(&mut walker, PREFIX, "").map_err(refused("putting the humanoid into its arena"))
}
