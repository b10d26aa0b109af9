//! The numbers of every task, section by section.
//!
//! (S) is the CoMic supplement, (C) dm_control's published task code where the supplement is silent, (D) a decision of
//! this project. Where dm_control's own default differs from the supplement, the field's comment names it.

use serde::{Deserialize, Serialize};

/// Which task is learnt.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TaskName {
    /// Multi-clip motion-capture tracking: section `tracking`.
    Tracking,
    /// Walk to targets: section `go_to_target`.
    GoToTarget,
    /// Run through a corridor with gaps, by sight: section `gaps`.
    Gaps,
    /// Run through a corridor with walls, by sight: section `walls`.
    Walls,
    /// Get up and stand: section `get_up`.
    GetUp,
    /// Catch a ball: section `ball_catch`.
    BallCatch,
}

impl TaskName {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Tracking, Self::GoToTarget, Self::Gaps, Self::Walls, Self::GetUp, Self::BallCatch];

    /// As experiments and command lines write it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Tracking => "tracking",
            Self::GoToTarget => "go-to-target",
            Self::Gaps => "gaps",
            Self::Walls => "walls",
            Self::GetUp => "get-up",
            Self::BallCatch => "ball-catch",
        }
    }
}

impl std::fmt::Display for TaskName {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(self.name())
    }
}

impl std::str::FromStr for TaskName {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|task| task.name() == name)
            .ok_or_else(|| format!("no task `{name}`; tasks are {}", Self::ALL.map(Self::name).join(", ")))
    }
}

/// Multi-clip motion-capture tracking (`dm_control/locomotion/tasks/reference_pose/tracking.py`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tracking {
    /// Which frames ahead of the current one the policy sees (S: the next five).
    pub reference_steps: Vec<usize>,
    /// Frames a started episode must at least be able to last (dm_control: 10). The last
    /// `max(reference_steps) + min_steps` frames are no starts; 5 gives the supplement's "last 10 frames".
    pub min_steps: usize,
    /// τ: the episode ends with discount 0 when the termination error exceeds it (S).
    pub termination_threshold: f64,
    /// How the termination error adds up.
    pub termination_error: TerminationError,
    /// Seconds after which an episode is truncated (dm_control's example: 30).
    pub time_limit: f64,
    /// Start every episode at its clip's first frame instead of a random one.
    pub always_start_at_clip_start: bool,
    /// Preset the actuators' filter state to the reference pose at reset. dm_control leaves it at 0, mid-range.
    pub preset_actuators: bool,
    /// Task observations, by dm_control's names without `walker/`, in this order
    /// (MoCapAct's choice: the supplement's "relative target positions and orientations in the local frame").
    pub observations: Vec<String>,
}

impl Default for Tracking {
    fn default() -> Self {
        Self {
            reference_steps: vec![1, 2, 3, 4, 5],
            min_steps: 10,
            termination_threshold: 0.3,
            termination_error: TerminationError::DmControl,
            time_limit: 30.0,
            always_start_at_clip_start: false,
            preset_actuators: false,
            observations: ["body_height", "reference_rel_bodies_pos_local", "reference_rel_bodies_quats"]
                .map(String::from)
                .to_vec(),
        }
    }
}

/// ε, the termination error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TerminationError {
    /// ½·mean|Δ body positions| + ½·mean|Δ joints|: what the published code computes.
    DmControl,
    /// ‖Δ body positions‖₁ + ‖Δ joints‖₁, summed: the supplement's text, taken literally.
    Supplement,
}

/// The pose in which an episode begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StartPose {
    /// A frame of the experiment's clips, drawn evenly, with its velocities and turned to face where the task begins
    /// (S: "a suitable motion capture pose").
    Clip,
    /// dm_control's upright pose: every joint at 0, arms out (C).
    Upright,
}

/// Walk to targets (`dm_control/locomotion/tasks/go_to_target.py`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GoToTarget {
    /// Targets and starts are drawn from a square of this half width, m (C: half of the arena's 8).
    pub half_width: f64,
    /// Horizontal distance at which a target counts as reached, m (S).
    pub tolerance: f64,
    /// Steps within the tolerance after which the target moves (S).
    pub steps_at_target: u32,
    /// Whether it moves at all (S; dm_control's default: no).
    pub moving_target: bool,
    /// Whether episodes begin with a random heading (S: "randomly initialized"; dm_control's default: no).
    pub random_heading: bool,
    /// Carry the count of rewarded steps into the next episode, as dm_control's code does; off, it starts at 0 (D).
    pub carry_count: bool,
    /// Seconds an episode lasts (S).
    pub time_limit: f64,
    /// The pose in which an episode begins.
    pub start_pose: StartPose,
}

impl Default for GoToTarget {
    fn default() -> Self {
        Self {
            half_width: 4.0,
            tolerance: 1.0,
            steps_at_target: 10,
            moving_target: true,
            random_heading: true,
            carry_count: false,
            time_limit: 25.0,
            start_pose: StartPose::Clip,
        }
    }
}

/// What both corridors share (`dm_control/locomotion/tasks/corridors.py`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Corridor {
    /// Length, m (S).
    pub length: f64,
    /// Width, m (S).
    pub width: f64,
    /// Speed that is rewarded most, m/s; the reward falls linearly to 0 at 0 and at twice this (S).
    pub target_velocity: f64,
    /// An end effector below this height ends the episode, m (C).
    pub fall_height: f64,
    /// Seconds an episode lasts (S).
    pub time_limit: f64,
    /// The pose in which an episode begins, 0.5 m into the corridor.
    pub start_pose: StartPose,
    /// An arena is drawn anew at the first reset after so many control steps; 0 is at every reset, as dm_control does.
    /// Compiling one costs as much as some twenty steps (D).
    pub arena_steps: u32,
    /// What the humanoid's camera sees.
    pub vision: Vision,
}

impl Default for Corridor {
    fn default() -> Self {
        Self {
            length: 100.0,
            width: 10.0,
            target_velocity: 3.0,
            fall_height: -0.5,
            time_limit: 45.0,
            start_pose: StartPose::Clip,
            arena_steps: 512,
            vision: Vision::Fast,
        }
    }
}

/// How the egocentric camera's images are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Vision {
    /// No images: the task is blind.
    Off,
    /// Without shadows and without multisampling (D).
    Fast,
    /// As dm_control draws them: a 4096² shadow map, four samples a pixel (C). Some twenty times slower in software.
    Full,
}

/// The corridor with gaps (`locomotion/arenas/corridors.py`, `GapsCorridor`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Gaps {
    /// Range of a platform's length, m (S).
    pub platform: [f64; 2],
    /// Range of a gap's length, m (S; dm_control's example: 0.5 to 1.25).
    pub gap: [f64; 2],
    /// The corridor itself.
    pub corridor: Corridor,
}

impl Default for Gaps {
    fn default() -> Self {
        Self { platform: [0.3, 2.5], gap: [0.75, 1.25], corridor: Corridor::default() }
    }
}

/// The corridor with walls (`locomotion/arenas/corridors.py`, `WallsCorridor`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Walls {
    /// Distance from wall to wall, m (S; dm_control's example: 4).
    pub spacing: f64,
    /// Range of how far a wall reaches into the corridor, m (S).
    pub wall_width: [f64; 2],
    /// Range of a wall's height, m (S; dm_control's example: 3).
    pub wall_height: [f64; 2],
    /// On which side walls stand.
    pub side: WallSide,
    /// Whether walls are coloured at random (S; dm_control's default: white).
    pub random_colours: bool,
    /// The first wall stands 4 m further on (dm_control's default; its example has it off).
    pub initial_padding: bool,
    /// The corridor itself.
    pub corridor: Corridor,
}

impl Default for Walls {
    fn default() -> Self {
        Self {
            spacing: 5.0,
            wall_width: [1.0, 7.0],
            wall_height: [2.5, 4.0],
            side: WallSide::Random,
            random_colours: true,
            initial_padding: false,
            corridor: Corridor::default(),
        }
    }
}

/// The side of the corridor from which a wall reaches into it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WallSide {
    /// Either side, a coin for each wall (S: "randomly placed on either side").
    Random,
    /// Left and right in turn (dm_control's default).
    Alternate,
}

/// Get up and stand (supplement 1.3; no published code). Numbers without a mark are decisions of this project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GetUp {
    /// Share of the episodes that begin lying (S: "about 5%"); the others begin above the ground, standing.
    pub lying_share: f64,
    /// Where lying poses come from.
    pub lying_pose: LyingPose,
    /// Height of the head that counts as standing, m: that of the upright pose.
    pub target_height: f64,
    /// Range of how far above the ground a standing start floats, m.
    pub drop_height: [f64; 2],
    /// Standard deviation of a standing start's tilt about a random horizontal axis, rad.
    pub tilt: f64,
    /// Standard deviation of a standing start's joint angles around the start pose, rad.
    pub joint_noise: f64,
    /// Standard deviation of its root's velocity, m/s a component.
    pub velocity_noise: f64,
    /// Standard deviation of its root's angular and its joints' velocities, rad/s.
    pub angular_velocity_noise: f64,
    /// The pose that standing starts vary.
    pub start_pose: StartPose,
    /// Seconds an episode lasts (S).
    pub time_limit: f64,
}

impl Default for GetUp {
    fn default() -> Self {
        Self {
            lying_share: 0.05,
            lying_pose: LyingPose::Simulated,
            target_height: 1.808,
            drop_height: [0.02, 0.15],
            tilt: 0.15,
            joint_noise: 0.1,
            velocity_noise: 0.3,
            angular_velocity_noise: 0.5,
            start_pose: StartPose::Upright,
            time_limit: 8.0,
        }
    }
}

/// Where lying poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LyingPose {
    /// Random poses are dropped and simulated for three seconds without control.
    Simulated,
    /// The first frame of each clip of the experiment: for clips of getting up, dm_control's subset `get_up`.
    Clips,
}

/// Ball catching (supplement 1.3; no published code). Numbers without a mark are decisions of this project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BallCatch {
    /// Range of the ball's radius, m; random per episode (S).
    pub radius: [f64; 2],
    /// Range of its mass, kg; random per episode (S).
    pub mass: [f64; 2],
    /// Balls that are compiled when the task is built; an episode plays with one of them.
    pub balls: usize,
    /// Range of the distance in front of the humanoid at which the ball starts, m.
    pub distance: [f64; 2],
    /// Range of its start's distance from the straight line ahead, m.
    pub lateral: [f64; 2],
    /// Range of its start's height, m.
    pub height: [f64; 2],
    /// Where it is thrown at: distance in front of the chest, m.
    pub aim_distance: f64,
    /// Range of the aim's distance from the straight line ahead, m.
    pub aim_lateral: [f64; 2],
    /// Range of the aim's height, m.
    pub aim_height: [f64; 2],
    /// Range of the time of flight to the aim, s: the throw goes upwards and towards the humanoid (S).
    pub flight_time: [f64; 2],
    /// Standard deviation of the ball's angular velocity, rad/s a component; random per episode (S).
    pub spin: f64,
    /// Reward when the ball touches the ground or the head, which ends the episode (S).
    pub failure_reward: f64,
    /// Reward for each hand that touches the ball with its front, and penalty for its back (S).
    pub touch_reward: f64,
    /// The most the reward for standing up is (S: the get-up reward, scaled).
    pub standing_reward: f64,
    /// Steps of holding the ball after which it counts as caught.
    pub hold_steps: u32,
    /// The most the reward for walking to the target is, once the ball is caught.
    pub walking_reward: f64,
    /// Speed towards the target that earns all of it, m/s.
    pub walking_speed: f64,
    /// Distance ahead at which the target lies, m.
    pub target_distance: f64,
    /// Height of the head that counts as standing, m: that of the upright pose.
    pub target_height: f64,
    /// The pose in which an episode begins (S: a standing one).
    pub start_pose: StartPose,
    /// Seconds an episode lasts (S).
    pub time_limit: f64,
}

impl Default for BallCatch {
    fn default() -> Self {
        Self {
            radius: [0.08, 0.15],
            mass: [0.3, 1.5],
            balls: 32,
            distance: [2.0, 3.0],
            lateral: [-0.3, 0.3],
            height: [0.8, 1.3],
            aim_distance: 0.35,
            aim_lateral: [-0.2, 0.2],
            aim_height: [1.1, 1.5],
            flight_time: [0.6, 0.9],
            spin: 3.0,
            failure_reward: -1.0,
            touch_reward: 0.01,
            standing_reward: 0.01,
            hold_steps: 10,
            walking_reward: 0.01,
            walking_speed: 1.0,
            target_distance: 3.0,
            target_height: 1.808,
            start_pose: StartPose::Upright,
            time_limit: 6.0,
        }
    }
}
