//! The shapes of an environment and the poses of its bodies as numbers, for viewers without MuJoCo.

use std::sync::{Arc, Weak};

use mujoco_rs::prelude::*;

use crate::environment::Simulated;
use crate::error::{Error, missing};
use crate::humanoid::PREFIX;
use crate::physics::Simulation;

/// MuJoCo draws the groups 0, 1 and 2 unless told otherwise.
const DRAWN_GROUPS: std::ops::RangeInclusive<i32> = 0..=2;
/// MuJoCo's default colour: a geom with it has the colour of its material, if it has one.
const DEFAULT_COLOUR: [f32; 4] = [0.5, 0.5, 0.5, 1.0];

/// The form of a shape, with MuJoCo's sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// Half the length along x and along y; 0 is infinite. Its normal is z.
    Plane,
    /// Radius.
    Sphere,
    /// Radius, and half the length of the straight part along z.
    Capsule,
    /// The three semi-axes.
    Ellipsoid,
    /// Radius, and half the length along z.
    Cylinder,
    /// Half the length along each axis.
    Box,
}

/// A position and an orientation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// x, y and z, m.
    pub position: [f64; 3],
    /// Unit quaternion w, x, y, z.
    pub rotation: [f64; 4],
}

/// A rigid shape.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// Its form.
    pub form: Form,
    /// Its sizes, m; the [`Form`] says which.
    pub size: [f64; 3],
    /// Red, green, blue and opacity, 0 to 1.
    pub colour: [f32; 4],
    /// Its body, by its place in [`Geometry::poses`]. `None` is the world.
    pub body: Option<usize>,
    /// Its pose in the frame of its body.
    pub pose: Pose,
}

/// What is drawn of a model.
#[derive(Clone, Debug)]
pub struct Geometry {
    /// Not kept in memory: a corridor has a model for each episode.
    model: Weak<MjModel>,
    shapes: Vec<Shape>,
    /// MuJoCo's numbers of the bodies that have a shape, the humanoid's first.
    bodies: Vec<usize>,
    /// How many of them are the humanoid's.
    humanoid: usize,
}

impl Geometry {
    /// The shapes of an environment's present model. A corridor has another model after some resets; see
    /// [`is_of`](Self::is_of).
    ///
    /// # Errors
    /// A model without the humanoid.
    pub fn new(environment: &dyn Simulated) -> Result<Self, Error> {
        let model = environment.model();
        let root = model.name_to_id(MjtObjBase::mjOBJ_BODY, &format!("{PREFIX}root"));
        let root = model.body_rootid()[root.ok_or_else(|| missing("body", "root"))?];
        let drawn: Vec<usize> = (0..model.geom_type().len()).filter(|geom| is_drawn(&model, *geom)).collect();
        let mut bodies: Vec<usize> = drawn.iter().map(|geom| model.geom_bodyid()[*geom] as usize).collect();
        bodies.retain(|body| *body != 0);
        bodies.sort_unstable_by_key(|body| (model.body_rootid()[*body] != root, *body));
        bodies.dedup();
        let humanoid = bodies.iter().filter(|body| model.body_rootid()[**body] == root).count();
        let shapes = drawn.into_iter().filter_map(|geom| shape(&model, geom, &bodies)).collect();
        Ok(Self { model: Arc::downgrade(&model), shapes, bodies, humanoid })
    }

    /// Whether these are the shapes of the environment's present model.
    pub fn is_of(&self, environment: &dyn Simulated) -> bool {
        self.model.upgrade().is_some_and(|model| Arc::ptr_eq(&model, &environment.model()))
    }

    /// The shapes.
    pub fn shapes(&self) -> &[Shape] {
        &self.shapes
    }

    /// The poses of the bodies in the world, the humanoid's first.
    pub fn poses(&self, environment: &dyn Simulated) -> Vec<Pose> {
        self.poses_in(environment.simulation(), self.bodies.len())
    }

    fn poses_in(&self, simulation: &Simulation, bodies: usize) -> Vec<Pose> {
        let (positions, rotations) = (simulation.xpos(), simulation.xquat());
        let pose = |body: &usize| Pose { position: positions[*body], rotation: rotations[*body] };
        self.bodies.iter().take(bodies).map(pose).collect()
    }
}

/// Finds where the bodies of the humanoid are in the reference.
#[derive(Debug)]
pub struct ReferencePoses {
    /// It is put into poses and never steps.
    simulation: Simulation,
}

impl ReferencePoses {
    /// For environments with the same model as this one.
    pub fn new(environment: &dyn Simulated) -> Self {
        Self { simulation: Simulation::new(environment.model()) }
    }

    /// The poses of the humanoid's bodies in the present frame of the reference; those before if there is no such frame.
    pub fn poses(&mut self, geometry: &Geometry, environment: &dyn Simulated) -> Vec<Pose> {
        let reference = environment.scenery().reference.unwrap_or_default();
        if reference.len() == self.simulation.qpos().len() {
            self.simulation.qpos_mut().copy_from_slice(&reference);
        }
        self.simulation.kinematics();
        geometry.poses_in(&self.simulation, geometry.humanoid)
    }
}

fn is_drawn(model: &MjModel, geom: usize) -> bool {
    DRAWN_GROUPS.contains(&model.geom_group()[geom]) && colour(model, geom)[3] > 0.0
}

fn colour(model: &MjModel, geom: usize) -> [f32; 4] {
    let own = model.geom_rgba()[geom];
    let material = usize::try_from(model.geom_matid()[geom]).ok().filter(|_| own == DEFAULT_COLOUR);
    material.map_or(own, |material| model.mat_rgba()[material])
}

/// A shape; `None` for meshes and height fields, which no task has.
fn shape(model: &MjModel, geom: usize, bodies: &[usize]) -> Option<Shape> {
    let form = match model.geom_type()[geom] {
        MjtGeomBase::mjGEOM_PLANE => Form::Plane,
        MjtGeomBase::mjGEOM_SPHERE => Form::Sphere,
        MjtGeomBase::mjGEOM_CAPSULE => Form::Capsule,
        MjtGeomBase::mjGEOM_ELLIPSOID => Form::Ellipsoid,
        MjtGeomBase::mjGEOM_CYLINDER => Form::Cylinder,
        MjtGeomBase::mjGEOM_BOX => Form::Box,
        _ => return None,
    };
    let body = model.geom_bodyid()[geom] as usize;
    Some(Shape {
        form,
        size: model.geom_size()[geom],
        colour: colour(model, geom),
        body: bodies.iter().position(|place| *place == body),
        pose: Pose { position: model.geom_pos()[geom], rotation: model.geom_quat()[geom] },
    })
}
