//! The floor (`locomotion/arenas/floors.py`), with a target's mark or a ball.

use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_editing::{MjtBuiltin, MjtMark};

use super::base::base;
use crate::error::{Error, refused};

/// Half the drawn size of the floor in x and y (m). MuJoCo's planes are infinite.
const HALF_SIZE: f64 = 8.0;
/// Spacing of the grid with which a plane is drawn (`_GROUNDPLANE_QUAD_SIZE`).
const QUAD_SIZE: f64 = 0.25;
/// Height of the camera above the floor (m), and the size of its view relative to the floor.
const TOP_CAMERA_DISTANCE: f64 = 100.0;
const TOP_CAMERA_PADDING: f64 = 1.1;
/// Radius (m) and colour of a target's mark (`tasks/go_to_target.py`).
const TARGET_RADIUS: f64 = 0.1;
const TARGET_COLOUR: [f32; 4] = [0.9, 0.6, 0.6, 1.0];
/// Name of a target's mark.
pub(crate) const TARGET: &str = "target";
/// The ball's colour.
const BALL_COLOUR: [f32; 4] = [0.9, 0.5, 0.1, 1.0];
/// Name of the ball's body, joint and geom.
pub(crate) const BALL: &str = "ball";

/// The empty floor.
pub(crate) fn floor() -> Result<MjSpec, Error> {
    let mut spec = base("floor")?;

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

/// The floor with a target's mark, which has no contacts.
pub(crate) fn with_target() -> Result<MjSpec, Error> {
    let mut spec = floor()?;
    let site = spec.world_body_mut().add_site();
    site.set_name(TARGET).map_err(refused("adding the target"))?;
    site.set_type(MjtGeomBase::mjGEOM_SPHERE);
    site.size_mut()[0] = TARGET_RADIUS;
    *site.rgba_mut() = TARGET_COLOUR;
    Ok(spec)
}

/// Adds a ball with this radius (m), this mass (kg) and a free joint. It must be added after the humanoid, because the
/// humanoid's coordinates come first.
///
/// It has the contact parameters of dm_control's motion-capture props (`locomotion/mocap/props.py`): condim 6, priority 1,
/// friction (0.7, r/4, r/2).
pub(crate) fn add_ball(arena: &mut MjSpec, radius: f64, mass: f64) -> Result<(), Error> {
    let body = arena.world_body_mut().add_body();
    body.set_name(BALL).map_err(refused("adding the ball"))?;
    body.pos_mut()[2] = radius;
    body.add_free_joint().set_name(BALL).map_err(refused("adding the ball"))?;
    let geom = body.add_geom();
    geom.set_name(BALL).map_err(refused("adding the ball"))?;
    geom.set_type(MjtGeomBase::mjGEOM_SPHERE);
    geom.size_mut()[0] = radius;
    geom.set_mass(mass);
    geom.set_condim(6);
    geom.set_priority(1);
    *geom.friction_mut() = [0.7, radius / 4.0, radius / 2.0];
    *geom.rgba_mut() = BALL_COLOUR;
    Ok(())
}
