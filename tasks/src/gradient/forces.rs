//! From a derivative with respect to places of bodies to the derivative with respect to positions.

use comic_clips::spatial::{Vector, cross, scale, subtract};

use super::{RewardDerivative, VELOCITIES};
use crate::physics::Data;

/// The derivative with respect to places and rotations of bodies, as forces (N for each unit of the reward) and torques on
/// them. The chain rule is then that of forces and joints: a force's work.
#[derive(Debug)]
pub(crate) struct Forces {
    /// The point about which MuJoCo writes the axes of joints: the centre of mass of the body that is simulated.
    about: Vector,
    /// Torque about that point and force, of each of MuJoCo's bodies.
    wrenches: Vec<[f64; 6]>,
}

impl Forces {
    /// None. `frame` is the humanoid's first body.
    pub(crate) fn new(data: &Data, frame: usize) -> Self {
        Self { about: data.subtree_com()[frame], wrenches: vec![[0.0; 6]; data.xpos().len()] }
    }

    /// The derivative with respect to the place of a point of a body.
    pub(crate) fn push(&mut self, body: usize, point: Vector, force: Vector) {
        self.turn(body, cross(subtract(point, self.about), force));
        for (place, value) in self.wrenches[body][3..].iter_mut().zip(force) {
            *place += value;
        }
    }

    /// The derivative with respect to the rotation of a body.
    pub(crate) fn turn(&mut self, body: usize, torque: Vector) {
        for (place, value) in self.wrenches[body].iter_mut().zip(torque) {
            *place += value;
        }
    }

    /// The derivative with respect to the centre of mass of all bodies from `frame` on.
    pub(crate) fn push_center_of_mass(&mut self, data: &Data, frame: usize, force: Vector) {
        let model = data.model();
        let total = model.body_subtreemass()[frame];
        for body in frame..self.wrenches.len() {
            if model.body_rootid()[body] as usize == frame {
                self.push(body, data.xipos()[body], scale(model.body_mass()[body] / total, force));
            }
        }
    }

    /// Adds the derivative with respect to positions.
    pub(crate) fn add_to(mut self, data: &Data, derivative: &mut RewardDerivative) {
        let model = data.model();
        // Parents stand before their children.
        for body in (1..self.wrenches.len()).rev() {
            let (before, own) = self.wrenches.split_at_mut(body);
            for (place, value) in before[model.body_parentid()[body] as usize].iter_mut().zip(own[0]) {
                *place += value;
            }
        }
        for (velocity, place) in derivative.position.iter_mut().enumerate().take(VELOCITIES) {
            let wrench = self.wrenches[model.dof_bodyid()[velocity] as usize];
            *place += data.cdof()[velocity].iter().zip(wrench).map(|(axis, value)| axis * value).sum::<f64>();
        }
    }
}
