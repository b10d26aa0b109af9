//! The reference as a translucent humanoid.

use std::str::FromStr;
use std::sync::Arc;

use mujoco_rs::prelude::*;

use crate::Simulation;

/// Red, green, blue and opacity of the ghost.
const COLOUR: [f32; 4] = [0.35, 0.75, 1.0, 0.3];
/// How far beside the humanoid it stands, m.
const ASIDE: f64 = 1.0;

/// Where the reference is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ghost {
    /// Where it is: on the humanoid, as far as that follows it.
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
            _ => Err(format!("no ghost `{name}`; it stands `on` the humanoid or `beside` it")),
        }
    }
}

/// A second simulation of the same model, tinted, that is put into poses and never steps.
#[derive(Debug)]
pub(crate) struct Phantom {
    data: Simulation,
}

impl Phantom {
    pub(crate) fn new(model: &MjModel) -> Self {
        let mut tinted = model.clone();
        tinted.geom_rgba_mut().fill(COLOUR);
        Self { data: Simulation::new(Arc::new(tinted)) }
    }

    /// The most parts that it is drawn with.
    pub(crate) fn parts(&self) -> u32 {
        self.data.model().geom_rgba().len() as u32
    }

    /// Takes the pose of `reference` (generalised coordinates); `azimuth` (rad) is the direction in which it is looked
    /// at. Coordinates that are none of this model's leave it where it is.
    pub(crate) fn stand(&mut self, reference: &[f64], ghost: Ghost, azimuth: f64) {
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

    /// Fills `scene`, which adds to another one, with the parts that move: the floor is there once.
    pub(crate) fn appear(&mut self, scene: &mut MjvScene, options: &MjvOption) {
        let mut camera = MjvCamera::default();
        let parts = MjtCatBit::mjCAT_DYNAMIC as i32;
        scene.update_with_catmask(&mut self.data, options, &MjvPerturb::default(), &mut camera, parts);
    }
}
