//! Rolling out a list of starts, many environments in one forward pass.

use std::ops::ControlFlow;

use comic_tasks::{Environment, MAX_REWARD_TERMS, Outcome};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use super::{Finished, Options};
use crate::Error;
use crate::acting::{ActingBatch, ActingSizes, ForwardPass, clip_action};

/// Whose actions are evaluated.
#[derive(Debug)]
pub enum Evaluated<'a, F> {
    /// A policy's.
    Policy(&'a mut F),
    /// The servo action: the pose of the next reference frame, without noise.
    Servo,
    /// The zero action: every servo aims at the middle of its joint's range.
    Zero,
}

/// Whoever follows a rollout: to show how far it is, or to film it.
pub trait Audience<E> {
    /// An episode has begun or gone a step, and has not diverged; `number` is the place of its start among all. To
    /// break ends the rollout.
    ///
    /// # Errors
    /// Whatever ends the rollout with it.
    fn watch(&mut self, number: usize, environment: &mut E) -> Result<ControlFlow<()>, Error> {
        let _ = (number, environment);
        Ok(ControlFlow::Continue(()))
    }

    /// So many episodes of so many are over.
    fn count(&mut self, done: usize, all: usize);
}

/// One that only counts.
impl<E, F: FnMut(usize, usize)> Audience<E> for F {
    fn count(&mut self, done: usize, all: usize) {
        self(done, all);
    }
}

/// Where an episode starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Start {
    /// The clip's index.
    pub clip: usize,
    /// Frame within the clip.
    pub start: usize,
}

/// An environment, and the episode it is in.
struct Lane<E> {
    environment: E,
    episode: Option<Finished>,
    /// The place of the episode's start among all.
    number: usize,
}

/// Rolls out every start, or until the audience has seen enough; episodes come back in the order they end.
pub(super) fn run<E: Environment, F: ForwardPass>(
    evaluated: &mut Evaluated<'_, F>,
    environments: Vec<E>,
    sizes: ActingSizes,
    starts: &[Start],
    options: &Options,
    audience: &mut dyn Audience<E>,
) -> Result<Vec<Finished>, Error> {
    let mut rng = Pcg64::seed_from_u64(options.seed);
    let mut batch = ActingBatch::new(environments.len(), sizes);
    let mut lanes: Vec<Lane<E>> =
        environments.into_iter().map(|environment| Lane { environment, episode: None, number: 0 }).collect();
    let mut queue = starts.iter().copied().enumerate();
    let mut finished = Vec::with_capacity(starts.len());
    let mut scratch = (vec![0.0; sizes.action], vec![0.0; sizes.action]);
    for (index, lane) in lanes.iter_mut().enumerate() {
        if lane.begin(queue.next(), &mut batch, index, audience)?.is_break() {
            return Ok(finished);
        }
    }
    while lanes.iter().any(|lane| lane.episode.is_some()) {
        for (index, lane) in lanes.iter_mut().enumerate().filter(|(_, lane)| lane.episode.is_some()) {
            lane.environment.draw(batch.row(index).image)?;
        }
        act(evaluated, &lanes, &mut batch, options, &mut rng)?;
        for (index, lane) in lanes.iter_mut().enumerate().filter(|(_, lane)| lane.episode.is_some()) {
            let ended = lane.step(&mut batch, index, options, &mut rng, &mut scratch);
            let mut seen = ControlFlow::Continue(());
            if !ended.as_ref().is_some_and(|episode| episode.diverged) {
                seen = audience.watch(lane.number, &mut lane.environment)?;
            }
            if let Some(episode) = ended {
                finished.push(episode);
                audience.count(finished.len(), starts.len());
                if seen.is_continue() {
                    seen = lane.begin(queue.next(), &mut batch, index, audience)?;
                }
            }
            if seen.is_break() {
                return Ok(finished);
            }
        }
    }
    Ok(finished)
}

fn act<E: Environment, F: ForwardPass>(
    evaluated: &mut Evaluated<'_, F>,
    lanes: &[Lane<E>],
    batch: &mut ActingBatch,
    options: &Options,
    rng: &mut Pcg64,
) -> Result<(), Error> {
    // Without noise the latent is its mean.
    if !options.deterministic {
        batch.draw_latent_noise(rng);
    }
    match evaluated {
        Evaluated::Policy(forward) => forward.forward(batch),
        Evaluated::Servo => {
            for (index, lane) in lanes.iter().enumerate().filter(|(_, lane)| lane.episode.is_some()) {
                batch.row(index).decide(|mean| lane.environment.servo_action(mean), 0.0);
            }
            Ok(())
        }
        Evaluated::Zero => {
            for index in 0..lanes.len() {
                batch.row(index).decide(|mean| mean.fill(0.0), 0.0);
            }
            Ok(())
        }
    }
}

impl<E: Environment> Lane<E> {
    fn begin(
        &mut self,
        start: Option<(usize, Start)>,
        batch: &mut ActingBatch,
        index: usize,
        audience: &mut dyn Audience<E>,
    ) -> Result<ControlFlow<()>, Error> {
        self.episode = None;
        let Some((number, start)) = start else { return Ok(ControlFlow::Continue(())) };
        self.number = number;
        self.environment.reset_to(start.clip, start.start)?;
        let mut row = batch.row(index);
        self.environment.observe(row.proprioception, row.task);
        row.forget();
        let episode = self.environment.episode();
        *row.of_task = episode.task;
        let steps_left = episode.steps_left;
        self.episode = Some(Finished {
            clip: start.clip,
            start: start.start,
            steps_left,
            rewards: Vec::new(),
            returns: [0.0; MAX_REWARD_TERMS],
            head_heights: 0.0,
            diverged: false,
        });
        audience.watch(number, &mut self.environment)
    }

    /// One step; the episode if it is over.
    fn step(
        &mut self,
        batch: &mut ActingBatch,
        index: usize,
        options: &Options,
        rng: &mut Pcg64,
        (sampled, clipped): &mut (Vec<f32>, Vec<f32>),
    ) -> Option<Finished> {
        let episode = self.episode.as_mut()?;
        let row = batch.row(index);
        if options.deterministic {
            sampled.copy_from_slice(row.mode());
        } else {
            row.sample(sampled, rng);
        }
        clip_action(sampled, clipped);
        let step = self.environment.step(clipped);
        episode.rewards.push(step.reward_terms.iter().sum());
        for (sum, term) in episode.returns.iter_mut().zip(&step.reward_terms) {
            *sum += term;
        }
        episode.head_heights += step.head_height;
        episode.diverged = step.outcome == Outcome::Diverged;
        row.previous_latent.copy_from_slice(row.latent);
        self.environment.observe(row.proprioception, row.task);
        if step.outcome == Outcome::Running { None } else { self.episode.take() }
    }
}

#[cfg(test)]
mod tests {
    use comic_tasks::{Episode, Step};

    use super::*;

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
            assert!(batch.latent_noise.iter().all(|noise| *noise == 0.0), "the latent's mean has no noise");
            let steps = batch.proprioception.clone();
            for (previous, step) in batch.previous_latent.iter().zip(steps) {
                assert_eq!(*previous, step, "the latent of the step before, 0 at the first");
            }
            for (latent, previous) in batch.latent.iter_mut().zip(&batch.previous_latent) {
                *latent = previous + 1.0;
            }
            batch.mean.fill(0.25);
            batch.std.fill(9.0);
            Ok(())
        }
    }

    fn episodes(evaluated: &mut Evaluated<'_, Quarter>, environments: usize) -> Vec<(usize, usize, f64)> {
        let environments = (0..environments).map(|_| Fixed { start: 0, step: 0 }).collect();
        let starts: Vec<Start> = (0..7).map(|start| Start { clip: 0, start }).collect();
        let options = Options { deterministic: true, ..Options::default() };
        let sizes = ActingSizes { proprioception: 1, task: 0, latent: 1, action: 2, image: 0, components: 1, state: 0 };
        let finished = run(evaluated, environments, sizes, &starts, &options, &mut |_: usize, _: usize| ()).unwrap();
        let mut found: Vec<_> = finished.iter().map(|e| (e.steps(), e.steps_left, e.returns[0])).collect();
        found.sort_by(|a, b| a.partial_cmp(b).unwrap());
        found
    }

    #[test]
    fn every_start_is_rolled_out_to_its_end_whatever_the_number_of_environments() {
        let (fallen, whole) = ((3, 10, 3.0), (10, 10, 10.0));
        let expected = [fallen, fallen, fallen, whole, whole, whole, whole];
        for environments in [1, 2] {
            assert_eq!(episodes(&mut Evaluated::Servo, environments), expected);
        }
        // One environment at a time, or the latents' law could not be read off the steps.
        assert_eq!(episodes(&mut Evaluated::Policy(&mut Quarter), 1), expected);
    }

    /// Notes what it sees, and leaves after so many looks.
    struct Spectator {
        seen: Vec<(usize, usize)>,
        patience: usize,
    }

    impl Audience<Fixed> for Spectator {
        fn watch(&mut self, number: usize, environment: &mut Fixed) -> Result<ControlFlow<()>, Error> {
            self.seen.push((number, environment.step));
            Ok(if self.seen.len() < self.patience { ControlFlow::Continue(()) } else { ControlFlow::Break(()) })
        }

        fn count(&mut self, _: usize, _: usize) {}
    }

    #[test]
    fn the_audience_sees_every_state_of_every_episode_and_may_leave_at_any() {
        let starts = [1, 3, 2].map(|start| Start { clip: 0, start });
        let sizes = ActingSizes { proprioception: 1, task: 0, latent: 1, action: 2, image: 0, components: 1, state: 0 };
        let steps = |number, last| (0..=last).map(move |step| (number, step));
        let all: Vec<_> = steps(0, 3).chain(steps(1, 3)).chain(steps(2, 10)).collect();
        for (patience, episodes) in [(1, 0), (3, 0), (4, 1), (5, 1), (8, 2), (100, 3)] {
            let mut spectator = Spectator { seen: Vec::new(), patience };
            let (environments, options) = (vec![Fixed { start: 0, step: 0 }], Options::default());
            let finished =
                run(&mut Evaluated::<Quarter>::Zero, environments, sizes, &starts, &options, &mut spectator).unwrap();
            assert_eq!(spectator.seen, all[..patience.min(all.len())]);
            assert_eq!(finished.len(), episodes, "{patience}");
            assert!(finished.iter().all(|episode| episode.returns[0] == 0.0), "the action was not 0");
        }
    }
}
