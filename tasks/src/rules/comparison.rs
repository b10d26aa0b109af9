//! Replays recorded episodes of dm_control's go-to-target and corridors. Rules and physics are those of training.
//! Targets and obstacles come from the recording instead of a random number generator.

use comic_experiment::{Corridor, GoToTarget, StartPose, Vision};
use mujoco_rs::prelude::*;
use rand_pcg::Pcg64;

use super::corridor::{CorridorRules, Obstacles, START, State as CorridorState};
use super::environment::RuledEnvironment;
use super::go_to_target::{GoToTargetRules, State as GoToTargetState};
use super::interface::Recorded;
use super::poses::{Pose, Poses, UP};
use super::stage::Arena;
pub use crate::arenas::corridor::Block;
use crate::arenas::corridor::{self, Extent};
use crate::arenas::floor;
use crate::environment::{Simulated, Step};
use crate::error::Error;
use crate::humanoid;
use crate::physics::Simulation;
use crate::rendering::vision;

/// Names and values.
type Named = Vec<(&'static str, Vec<f64>)>;

/// A replay of a recorded episode.
#[derive(Debug)]
pub struct Replay {
    environment: Box<dyn Replayed>,
    /// The name of its arena, for the camera.
    arena: &'static str,
}

trait Replayed: Simulated {
    fn dictionary(&self) -> Named;
    fn quantities(&self) -> Named;
    fn begin_at(&mut self, qpos: &[f64; 63]);
    fn as_environment(&self) -> &dyn Simulated;
}

impl<R: Recorded> Replayed for RuledEnvironment<R> {
    fn dictionary(&self) -> Named {
        let mut dictionary = self.stage().body().dictionary();
        dictionary.extend(self.rules().observation(self.stage(), self.state()));
        dictionary
    }

    fn quantities(&self) -> Named {
        self.rules().quantities(self.stage(), self.state())
    }

    fn begin_at(&mut self, qpos: &[f64; 63]) {
        RuledEnvironment::begin_at(self, qpos);
    }

    fn as_environment(&self) -> &dyn Simulated {
        self
    }
}

impl Replay {
    /// Moves the first state to these coordinates; before the first step.
    pub fn begin_at(&mut self, qpos: &[f64; 63]) {
        self.environment.begin_at(qpos);
    }

    /// One control step.
    pub fn step_control(&mut self, control: &[f64; 56]) -> Step {
        self.environment.step_control(control)
    }

    /// Draws the camera image as dm_control does (`full`) or as training does; [`vision::IMAGE_BYTES`] bytes.
    ///
    /// # Errors
    /// [`Error::Graphics`]: there is no OpenGL.
    pub fn draw(&mut self, full: bool, image: &mut [u8]) -> Result<(), Error> {
        let vision = if full { Vision::Full } else { Vision::Fast };
        vision::draw(vision, self.arena, self.environment.simulation_mut(), image)
    }

    /// dm_control's observation dictionary without the camera, in its order.
    pub fn dictionary(&self) -> Vec<(&'static str, Vec<f64>)> {
        self.environment.dictionary()
    }

    /// The task's quantities besides its observations: targets, counters, velocities.
    pub fn quantities(&self) -> Vec<(&'static str, Vec<f64>)> {
        self.environment.quantities()
    }

    /// The simulation.
    pub fn simulation(&self) -> &Simulation {
        self.environment.simulation()
    }

    /// The environment that is replayed.
    pub fn environment(&self) -> &dyn Simulated {
        self.environment.as_environment()
    }
}

/// Go-to-target from the upright pose at `spawn` (m), turned by `rotation` (rad), with the targets it had one after the
/// other (m).
///
/// # Errors
/// The arena cannot be built.
pub fn replay_go_to_target(spawn: [f64; 2], rotation: f64, targets: &[[f64; 2]]) -> Result<Replay, Error> {
    let config = GoToTarget { start_pose: StartPose::Upright, ..GoToTarget::default() };
    let rules = GoToTargetRules::new(&config, Poses::upright())?;
    let mut script: Vec<[f64; 2]> = targets.iter().rev().copied().collect();
    let state = GoToTargetState { target: script.pop().unwrap_or_default(), script, ..Default::default() };
    let pose = Pose::upright().turned(UP, rotation).moved(spawn[0], spawn[1]);
    Ok(Replay { environment: Box::new(RuledEnvironment::at(rules, &pose, state)?), arena: "recorded floor" })
}

/// Replays a corridor with this length and width (m). It has these platforms, or these walls if there are no platforms.
///
/// # Errors
/// The arena cannot be built.
pub fn replay_corridor(length: f64, width: f64, platforms: &[Block], walls: &[Block]) -> Result<Replay, Error> {
    let arena = if platforms.is_empty() { "recorded walls" } else { "recorded gaps" };
    let obstacles = RecordedObstacles { platforms: platforms.to_vec(), walls: walls.to_vec() };
    let config = Corridor { length, width, ..Corridor::default() };
    let rules = CorridorRules::new(&config, Poses::upright(), obstacles);
    let pose = Pose::upright().moved(START, 0.0);
    Ok(Replay { environment: Box::new(RuledEnvironment::at(rules, &pose, CorridorState::default())?), arena })
}

/// The model of such a corridor.
///
/// # Errors
/// The arena cannot be built.
pub fn corridor_model(length: f64, width: f64, platforms: &[Block], walls: &[Block]) -> Result<MjModel, Error> {
    RecordedObstacles { platforms: platforms.to_vec(), walls: walls.to_vec() }.build(Extent { length, width })
}

/// The model of go-to-target.
///
/// # Errors
/// The arena cannot be built.
pub fn go_to_target_model() -> Result<MjModel, Error> {
    humanoid::build_in(floor::with_target()?)
}

/// Recorded obstacles.
#[derive(Debug)]
struct RecordedObstacles {
    platforms: Vec<Block>,
    walls: Vec<Block>,
}

impl RecordedObstacles {
    fn build(&self, extent: Extent) -> Result<MjModel, Error> {
        humanoid::build_in(if self.platforms.is_empty() {
            corridor::with_walls(extent, &self.walls)?
        } else {
            corridor::with_gaps(extent, &self.platforms, 0)?
        })
    }
}

impl Obstacles for RecordedObstacles {
    fn draw(&self, extent: Extent, _: &mut Pcg64) -> Result<Arena, Error> {
        // A corridor has platforms or walls.
        let ends = [corridor::gap_ends(&self.platforms), corridor::wall_ends(&self.walls)].concat();
        Ok(Arena::new(self.build(extent)?)?.with_obstacles(ends))
    }
}
