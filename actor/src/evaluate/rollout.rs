//! Rolling out a list of starts, many environments in one forward pass.

use std::ops::ControlFlow;
use std::slice::Iter;

use comic_experiment::seed::derive;
use comic_proto::UnrollShape;
use comic_tasks::{Environment, Outcome, Step};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use super::report::Finished;
use super::settings::RolloutSettings;
use super::tracking_errors::TrackingErrors;
use crate::Error;
use crate::acting_loop::{ActingLoop, Controller, Recorder, Rollout};
use crate::forward_pass::{ActingRow, ForwardPass};

/// Watches a rollout, to show its progress or to film it.
pub trait Audience<E> {
    /// Called at an episode's begin, without a step, and after each of its steps, except a step that diverged. `number`
    /// is the start's. `Break` ends the rollout.
    ///
    /// # Errors
    /// An error ends the rollout.
    fn watch(&mut self, number: usize, environment: &mut E, step: Option<&Step>) -> Result<ControlFlow<()>, Error> {
        let _ = (number, environment, step);
        Ok(ControlFlow::Continue(()))
    }

    /// Called when an episode has ended: `done` of `all` are over.
    fn count(&mut self, done: usize, all: usize);
}

/// An audience that only counts.
impl<E, F: FnMut(usize, usize)> Audience<E> for F {
    fn count(&mut self, done: usize, all: usize) {
        self(done, all);
    }
}

/// Where an episode starts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Start {
    /// The clip's index.
    pub clip: usize,
    /// Frame within the clip.
    pub start: usize,
    /// Its number, which decides the noise of its episode together with the seed: the same start with the same number and
    /// seed has the same noise, whatever else is rolled out.
    pub number: usize,
}

impl Start {
    /// Starts by clip and frame, with the numbers 0, 1, …
    pub fn numbered(starts: impl IntoIterator<Item = (usize, usize)>) -> Vec<Self> {
        starts.into_iter().enumerate().map(|(number, (clip, start))| Self { clip, start, number }).collect()
    }
}

/// Rolls out every start, or until the audience breaks; episodes are in the order in which they end.
pub(super) fn run<E: Environment, F: ForwardPass>(
    controller: &mut Controller<'_, F>,
    environments: Vec<E>,
    shape: &UnrollShape,
    starts: &[Start],
    options: &RolloutSettings,
    audience: &mut dyn Audience<E>,
) -> Result<Vec<Finished>, Error> {
    let mut acting = ActingLoop::new(environments, shape, controller.low_level());
    let mut recorder = EpisodeRecorder {
        running: vec![Running::new(Start::default(), options.seed); acting.rollouts.len()],
        queue: starts.iter(),
        all: starts.len(),
        seed: options.seed,
        sees: matches!(controller, Controller::Policy(_)),
        finished: Vec::with_capacity(starts.len()),
        deterministic: options.deterministic,
        noise: options.noise,
        errors: Vec::new(),
        audience,
    };
    for (index, rollout) in acting.rollouts.iter_mut().enumerate() {
        if recorder.begin_next(index, rollout, &mut acting.batch.row(index))?.is_break() {
            return Ok(recorder.finished);
        }
    }
    while acting.rollouts.iter().any(|rollout| !rollout.ended) {
        if acting.iterate(controller, &mut recorder)?.is_break() {
            break;
        }
    }
    Ok(recorder.finished)
}

/// Collects episodes, begins the next ones, and shows them to the audience.
struct EpisodeRecorder<'a, E> {
    running: Vec<Running>,
    queue: Iter<'a, Start>,
    all: usize,
    /// The seed of all noise.
    seed: u64,
    /// Whether anything reads the camera images. Drawing needs OpenGL.
    sees: bool,
    finished: Vec<Finished>,
    deterministic: bool,
    /// Standard deviation of the noise on commands without other noise.
    noise: f32,
    /// Scratch: the bodies' position errors after a step.
    errors: Vec<[f64; 3]>,
    audience: &'a mut dyn Audience<E>,
}

/// The episode of one environment.
#[derive(Clone)]
struct Running {
    start: Start,
    /// The noise of this episode.
    rng: Pcg64,
    /// The reward of each step so far.
    rewards: Vec<f64>,
    tracking: TrackingErrors,
}

impl Running {
    fn new(start: Start, seed: u64) -> Self {
        // Another generator than those of the environments and of random starts, which have seeds derived once.
        let rng = Pcg64::seed_from_u64(derive(derive(seed, u64::MAX), start.number as u64));
        Self { start, rng, rewards: Vec::new(), tracking: TrackingErrors::default() }
    }
}

impl<E: Environment> EpisodeRecorder<'_, E> {
    /// Begins the next start's episode; the environment stays idle when there is none.
    fn begin_next(
        &mut self,
        index: usize,
        rollout: &mut Rollout<E>,
        row: &mut ActingRow<'_>,
    ) -> Result<ControlFlow<()>, Error> {
        let Some(start) = self.queue.next() else { return Ok(ControlFlow::Continue(())) };
        rollout.environment.reset_to(start.clip, start.start)?;
        rollout.environment.position_errors(&mut self.errors);
        let tracking = TrackingErrors::at_start(&self.errors);
        self.running[index] = Running { tracking, ..Running::new(*start, self.seed) };
        rollout.begin_episode(row);
        self.audience.watch(start.number, &mut rollout.environment, None)
    }

    fn finish(&mut self, index: usize, rollout: &Rollout<E>, outcome: Outcome) {
        let Running { start, rewards, tracking, .. } = &mut self.running[index];
        self.finished.push(Finished {
            number: start.number,
            clip: start.clip,
            start: start.start,
            steps_left: rollout.episode.steps_left,
            rewards: std::mem::take(rewards),
            returns: rollout.returns,
            head_heights: rollout.head_heights,
            tracking: tracking.sums(),
            achievement: rollout.environment.achievement(),
            outcome,
        });
        self.audience.count(self.finished.len(), self.all);
    }
}

impl<E: Environment> Recorder<E> for EpisodeRecorder<'_, E> {
    fn observe(&mut self, _index: usize, rollout: &mut Rollout<E>, row: &mut ActingRow<'_>) -> Result<(), Error> {
        if self.sees && !rollout.ended {
            rollout.environment.draw(row.image)?;
        }
        Ok(())
    }

    fn draw_latent_noise(&mut self, index: usize, row: &mut ActingRow<'_>) {
        // Without noise the latent is its mean.
        if !self.deterministic {
            row.draw_latent_noise(&mut self.running[index].rng);
        }
    }

    fn choose(&mut self, index: usize, rollout: &Rollout<E>, row: &mut ActingRow<'_>) {
        match (rollout.ended, self.deterministic) {
            (true, _) => {}
            (false, true) => row.take_mode(),
            (false, false) => row.sample(&mut self.running[index].rng),
        }
    }

    fn step(
        &mut self,
        index: usize,
        rollout: &mut Rollout<E>,
        row: &mut ActingRow<'_>,
    ) -> Result<ControlFlow<()>, Error> {
        if rollout.ended {
            return Ok(ControlFlow::Continue(()));
        }
        if self.deterministic {
            row.disturb_command(self.noise, &mut self.running[index].rng);
        }
        let step = rollout.step(row);
        rollout.environment.position_errors(&mut self.errors);
        let Running { start, rewards, tracking, .. } = &mut self.running[index];
        rewards.push(step.reward_terms.iter().sum());
        tracking.add(&self.errors);
        let mut flow = ControlFlow::Continue(());
        if step.outcome != Outcome::Diverged {
            flow = self.audience.watch(start.number, &mut rollout.environment, Some(&step))?;
        }
        if rollout.ended {
            self.finish(index, rollout, step.outcome);
            if flow.is_continue() {
                flow = self.begin_next(index, rollout, row)?;
            }
        }
        Ok(flow)
    }
}

#[cfg(test)]
mod tests {
    use comic_proto::Field;
    use comic_tasks::{Achievement, Episode, MAX_REWARD_TERMS};

    use super::*;
    use crate::forward_pass::ActingBatch;

    const SHAPE: UnrollShape = UnrollShape {
        length: 1,
        proprioception: 1,
        task: 0,
        latent: 1,
        action: 2,
        reward_terms: 1,
        image: 0,
        components: 1,
        state: 0,
        action_gradient: 0,
    };

    /// Falls after three steps when it starts at an odd frame; pays 1 a step for an action of exactly 0.25.
    #[derive(Debug)]
    struct Fixed {
        start: usize,
        step: usize,
    }

    impl Environment for Fixed {
        fn reset(&mut self) {}
        fn reset_to(&mut self, _clip: usize, start: usize) -> Result<(), comic_tasks::Error> {
            (self.start, self.step) = (start, 0);
            Ok(())
        }
        fn step(&mut self, action: &[f32]) -> Step {
            self.step += 1;
            let mut reward_terms = [0.0; MAX_REWARD_TERMS];
            reward_terms[0] = if action[0] == 0.25 { 1.0 } else { 0.0 };
            let (discount, outcome) = match (self.start % 2, self.step) {
                (1, 3) => (0.0, Outcome::Terminated),
                (_, 10) => (1.0, Outcome::Truncated),
                _ => (1.0, Outcome::Running),
            };
            Step { reward_terms, discount, outcome, head_height: 1.5 }
        }
        fn observe(&self, proprioception: &mut [f32], _task: &mut [f32]) {
            proprioception[0] = self.step as f32;
        }
        fn draw(&mut self, _image: &mut [u8]) -> Result<(), comic_tasks::Error> {
            Ok(())
        }
        fn episode(&self) -> Episode {
            Episode { clip: 0, start: self.start, steps_left: 10, task: 0 }
        }
        fn achievement(&self) -> Achievement {
            Achievement::new(self.step == 10)
        }
        fn servo_action(&self, action: &mut [f32]) {
            action.fill(0.25);
        }
    }

    struct Quarter;

    impl ForwardPass for Quarter {
        fn load(&mut self, _parameters: &[u8]) -> Result<(), Error> {
            Ok(())
        }
        fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
            assert!(batch[Field::LatentNoise].iter().all(|noise| *noise == 0.0), "the latent's mean has no noise");
            let previous = batch[Field::PreviousLatent].to_vec();
            assert_eq!(previous, batch[Field::Proprioception], "the latent of the step before, 0 at the first");
            for (latent, previous) in batch.latent.iter_mut().zip(previous) {
                *latent = previous + 1.0;
            }
            batch[Field::Mean].fill(0.25);
            batch[Field::Std].fill(9.0);
            Ok(())
        }
    }

    fn episodes(controller: &mut Controller<'_, Quarter>, environments: usize) -> Vec<(usize, usize, f64)> {
        let environments = (0..environments).map(|_| Fixed { start: 0, step: 0 }).collect();
        let starts = Start::numbered((0..7).map(|start| (0, start)));
        let options = RolloutSettings { deterministic: true, ..RolloutSettings::default() };
        let finished = run(controller, environments, &SHAPE, &starts, &options, &mut |_: usize, _: usize| ()).unwrap();
        assert!(finished.iter().all(|episode| episode.achievement.success == (episode.steps() == 10)));
        let mut found: Vec<_> = finished.iter().map(|e| (e.steps(), e.steps_left, e.returns[0])).collect();
        found.sort_by(|a, b| a.partial_cmp(b).unwrap());
        found
    }

    #[test]
    fn every_start_is_rolled_out_to_its_end_whatever_the_number_of_environments() {
        let (fallen, whole) = ((3, 10, 3.0), (10, 10, 10.0));
        let expected = [fallen, fallen, fallen, whole, whole, whole, whole];
        for environments in [1, 2] {
            assert_eq!(episodes(&mut Controller::Servo, environments), expected);
        }
        // One environment at a time, or the latents' law could not be read off the steps.
        assert_eq!(episodes(&mut Controller::Policy(&mut Quarter), 1), expected);
    }

    /// Records what it watches, and breaks after `patience` calls.
    struct Spectator {
        watched: Vec<(usize, usize)>,
        patience: usize,
    }

    impl Audience<Fixed> for Spectator {
        fn watch(
            &mut self,
            number: usize,
            environment: &mut Fixed,
            step: Option<&Step>,
        ) -> Result<ControlFlow<()>, Error> {
            assert_eq!(step.is_some(), environment.step > 0, "the begin of an episode is no step");
            self.watched.push((number, environment.step));
            Ok(if self.watched.len() < self.patience { ControlFlow::Continue(()) } else { ControlFlow::Break(()) })
        }

        fn count(&mut self, _: usize, _: usize) {}
    }

    #[test]
    fn the_audience_watches_every_state_of_every_episode_and_may_break_at_any() {
        let starts = Start::numbered([1, 3, 2].map(|start| (0, start)));
        let steps = |number, last| (0..=last).map(move |step| (number, step));
        let all: Vec<_> = steps(0, 3).chain(steps(1, 3)).chain(steps(2, 10)).collect();
        for (patience, episodes) in [(1, 0), (3, 0), (4, 1), (5, 1), (8, 2), (100, 3)] {
            let mut spectator = Spectator { watched: Vec::new(), patience };
            let (environments, options) = (vec![Fixed { start: 0, step: 0 }], RolloutSettings::default());
            let finished =
                run(&mut Controller::<Quarter>::Zero, environments, &SHAPE, &starts, &options, &mut spectator).unwrap();
            assert_eq!(spectator.watched, all[..patience.min(all.len())]);
            assert_eq!(finished.len(), episodes, "{patience}");
            assert!(finished.iter().all(|episode| episode.returns[0] == 0.0), "the action was not 0");
        }
    }
}
