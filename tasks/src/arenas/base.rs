//! What all arenas have: dm_control's `composer/arena.xml`, the physics options and the light.

use mujoco_rs::prelude::*;

use crate::error::{Error, refused};
use crate::physics::PHYSICS_TIMESTEP;
use crate::{assets, silence};

/// `<size njmax nconmax>` of the humanoid's XML, which dm_control merges into the arena's.
const MAX_CONSTRAINTS: i32 = 500;

/// An arena with this name and nothing in it.
pub(super) fn base(name: &str) -> Result<MjSpec, Error> {
    silence::install();
    let mut spec = MjSpec::from_xml_string(assets::ARENA).map_err(refused("reading arena.xml"))?;
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
    // SAFETY: two plain integers of a specification that only this function borrows; the wrapper has no setter for them.
    let raw = unsafe { spec.ffi_mut() };
    raw.njmax = MAX_CONSTRAINTS;
    raw.nconmax = MAX_CONSTRAINTS;
}
