//! The corridors (`locomotion/arenas/corridors.py`): with gaps in the floor, or with walls.

use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_editing::{MjsBody, MjsGeom, MjtBuiltin};

use super::base::base;
use crate::error::{Error, missing, refused};

/// Length of the corridor before its start and after its end (m, `_CORRIDOR_X_PADDING`).
pub(crate) const X_PADDING: f64 = 2.0;
/// Thickness of walls, and half the thickness of platforms (m, `_WALL_THICKNESS`).
const THICKNESS: f64 = 0.16;
/// Height of the planes at the sides (m, `_SIDE_WALL_HEIGHT`), and their group, which is not drawn.
const SIDE_HEIGHT: f64 = 4.0;
const SIDE_GROUP: i32 = 3;
/// Platforms that are no further apart meet (m): positions are not exact.
const NO_GAP: f64 = 1e-6;
/// Depth of the ground under the gaps (m).
const GAP_DEPTH: f64 = 10.0;
/// Height of the spare boxes above that ground (m). They are inside the model's extent, because the extent decides what is
/// drawn.
const HIDDEN_DEPTH: f64 = 0.5;
/// Clipping planes relative to the model's extent (`tasks/corridors.py`).
const NEAR: f32 = 0.00025;
const FAR: f32 = 4.0;
/// Name of the walls' body.
const WALLS: &str = "walls";
/// Name of the platforms' body.
pub(crate) const GROUND: &str = "ground";

/// Length and width of a corridor, m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Extent {
    pub(crate) length: f64,
    pub(crate) width: f64,
}

/// A box in the corridor: a platform or a wall.
#[derive(Clone, Debug, PartialEq)]
pub struct Block {
    /// The geom's name.
    pub name: String,
    /// Centre, m.
    pub position: [f64; 3],
    /// Half its size in x, y and z, m.
    pub half_size: [f64; 3],
    /// Red, green, blue and opacity.
    pub colour: [f32; 4],
}

impl Block {
    /// Where it begins and ends along the corridor, m.
    fn range(&self) -> [f64; 2] {
        [self.position[0] - self.half_size[0], self.position[0] + self.half_size[0]]
    }
}

/// Where each gap between `platforms` ends, m along the corridor. There is none between platforms that meet.
pub(crate) fn gap_ends(platforms: &[Block]) -> Vec<f64> {
    let end = |pair: &[Block]| match pair {
        [before, after] => Some(after.range()[0]).filter(|start| start - before.range()[1] > NO_GAP),
        _ => None,
    };
    platforms.windows(2).filter_map(end).collect()
}

/// Where each wall ends, m along the corridor.
pub(crate) fn wall_ends(walls: &[Block]) -> Vec<f64> {
    walls.iter().map(|wall| wall.range()[1]).collect()
}

/// Length of the platform on which the humanoid starts, m.
pub(crate) fn first_platform_length() -> f64 {
    3.0 * X_PADDING
}

/// The platform on which the humanoid starts.
pub(crate) fn first_platform(extent: Extent) -> Block {
    Block { name: "start_floor".into(), ..platform(0, 0.0, first_platform_length(), extent) }
}

/// A platform from `start` to `start + length`, m.
pub(crate) fn platform(index: usize, start: f64, length: f64, extent: Extent) -> Block {
    Block {
        name: format!("floor_{index}"),
        position: [start + length / 2.0, 0.0, -THICKNESS],
        half_size: [length / 2.0, extent.width / 2.0, THICKNESS],
        colour: [0.5, 0.5, 0.5, 1.0],
    }
}

/// A wall at `x` that reaches `width` into the corridor, m. Its side is the left (positive y) or the right.
pub(crate) fn wall(index: usize, x: f64, [width, height]: [f64; 2], left: bool, extent: Extent) -> Block {
    let side = if left { 1.0 } else { -1.0 };
    Block {
        name: format!("wall_{index}"),
        position: [x, side * (extent.width - width) / 2.0, height / 2.0],
        half_size: [THICKNESS / 2.0, width / 2.0, height / 2.0],
        colour: [1.0; 4],
    }
}

/// The corridor with gaps between `platforms`.
///
/// `spare` more boxes are far below the first platform, where nothing touches or shows them. Arenas with the same number of
/// boxes have the same memory layout, so a simulation and a renderer can change from one to the next.
pub(crate) fn with_gaps(extent: Extent, platforms: &[Block], spare: usize) -> Result<MjSpec, Error> {
    let mut spec = empty("gaps_corridor", extent, Some(GAP_DEPTH), 0)?;
    let ground = spec.world_body_mut().add_body();
    ground.set_name(GROUND).map_err(refused("adding the platforms"))?;
    for platform in platforms {
        add_block(ground, platform)?;
    }
    for index in platforms.len()..platforms.len() + spare {
        // A spare box collides, too: MuJoCo's bounding volumes leave out geoms without collisions, and their number is
        // part of the memory layout.
        let hidden = Block {
            position: [first_platform_length() / 2.0, 0.0, HIDDEN_DEPTH - GAP_DEPTH],
            half_size: [THICKNESS / 2.0; 3],
            ..platform(index.saturating_sub(1), 0.0, 1.0, extent)
        };
        add_block(ground, &hidden)?.set_group(SIDE_GROUP);
    }
    Ok(spec)
}

/// The corridor with walls.
pub(crate) fn with_walls(extent: Extent, walls: &[Block]) -> Result<MjSpec, Error> {
    let mut spec = empty("walls_corridor", extent, None, walls.len())?;
    let body = spec.body_mut(WALLS).ok_or_else(|| missing("body", WALLS))?;
    for wall in walls {
        add_block(body, wall)?;
    }
    Ok(spec)
}

fn add_block<'a>(body: &'a mut MjsBody, block: &Block) -> Result<&'a mut MjsGeom, Error> {
    let geom = body.add_geom();
    geom.set_name(&block.name).map_err(refused("adding a platform or a wall"))?;
    geom.set_type(MjtGeomBase::mjGEOM_BOX);
    *geom.pos_mut() = block.position;
    *geom.size_mut() = block.half_size;
    *geom.rgba_mut() = block.colour;
    Ok(geom)
}

/// `EmptyCorridor`: the ground, invisible planes at the sides and ends, and a sky. With `depth` the ground is invisible and
/// this far below (m). dm_control names unnamed geoms by their place among all geoms; `first` geoms come before these.
fn empty(name: &str, extent: Extent, depth: Option<f64>, first: usize) -> Result<MjSpec, Error> {
    let mut spec = base(name)?;
    let map = &mut spec.visual_mut().map;
    (map.znear, map.zfar) = (NEAR, FAR);

    let sky = spec.add_texture();
    sky.set_name("//unnamed_texture_0").map_err(refused("adding the sky"))?;
    sky.set_type(MjtTexture::mjTEXTURE_SKYBOX);
    sky.set_builtin(MjtBuiltin::mjBUILTIN_GRADIENT);
    *sky.rgb1_mut() = [0.4, 0.6, 0.8];
    *sky.rgb2_mut() = [0.0; 3];
    sky.set_width(100);
    sky.set_height(600);

    let Extent { length, width } = extent;
    let world = spec.world_body_mut();
    world.add_body().set_name(WALLS).map_err(refused("adding the walls"))?;

    let ground = world.add_geom();
    ground.set_name(&format!("//unnamed_geom_{first}")).map_err(refused("adding the ground"))?;
    ground.set_type(MjtGeomBase::mjGEOM_PLANE);
    *ground.pos_mut() = [length / 2.0, 0.0, depth.map_or(0.0, |depth| -depth)];
    *ground.size_mut() = [length / 2.0 + X_PADDING, width / 2.0, 1.0];
    *ground.rgba_mut() = if depth.is_some() { [0.0; 4] } else { [0.5, 0.5, 0.5, 1.0] };

    let along = [length / 2.0 + X_PADDING, SIDE_HEIGHT / 2.0, 1.0];
    let across = [width / 2.0, SIDE_HEIGHT / 2.0, 1.0];
    let planes = [
        ([length / 2.0, width / 2.0], along, [1.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
        ([length / 2.0, -width / 2.0], along, [-1.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
        ([-X_PADDING, 0.0], across, [0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        ([length + X_PADDING, 0.0], across, [0.0, -1.0, 0.0, 0.0, 0.0, 1.0]),
    ];
    for (index, ([x, y], size, axes)) in planes.into_iter().enumerate() {
        let plane = world.add_geom();
        plane.set_name(&format!("//unnamed_geom_{}", first + index + 1)).map_err(refused("adding a side"))?;
        plane.set_type(MjtGeomBase::mjGEOM_PLANE);
        *plane.pos_mut() = [x, y, SIDE_HEIGHT / 2.0];
        *plane.size_mut() = size;
        plane.alt_mut().set_xy_axis(&axes);
        plane.set_group(SIDE_GROUP);
        *plane.rgba_mut() = [1.0, 0.0, 0.0, 0.0];
    }
    Ok(spec)
}
