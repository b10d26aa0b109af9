//! Joint training: each episode draws one of several tasks (supplement 1.3).

use std::sync::Arc;

use comic_experiment::TaskSpec;
use mujoco_rs::prelude::MjModel;
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;

use crate::achievement::Achievement;
use crate::environment::{ClipStarts, Environment, Episode, MAX_REWARD_TERMS, Scenery, Simulated, Step, Task};
use crate::error::Error;
use crate::physics::Simulation;

/// Several tasks, and the probability of an episode of each.
#[derive(Debug)]
pub(crate) struct JointTask {
    spec: TaskSpec,
    parts: Vec<Part>,
    starts: Vec<ClipStarts>,
}

#[derive(Debug)]
struct Part {
    task: Arc<dyn Task>,
    probability: f64,
    /// Index of the task's first clip.
    first_clip: usize,
}

impl JointTask {
    /// `spec` describes all tasks together.
    pub(crate) fn new(spec: TaskSpec, tasks: Vec<(Arc<dyn Task>, f64)>) -> Self {
        let mut first_clip = 0;
        let (mut parts, mut starts) = (Vec::new(), Vec::new());
        for (task, probability) in tasks {
            starts.extend(task.starts().iter().map(|start| ClipStarts {
                clip: first_clip + start.clip,
                frames: start.frames.clone(),
                probability: probability * start.probability,
            }));
            let clips = task.spec().clips.len();
            parts.push(Part { task, probability, first_clip });
            first_clip += clips;
        }
        Self { spec, parts, starts }
    }
}

impl Task for JointTask {
    fn spec(&self) -> &TaskSpec {
        &self.spec
    }

    fn starts(&self) -> &[ClipStarts] {
        &self.starts
    }

    fn control_timestep(&self) -> f64 {
        self.parts.first().map_or(0.0, |part| part.task.control_timestep())
    }

    fn environment(self: Arc<Self>, seed: u64) -> Result<Box<dyn Simulated>, Error> {
        let mut random = Pcg64::seed_from_u64(seed);
        let environments = self.parts.iter().map(|part| Arc::clone(&part.task).environment(random.random()));
        let environments = environments.collect::<Result<_, Error>>()?;
        let mut environment = JointEnvironment { task: self, environments, current: 0, random };
        environment.reset();
        Ok(Box::new(environment))
    }
}

/// One environment of each task. The current episode is in one of them.
#[derive(Debug)]
struct JointEnvironment {
    task: Arc<JointTask>,
    environments: Vec<Box<dyn Simulated>>,
    /// The place of the current episode's task.
    current: usize,
    random: Pcg64,
}

impl JointEnvironment {
    fn environment(&self) -> &dyn Simulated {
        self.environments[self.current].as_ref()
    }

    fn environment_mut(&mut self) -> &mut dyn Simulated {
        self.environments[self.current].as_mut()
    }

    /// Length of the current task's observation.
    fn observation_size(&self) -> usize {
        self.task.spec.tasks.get(self.current).map_or(0, |task| task.observation)
    }
}

/// The step with its reward in one term, as joint training has it.
fn in_one_term(step: Step) -> Step {
    let mut reward_terms = [0.0; MAX_REWARD_TERMS];
    reward_terms[0] = step.reward();
    Step { reward_terms, ..step }
}

impl Environment for JointEnvironment {
    fn reset(&mut self) {
        let mut left = self.random.random::<f64>();
        let drawn = self.task.parts.iter().position(|part| {
            left -= part.probability;
            left < 0.0
        });
        // By rounding the sum of the probabilities can be less than the draw.
        self.current = drawn.unwrap_or(0);
        self.environment_mut().reset();
    }

    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), Error> {
        self.current = self.task.spec.task_of(clip);
        let first = self.task.parts.get(self.current).map_or(0, |part| part.first_clip);
        self.environment_mut().reset_to(clip.saturating_sub(first), start)
    }

    fn step(&mut self, action: &[f32]) -> Step {
        in_one_term(self.environment_mut().step(action))
    }

    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]) {
        let (rest, observed) = task.split_at_mut(self.task.spec.task.saturating_sub(self.observation_size()));
        rest.fill(0.0);
        self.environment().observe(proprioception, observed);
    }

    fn draw(&mut self, image: &mut [u8]) -> Result<(), Error> {
        self.environment_mut().draw(image)
    }

    fn episode(&self) -> Episode {
        let episode = self.environment().episode();
        let first = self.task.parts.get(self.current).map_or(0, |part| part.first_clip);
        Episode { clip: first + episode.clip, task: self.current, ..episode }
    }

    fn record_gradients(&mut self) -> Result<(), Error> {
        self.environments.iter_mut().try_for_each(Environment::record_gradients)
    }

    /// All steps of an unroll belong to one task, so at most one environment has any.
    fn take_gradients(&mut self) -> Vec<[f32; 56]> {
        self.environments.iter_mut().flat_map(Environment::take_gradients).collect()
    }

    fn position_errors(&self, errors: &mut Vec<[f64; 3]>) {
        self.environment().position_errors(errors);
    }

    fn achievement(&self) -> Achievement {
        self.environment().achievement()
    }

    fn servo_action(&self, action: &mut [f32]) {
        self.environment().servo_action(action);
    }
}

impl Simulated for JointEnvironment {
    fn step_control(&mut self, control: &[f64; 56]) -> Step {
        in_one_term(self.environment_mut().step_control(control))
    }

    fn reseed(&mut self, seed: u64) {
        self.random = Pcg64::seed_from_u64(seed);
        for environment in &mut self.environments {
            environment.reseed(self.random.random());
        }
    }

    fn model(&self) -> Arc<MjModel> {
        self.environment().model()
    }

    fn simulation(&self) -> &Simulation {
        self.environment().simulation()
    }

    fn simulation_mut(&mut self) -> &mut Simulation {
        self.environment_mut().simulation_mut()
    }

    fn scenery(&self) -> Scenery {
        self.environment().scenery()
    }
}
