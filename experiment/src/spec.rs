//! What a task looks like from outside the simulator: sizes and names.

use serde::{Deserialize, Serialize};

use crate::{Experiment, TaskName, Tracking, Vision};

/// Tracking bodies of the V2020 humanoid, `face` among them.
const BODIES: usize = 31;
/// Hinges, and so actuators, of the CMU humanoid.
pub const ACTION_SIZE: usize = 56;
/// Proprioception (supplement 1.1, with MoCapAct's order): what it is made of, by dm_control's names without `walker/`,
/// and how many numbers each has.
pub const PROPRIOCEPTION: [(&str, usize); 9] = [
    ("joints_pos", ACTION_SIZE),
    ("joints_vel", ACTION_SIZE),
    ("sensors_velocimeter", 3),
    ("sensors_gyro", 3),
    ("end_effectors_pos", 12),
    ("world_zaxis", 3),
    ("actuator_activation", ACTION_SIZE),
    ("sensors_touch", 10),
    ("sensors_torque", 6),
];
/// Length of proprioception: all of [`PROPRIOCEPTION`].
pub const PROPRIOCEPTION_SIZE: usize = 205;
/// Reward terms of the tracking task, in the order of dm_control's sorted reward channels.
pub const TRACKING_REWARD_TERMS: [&str; 5] =
    ["appendages", "body_quaternions", "center_of_mass", "joints_velocity", "termination"];
/// The most a tracking step can pay: 0.5 + 0.5·(0.1 + 1 + 0.15 + 0.65).
pub const TRACKING_MAX_REWARD: f64 = 1.45;

/// Sizes and names of what is learnt, one task or several: all that networks, wire and learner know of it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskSpec {
    /// Length of the proprioception vector.
    pub proprioception: usize,
    /// Length of the task observation vector (for tracking, the references); in joint training the longest, and zeros
    /// stand before a shorter one.
    pub task: usize,
    /// Bytes of an image of what the humanoid sees: 64 rows of 64 pixels of red, green and blue; 0 when it is blind.
    pub image: usize,
    /// Length of the action vector, each in [−1, 1].
    pub action: usize,
    /// Names of the reward terms; their sum is the reward. Joint training has one, the reward itself.
    pub reward_terms: Vec<String>,
    /// Names of the clips, task by task; a clip's index is its place here.
    pub clips: Vec<String>,
    /// The tasks, the experiment's `task` first.
    pub tasks: Vec<TaskPart>,
}

/// What is one task's own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskPart {
    /// The task's name.
    pub name: String,
    /// Length of its observation: the last so many entries of the task observation vector.
    pub observation: usize,
    /// Number of its clips.
    pub clips: usize,
    /// The most a step of it can pay: what normalised rewards are relative to.
    pub max_reward: f64,
    /// Whether it has a reference, whose servo action is a demonstration.
    pub demonstrated: bool,
}

/// Reward terms of go-to-target.
pub const GO_TO_TARGET_REWARD_TERMS: [&str; 1] = ["target"];
/// Reward terms of the corridors.
pub const CORRIDOR_REWARD_TERMS: [&str; 1] = ["velocity"];
/// Reward terms of get-up-and-stand.
pub const GET_UP_REWARD_TERMS: [&str; 1] = ["height"];
/// Reward terms of ball catching.
pub const BALL_CATCH_REWARD_TERMS: [&str; 4] = ["failure", "touch", "standing", "walking"];
/// Height and width of the egocentric camera's image, in pixels of three bytes (C).
pub const IMAGE_SIZE: usize = 64;

/// The reward term of joint training.
pub const JOINT_REWARD_TERMS: [&str; 1] = ["reward"];

impl Experiment {
    fn image_bytes(&self, task: TaskName) -> usize {
        let vision = match task {
            TaskName::Gaps => self.gaps.corridor.vision,
            TaskName::Walls => self.walls.corridor.vision,
            _ => Vision::Off,
        };
        if vision == Vision::Off { 0 } else { IMAGE_SIZE * IMAGE_SIZE * 3 }
    }

    /// What one of its tasks observes beside proprioception: names and sizes, in the order of the task observation
    /// vector; tracking's names are dm_control's without `walker/`.
    ///
    /// # Errors
    /// The name of an observation that the tracking task does not have.
    pub fn observations(&self, task: TaskName) -> Result<Vec<(String, usize)>, String> {
        let parts: &[(&str, usize)] = match task {
            TaskName::Tracking => return tracking_observations(&self.tracking),
            // In the root's frame, m.
            TaskName::GoToTarget => &[("target", 3)],
            // The root's height, m.
            TaskName::Gaps | TaskName::Walls | TaskName::GetUp => &[("body_height", 1)],
            // In the root's frame: m, m/s, rad/s, m, m.
            TaskName::BallCatch => &[
                ("ball_position", 3),
                ("ball_velocity", 3),
                ("ball_angular_velocity", 3),
                ("ball_radius", 1),
                ("target", 3),
            ],
        };
        Ok(parts.iter().map(|(name, size)| ((*name).to_string(), *size)).collect())
    }

    /// The most a step of the task can pay.
    fn max_reward(&self, task: TaskName) -> f64 {
        match task {
            TaskName::Tracking => TRACKING_MAX_REWARD,
            TaskName::GoToTarget | TaskName::Gaps | TaskName::Walls | TaskName::GetUp => 1.0,
            TaskName::BallCatch => {
                let ball = &self.ball_catch;
                2.0 * ball.touch_reward + ball.standing_reward + ball.walking_reward
            }
        }
    }
}

impl TaskSpec {
    /// The experiment's task, or tasks, over these clips, whose names only tracking keeps: any other task is a clip of its
    /// own.
    ///
    /// # Errors
    /// The name of an observation that the tracking task does not have.
    pub fn new(experiment: &Experiment, clips: Vec<String>) -> Result<Self, String> {
        let of = |task| Self::of_task(experiment, task, clips.clone());
        let mut spec = of(experiment.task)?;
        for complement in &experiment.joint {
            spec.join(of(complement.task)?);
        }
        Ok(spec)
    }

    /// One of the experiment's tasks alone.
    ///
    /// # Errors
    /// The name of an observation that the tracking task does not have.
    pub fn of_task(experiment: &Experiment, task: TaskName, clips: Vec<String>) -> Result<Self, String> {
        let terms: &[&str] = match task {
            TaskName::Tracking => return Self::tracking(&experiment.tracking, clips),
            TaskName::GoToTarget => &GO_TO_TARGET_REWARD_TERMS,
            TaskName::Gaps | TaskName::Walls => &CORRIDOR_REWARD_TERMS,
            TaskName::GetUp => &GET_UP_REWARD_TERMS,
            TaskName::BallCatch => &BALL_CATCH_REWARD_TERMS,
        };
        let name = task.name().to_string();
        let observation = total(&experiment.observations(task)?);
        let mut spec = Self::alone(name.clone(), observation, experiment.max_reward(task), terms, vec![name]);
        spec.image = experiment.image_bytes(task);
        Ok(spec)
    }

    /// The tracking task over these clips.
    ///
    /// # Errors
    /// The name of an observation that the tracking task does not have.
    pub fn tracking(config: &Tracking, clips: Vec<String>) -> Result<Self, String> {
        let observation = total(&tracking_observations(config)?);
        let name = TaskName::Tracking.name().to_string();
        Ok(Self::alone(name, observation, TRACKING_MAX_REWARD, &TRACKING_REWARD_TERMS, clips))
    }

    fn alone(name: String, observation: usize, max_reward: f64, terms: &[&str], clips: Vec<String>) -> Self {
        Self {
            proprioception: PROPRIOCEPTION_SIZE,
            task: observation,
            image: 0,
            action: ACTION_SIZE,
            reward_terms: terms.iter().map(|term| (*term).to_string()).collect(),
            tasks: vec![TaskPart {
                demonstrated: name == TaskName::Tracking.name(),
                name,
                observation,
                clips: clips.len(),
                max_reward,
            }],
            clips,
        }
    }

    /// One more task.
    fn join(&mut self, other: Self) {
        self.task = self.task.max(other.task);
        self.image = self.image.max(other.image);
        self.reward_terms = JOINT_REWARD_TERMS.map(String::from).to_vec();
        self.clips.extend(other.clips);
        self.tasks.extend(other.tasks);
    }

    /// The task that a clip belongs to: its place among the tasks, the last one's for a clip there is not.
    pub fn task_of(&self, clip: usize) -> usize {
        let mut end = 0;
        let found = self.tasks.iter().position(|task| {
            end += task.clips;
            clip < end
        });
        found.unwrap_or(self.tasks.len().saturating_sub(1))
    }

    /// The most a step of an episode of this clip can pay.
    pub fn max_reward(&self, clip: usize) -> f64 {
        self.tasks.get(self.task_of(clip)).map_or(1.0, |task| task.max_reward)
    }
}

fn total(parts: &[(String, usize)]) -> usize {
    parts.iter().map(|(_, size)| size).sum()
}

fn tracking_observations(config: &Tracking) -> Result<Vec<(String, usize)>, String> {
    let steps = config.reference_steps.len();
    let sized = |name: &String| tracking_observation_size(name, steps).map(|size| (name.clone(), size));
    config.observations.iter().map(|name| sized(name).ok_or_else(|| name.clone())).collect()
}

/// Every task observation the tracking task offers, by dm_control's name without `walker/`.
pub const TRACKING_OBSERVATIONS: [&str; 14] = [
    "body_height",
    "appendages_pos",
    "sensors_accelerometer",
    "velocimeter_control",
    "gyro_control",
    "joints_vel_control",
    "time_in_clip",
    "reference_rel_joints",
    "reference_rel_bodies_pos_local",
    "reference_rel_bodies_quats",
    "reference_ego_bodies_quats",
    "reference_rel_root_quat",
    "reference_rel_root_pos_local",
    "reference_appendages_pos",
];

/// Length of one of [`TRACKING_OBSERVATIONS`] with `steps` reference steps; `None` for any other name.
pub fn tracking_observation_size(name: &str, steps: usize) -> Option<usize> {
    Some(match name {
        "body_height" | "time_in_clip" => 1,
        "appendages_pos" => 15,
        "sensors_accelerometer" | "velocimeter_control" | "gyro_control" => 3,
        "joints_vel_control" => ACTION_SIZE,
        "reference_rel_joints" => steps * ACTION_SIZE,
        "reference_rel_bodies_pos_local" => steps * BODIES * 3,
        "reference_rel_bodies_quats" | "reference_ego_bodies_quats" => steps * BODIES * 4,
        "reference_rel_root_quat" => steps * 4,
        "reference_rel_root_pos_local" => steps * 3,
        "reference_appendages_pos" => steps * 15,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn proprioception_is_as_long_as_its_parts() {
        assert_eq!(PROPRIOCEPTION.iter().map(|(_, size)| size).sum::<usize>(), PROPRIOCEPTION_SIZE);
    }
}
