//! Several tasks at once: every episode draws its own (supplement 1.3, joint training).

use std::sync::Arc;

use comic_experiment::TaskSpec;
use mujoco_rs::prelude::MjModel;
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;

use crate::error::Error;
use crate::physics::Simulation;
use crate::starts::ClipStarts;
use crate::{Environment, Episode, MAX_REWARD_TERMS, Scenery, Simulated, Step, Task};

/// Tasks, and how likely an episode is one of each.
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
    /// Index of its first clip.
    first_clip: usize,
}

impl JointTask {
    /// `spec` is that of all of them.
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
        let mut environment = JointEnvironment { task: self, environments, playing: 0, random };
        environment.reset();
        Ok(Box::new(environment))
    }
}

/// A simulation of each task, one of which is played.
#[derive(Debug)]
struct JointEnvironment {
    task: Arc<JointTask>,
    environments: Vec<Box<dyn Simulated>>,
    /// The task's place.
    playing: usize,
    random: Pcg64,
}

impl JointEnvironment {
    fn current(&self) -> &dyn Simulated {
        self.environments[self.playing].as_ref()
    }

    fn current_mut(&mut self) -> &mut dyn Simulated {
        self.environments[self.playing].as_mut()
    }

    /// Length of the current task's observation.
    fn observed(&self) -> usize {
        self.task.spec.tasks.get(self.playing).map_or(0, |task| task.observation)
    }
}

/// What joint training pays: the reward, in one term.
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
        // Rounding may leave a little over.
        self.playing = drawn.unwrap_or(0);
        self.current_mut().reset();
    }

    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), Error> {
        self.playing = self.task.spec.task_of(clip);
        let first = self.task.parts.get(self.playing).map_or(0, |part| part.first_clip);
        self.current_mut().reset_to(clip.saturating_sub(first), start)
    }

    fn step(&mut self, action: &[f32]) -> Step {
        in_one_term(self.current_mut().step(action))
    }

    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]) {
        let (rest, observed) = task.split_at_mut(self.task.spec.task.saturating_sub(self.observed()));
        rest.fill(0.0);
        self.current().observe(proprioception, observed);
    }

    fn draw(&mut self, image: &mut [u8]) -> Result<(), Error> {
        self.current_mut().draw(image)
    }

    fn episode(&self) -> Episode {
        let episode = self.current().episode();
        let first = self.task.parts.get(self.playing).map_or(0, |part| part.first_clip);
        Episode { clip: first + episode.clip, task: self.playing, ..episode }
    }

    fn servo_action(&self, action: &mut [f32]) {
        self.current().servo_action(action);
    }
}

impl Simulated for JointEnvironment {
    fn step_control(&mut self, control: &[f64; 56]) -> Step {
        in_one_term(self.current_mut().step_control(control))
    }

    fn model(&self) -> Arc<MjModel> {
        self.current().model()
    }

    fn simulation(&self) -> &Simulation {
        self.current().simulation()
    }

    fn simulation_mut(&mut self) -> &mut Simulation {
        self.current_mut().simulation_mut()
    }

    fn scenery(&self) -> Scenery {
        self.current().scenery()
    }
}

#[cfg(test)]
mod tests {
    use comic_clips::Catalogue;
    use comic_experiment::{Experiment, resolve};
    use mujoco_rs::prelude::MjtObjBase;

    use super::*;
    use crate::Outcome;

    fn experiment(joint: &str) -> Experiment {
        resolve("tracking-mlp", &[format!("joint={joint}"), "get_up.lying_share=0".into()]).unwrap()
    }

    fn build(experiment: &Experiment) -> Arc<dyn Task> {
        crate::build(experiment, &Catalogue::open(&experiment.clips).unwrap()).unwrap()
    }

    const BOTH: &str = r#"[{task="get-up", probability=0.1}, {task="ball-catch", probability=0.2}]"#;

    #[test]
    fn episodes_draw_their_tasks_by_the_probabilities() {
        let task = build(&experiment(BOTH));
        let mut environment = task.environment(3).unwrap();
        let draws = 4000;
        let mut counts = [0.0; 3];
        for _ in 0..draws {
            environment.reset();
            counts[environment.episode().task] += 1.0;
        }
        for (count, probability) in counts.into_iter().zip([0.7, 0.1, 0.2]) {
            let (expected, deviation) =
                (f64::from(draws) * probability, (f64::from(draws) * probability * (1.0 - probability)).sqrt());
            assert!((count - expected).abs() < 5.0 * deviation, "{counts:?}");
        }
    }

    #[test]
    fn every_step_tells_where_the_head_is() {
        let task = build(&experiment(BOTH));
        let mut environment = task.environment(3).unwrap();
        for clip in 0..3 {
            environment.reset_to(clip, 10).unwrap();
            let step = environment.step_control(&[0.0; 56]);
            let head = environment.model().name_to_id(MjtObjBase::mjOBJ_BODY, "walker/head").unwrap();
            assert_eq!(step.head_height, environment.simulation().xpos()[head][2], "clip {clip}");
            assert!((0.1..2.0).contains(&step.head_height), "{}", step.head_height);
        }
        // What get-up pays is a function of it (supplement): target height 1.808 m.
        environment.reset_to(1, 10).unwrap();
        let step = environment.step_control(&[0.0; 56]);
        assert!((step.reward() - (-(step.head_height - 1.808).powi(2)).exp()).abs() < 1e-12, "{step:?}");
        assert_eq!(environment.step_control(&[f64::NAN; 56]).head_height, 0.0);
    }

    #[test]
    fn clips_are_numbered_through_and_every_start_is_its_own_tasks() {
        let task = build(&experiment(BOTH));
        let spec = task.spec().clone();
        assert_eq!(spec.clips, ["CMU_007_01", "get-up", "ball-catch"]);
        assert_eq!(spec.reward_terms, ["reward"]);
        let share: f64 = task.starts().iter().map(|start| start.probability).sum();
        assert!((share - 1.0).abs() < 1e-12);
        let mut environment = Arc::clone(&task).environment(1).unwrap();
        for start in task.starts() {
            environment.reset_to(start.clip, start.frames.start).unwrap();
            let episode = environment.episode();
            assert_eq!((episode.clip, episode.task), (start.clip, spec.task_of(start.clip)));
        }
        assert!(environment.reset_to(3, 0).is_err());
    }

    #[test]
    fn each_task_is_what_it_is_alone_its_observation_last_and_its_reward_in_one_term() {
        let together = experiment(BOTH);
        let joint = build(&together);
        let mut environment = Arc::clone(&joint).environment(1).unwrap();
        for (index, (name, _)) in together.tasks().into_iter().enumerate() {
            let alone = build(&Experiment { task: name, joint: Vec::new(), ..together.clone() });
            let mut own = Arc::clone(&alone).environment(1).unwrap();
            let start = alone.starts()[0].frames.start;
            environment.reset_to(index, start).unwrap();
            own.reset_to(0, start).unwrap();
            let action = [0.1; 56];
            for _ in 0..3 {
                let observed = |environment: &dyn Simulated, width: usize| {
                    let (mut body, mut task) = (vec![0.0; 205], vec![9.0; width]);
                    environment.observe(&mut body, &mut task);
                    (body, task)
                };
                let (mut expected, found) =
                    (observed(own.as_ref(), alone.spec().task), observed(environment.as_ref(), joint.spec().task));
                let mut filled = vec![0.0; joint.spec().task - expected.1.len()];
                filled.append(&mut expected.1);
                expected.1 = filled;
                assert_eq!(found, expected, "{name}");
                let (expected, found) = (own.step(&action), environment.step(&action));
                assert_eq!((found.reward(), found.discount), (expected.reward(), expected.discount), "{name}");
                assert_eq!(found.reward_terms[1..], [0.0; MAX_REWARD_TERMS - 1]);
                if expected.outcome != Outcome::Running {
                    break;
                }
            }
        }
    }
}
