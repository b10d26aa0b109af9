//! The floor (`locomotion/arenas/floors.py` over `composer/arena.xml`) and the humanoid's place on it.

use std::path::Path;

use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_editing::{MjtBuiltin, MjtMark};

use super::{PHYSICS_TIMESTEP, PREFIX, assets, refused};
use crate::error::Error;

/// Half the floor's extent in x and y (m); it is only drawn so far, MuJoCo's planes are infinite.
const HALF_SIZE: f64 = 8.0;
/// Spacing of the grid by which a plane is drawn (`_GROUNDPLANE_QUAD_SIZE`).
const QUAD_SIZE: f64 = 0.25;
/// Height of the camera above the floor (m) and how much of it the floor fills.
const TOP_CAMERA_DISTANCE: f64 = 100.0;
const TOP_CAMERA_PADDING: f64 = 1.1;
/// `<size njmax nconmax>` of the humanoid's XML, which dm_control merges into the arena's.
const MAX_CONSTRAINTS: i32 = 500;

/// The empty floor.
pub(super) fn floor(directory: &Path) -> Result<MjSpec, Error> {
    let path = assets::file(directory, "arena.xml")?;
    let mut spec = MjSpec::from_xml(path).map_err(refused("reading arena.xml"))?;
    spec.set_modelname("floor");
    spec.option_mut().timestep = PHYSICS_TIMESTEP;
    let headlight = &mut spec.visual_mut().headlight;
    headlight.ambient = [0.4; 3];
    headlight.diffuse = [0.8; 3];
    headlight.specular = [0.1; 3];
    set_sizes(&mut spec);

    let texture = spec.add_texture();
    texture.set_name("groundplane").map_err(refused("adding the floor's texture"))?;
    texture.set_type(MjtTexture::mjTEXTURE_2D);
    texture.set_builtin(MjtBuiltin::mjBUILTIN_CHECKER);
    texture.set_mark(MjtMark::mjMARK_EDGE);
    texture.set_width(200);
    texture.set_height(200);
    *texture.rgb1_mut() = [0.2, 0.3, 0.4];
    *texture.rgb2_mut() = [0.1, 0.2, 0.3];
    *texture.markrgb_mut() = [0.8; 3];

    let material = spec.add_material();
    material.set_name("groundplane").map_err(refused("adding the floor's material"))?;
    material.set_texture(MjtTextureRoleBase::mjTEXROLE_RGB, "groundplane");
    *material.texrepeat_mut() = [2.0, 2.0];
    material.set_texuniform(true);
    material.set_reflectance(0.2);

    let world = spec.world_body_mut();
    let plane = world.add_geom();
    plane.set_name("groundplane").map_err(refused("adding the floor"))?;
    plane.set_type(MjtGeomBase::mjGEOM_PLANE);
    *plane.size_mut() = [HALF_SIZE, HALF_SIZE, QUAD_SIZE];
    plane.set_material("groundplane");

    let camera = world.add_camera();
    camera.set_name("top_camera").map_err(refused("adding the floor's camera"))?;
    *camera.pos_mut() = [0.0, 0.0, TOP_CAMERA_DISTANCE];
    camera.set_fovy((2.0 * (TOP_CAMERA_PADDING * HALF_SIZE).atan2(TOP_CAMERA_DISTANCE)).to_degrees());
    Ok(spec)
}

#[allow(unsafe_code)]
fn set_sizes(spec: &mut MjSpec) {
    // SAFETY: two plain integers of a specification that this function borrows alone; the wrapper has no setter.
    let raw = unsafe { spec.ffi_mut() };
    raw.njmax = MAX_CONSTRAINTS;
    raw.nconmax = MAX_CONSTRAINTS;
}

/// Puts the humanoid on the floor, free to move: what `composer.Entity.attach` and `add_free_entity` do.
pub(super) fn attach(floor: &mut MjSpec, walker: &mut MjSpec) -> Result<(), Error> {
    // In dm_control the arena's compiler settings (`composer/arena.xml`) hold for everything; in MuJoCo elements keep
    // those they came with, so the humanoid gets the arena's.
    let arena = floor.compiler();
    let (degree, mass, inertia) = (arena.degree(), arena.boundmass(), arena.boundinertia());
    walker.compiler_mut().set_degree(degree);
    walker.compiler_mut().set_boundmass(mass);
    walker.compiler_mut().set_boundinertia(inertia);
    let place = floor.world_body_mut().add_body();
    place.set_name(PREFIX).map_err(refused("adding the humanoid's place"))?;
    place.add_free_joint().set_name(PREFIX).map_err(refused("freeing the humanoid"))?;
    place.attach_by_deep_copy(walker, PREFIX, "").map_err(refused("putting the humanoid on the floor"))
}
