//! Recorded episodes of dm_control's go-to-target and corridors, replayed: the rules and the physics of training, with
//! the draws taken from a record instead of a random number generator.

use comic_experiment::{Corridor, GoToTarget, StartPose, Vision};
use mujoco_rs::prelude::*;
use rand_pcg::Pcg64;

pub use crate::arenas::corridor::Block;
use crate::arenas::corridor::{self, Extent};
use crate::corridor::{CorridorRules, Memory as CorridorMemory, Obstacles, START};
use crate::error::Error;
use crate::go_to_target::{GoToTargetRules, Memory as GoToTargetMemory};
use crate::rules::{Recorded, RuledEnvironment};
use crate::start::{Pose, Poses, UP};
use crate::{Simulated, Simulation, Step, humanoid, vision};

/// Named numbers.
type Named = Vec<(&'static str, Vec<f64>)>;

/// An episode that goes as it was recorded.
#[derive(Debug)]
pub struct Replay(Box<dyn Replayed>);

trait Replayed: Simulated {
    fn dictionary(&self) -> Named;
    fn quantities(&self) -> Named;
    fn as_environment(&self) -> &dyn Simulated;
}

impl<R: Recorded> Replayed for RuledEnvironment<R> {
    fn dictionary(&self) -> Named {
        let mut dictionary = self.stage().body().dictionary();
        dictionary.extend(self.rules().observation(self.stage(), self.memory()));
        dictionary
    }

    fn quantities(&self) -> Named {
        self.rules().quantities(self.stage(), self.memory())
    }

    fn as_environment(&self) -> &dyn Simulated {
        self
    }
}

impl Replay {
    /// One control step.
    pub fn step_control(&mut self, control: &[f64; 56]) -> Step {
        self.0.step_control(control)
    }

    /// What the humanoid sees, as dm_control draws it (`full`) or as training does; [`vision::IMAGE_BYTES`] bytes.
    ///
    /// # Errors
    /// [`Error::Graphics`] when there is nothing to draw with.
    pub fn draw(&mut self, full: bool, image: &mut [u8]) -> Result<(), Error> {
        let vision = if full { Vision::Full } else { Vision::Fast };
        vision::draw(vision, self.0.simulation_mut(), image)
    }

    /// dm_control's observation dictionary without the camera, in its order.
    pub fn dictionary(&self) -> Vec<(&'static str, Vec<f64>)> {
        self.0.dictionary()
    }

    /// What the task knows beside its observations: targets, counters, velocities.
    pub fn quantities(&self) -> Vec<(&'static str, Vec<f64>)> {
        self.0.quantities()
    }

    /// The simulation.
    pub fn simulation(&self) -> &Simulation {
        self.0.simulation()
    }

    /// The environment that is replayed.
    pub fn environment(&self) -> &dyn Simulated {
        self.0.as_environment()
    }
}

/// Go-to-target from the upright pose at `spawn` (m), turned by `rotation` (rad), with the targets it had one after the
/// other (m).
///
/// # Errors
/// When the arena cannot be built.
pub fn replay_go_to_target(spawn: [f64; 2], rotation: f64, targets: &[[f64; 2]]) -> Result<Replay, Error> {
    let config = GoToTarget { start_pose: StartPose::Upright, ..GoToTarget::default() };
    let rules = GoToTargetRules::new(&config, Poses::upright())?;
    let mut script: Vec<[f64; 2]> = targets.iter().rev().copied().collect();
    let memory = GoToTargetMemory { target: script.pop().unwrap_or_default(), script, ..Default::default() };
    let pose = Pose::upright().turned(UP, rotation).moved(spawn[0], spawn[1]);
    Ok(Replay(Box::new(RuledEnvironment::at(rules, &pose, memory)?)))
}

/// A corridor of this length and width (m) with these platforms, or, where there are none, these walls.
///
/// # Errors
/// When the arena cannot be built.
pub fn replay_corridor(length: f64, width: f64, platforms: &[Block], walls: &[Block]) -> Result<Replay, Error> {
    let obstacles = Known { platforms: platforms.to_vec(), walls: walls.to_vec() };
    let config = Corridor { length, width, ..Corridor::default() };
    let rules = CorridorRules::new(&config, Poses::upright(), obstacles);
    let pose = Pose::upright().moved(START, 0.0);
    Ok(Replay(Box::new(RuledEnvironment::at(rules, &pose, CorridorMemory::default())?)))
}

/// The model of such a corridor.
///
/// # Errors
/// When the arena cannot be built.
pub fn corridor_model(length: f64, width: f64, platforms: &[Block], walls: &[Block]) -> Result<MjModel, Error> {
    Known { platforms: platforms.to_vec(), walls: walls.to_vec() }.build(Extent { length, width })
}

/// The model of go-to-target.
///
/// # Errors
/// When the arena cannot be built.
pub fn go_to_target_model() -> Result<MjModel, Error> {
    humanoid::build_in(crate::arenas::floor::with_target)
}

/// Obstacles that are not drawn.
#[derive(Debug)]
struct Known {
    platforms: Vec<Block>,
    walls: Vec<Block>,
}

impl Known {
    fn build(&self, extent: Extent) -> Result<MjModel, Error> {
        humanoid::build_in(|directory| {
            if self.platforms.is_empty() {
                corridor::with_walls(directory, extent, &self.walls)
            } else {
                corridor::with_gaps(directory, extent, &self.platforms, 0)
            }
        })
    }
}

impl Obstacles for Known {
    fn draw(&self, extent: Extent, _: &mut Pcg64) -> Result<MjModel, Error> {
        self.build(extent)
    }
}
