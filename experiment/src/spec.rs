//! What networks, wire and learner know of a task: sizes and names.

use serde::{Deserialize, Serialize};

use crate::body::{ACTION_SIZE, IMAGE_SIZE, PROPRIOCEPTION_SIZE};
use crate::document::Experiment;
use crate::tasks::{TaskName, TaskParameters, Tracking, Vision};

/// The reward term of joint training.
const JOINT_REWARD_TERMS: [&str; 1] = ["reward"];

/// Sizes and names of one task, or of all tasks of joint training.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskSpec {
    /// Length of the proprioception vector.
    pub proprioception: usize,
    /// Length of the task observation vector (for tracking, the references). In joint training it is the longest task's
    /// length. A shorter observation has zeros in front.
    pub task: usize,
    /// Bytes of a camera image: 64 rows of 64 pixels of red, green and blue. 0 in a task without images.
    pub image: usize,
    /// Length of the action vector, each in [−1, 1]. In transfer the policy's action is the latent of the frozen low level,
    /// which is not bounded.
    pub action: usize,
    /// Names of the reward terms. Their sum is the reward. Joint training has one term, the reward itself.
    pub reward_terms: Vec<String>,
    /// Names of the clips, task by task. A clip's index is its place in this list.
    pub clips: Vec<String>,
    /// The tasks, the experiment's `task` first.
    pub tasks: Vec<TaskPart>,
}

/// What belongs to one task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskPart {
    /// The task's name.
    pub name: String,
    /// Length of its observation, which fills the end of the task observation vector.
    pub observation: usize,
    /// Number of its clips.
    pub clips: usize,
    /// The largest reward of one step. Normalised rewards are divided by it.
    pub max_reward: f64,
}

impl Experiment {
    /// What one of its tasks observes besides proprioception: names and sizes, in the order of the task observation
    /// vector. Tracking's names are dm_control's without `walker/`.
    ///
    /// # Errors
    /// The name of an observation that the tracking task does not have.
    pub fn observations(&self, task: TaskName) -> Result<Vec<(String, usize)>, String> {
        self.parameters(task).observations()
    }
}

impl TaskSpec {
    /// The experiment's task, or its tasks. `clips` names the clips of the tracking task. Any other task counts as one
    /// clip with the task's name.
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

    /// One task of the experiment alone.
    ///
    /// # Errors
    /// The name of an observation that the tracking task does not have.
    pub fn of_task(experiment: &Experiment, task: TaskName, clips: Vec<String>) -> Result<Self, String> {
        let spec = Self::alone(task, experiment.parameters(task), clips)?;
        Ok(Self { action: experiment.action_size(), ..spec })
    }

    /// The tracking task with these clips.
    ///
    /// # Errors
    /// The name of an observation that the tracking task does not have.
    pub fn tracking(config: &Tracking, clips: Vec<String>) -> Result<Self, String> {
        Self::alone(TaskName::Tracking, config, clips)
    }

    fn alone(task: TaskName, parameters: &dyn TaskParameters, clips: Vec<String>) -> Result<Self, String> {
        let name = task.name().to_string();
        let observation = parameters.observations()?.iter().map(|(_, size)| size).sum();
        let draws = parameters.vision().is_some_and(|(_, vision)| vision != Vision::Off);
        let clips = if parameters.follows_clips() { clips } else { vec![name.clone()] };
        let part = TaskPart { name, observation, clips: clips.len(), max_reward: parameters.max_reward() };
        Ok(Self {
            proprioception: PROPRIOCEPTION_SIZE,
            task: observation,
            image: if draws { IMAGE_SIZE * IMAGE_SIZE * 3 } else { 0 },
            action: ACTION_SIZE,
            reward_terms: parameters.reward_terms().iter().map(|term| (*term).to_string()).collect(),
            clips,
            tasks: vec![part],
        })
    }

    /// Adds a task.
    fn join(&mut self, other: Self) {
        self.task = self.task.max(other.task);
        self.image = self.image.max(other.image);
        self.reward_terms = JOINT_REWARD_TERMS.map(String::from).to_vec();
        self.clips.extend(other.clips);
        self.tasks.extend(other.tasks);
    }

    /// The place of a clip's task among the tasks. It is the last task's place for an unknown clip.
    pub fn task_of(&self, clip: usize) -> usize {
        let mut end = 0;
        let found = self.tasks.iter().position(|task| {
            end += task.clips;
            clip < end
        });
        found.unwrap_or(self.tasks.len().saturating_sub(1))
    }

    /// The largest reward of one step in an episode of this clip.
    pub fn max_reward(&self, clip: usize) -> f64 {
        self.tasks.get(self.task_of(clip)).map_or(1.0, |task| task.max_reward)
    }
}
