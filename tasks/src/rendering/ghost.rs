//! Draws the reference as a translucent humanoid.

use std::str::FromStr;
use std::sync::Arc;

use mujoco_rs::prelude::*;

use crate::physics::Simulation;

/// Red, green, blue and opacity of the ghost.
const COLOUR: [f32; 4] = [0.35, 0.75, 1.0, 0.3];
/// Distance of the ghost from the humanoid in [`Ghost::Beside`], m.
const ASIDE: f64 = 1.0;

/// The place of the ghost, which shows the reference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ghost {
    /// At the reference's own position: on the humanoid, if the humanoid follows the reference.
    On,
    /// A metre to the right in the picture.
    Beside,
}

impl FromStr for Ghost {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "on" => Ok(Self::On),
            "beside" => Ok(Self::Beside),
            _ => Err(format!("no ghost `{name}`; ghosts are `on` (on the humanoid) and `beside` (beside it)")),
        }
    }
}

/// A second simulation of the same model in the ghost's colour. It is put into poses and never steps.
#[derive(Debug)]
pub(crate) struct GhostBody {
    data: Simulation,
}

impl GhostBody {
    pub(crate) fn new(model: &MjModel) -> Self {
        let mut tinted = model.clone();
        tinted.geom_rgba_mut().fill(COLOUR);
        Self { data: Simulation::new(Arc::new(tinted)) }
    }

    /// The largest number of drawn parts.
    pub(crate) fn parts(&self) -> u32 {
        self.data.model().geom_rgba().len() as u32
    }

    /// Takes the pose `reference` (generalised coordinates). `azimuth` (rad) is the direction of the camera. Coordinates of
    /// another model have no effect.
    pub(crate) fn set_pose(&mut self, reference: &[f64], ghost: Ghost, azimuth: f64) {
        if reference.len() != self.data.qpos().len() {
            return;
        }
        self.data.qpos_mut().copy_from_slice(reference);
        if ghost == Ghost::Beside {
            let (sine, cosine) = azimuth.sin_cos();
            self.data.qpos_mut()[0] += ASIDE * sine;
            self.data.qpos_mut()[1] -= ASIDE * cosine;
        }
        self.data.forward();
    }

    /// Draws its moving parts into `scene`, which MuJoCo adds to another scene. The floor is already in the other scene.
    pub(crate) fn draw(&mut self, scene: &mut MjvScene, options: &MjvOption) {
        let mut camera = MjvCamera::default();
        let parts = MjtCatBit::mjCAT_DYNAMIC as i32;
        scene.update_with_catmask(&mut self.data, options, &MjvPerturb::default(), &mut camera, parts);
    }
}
