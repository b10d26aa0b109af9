//! One environment of a worker and the unroll it is filling.

use bytes::Bytes;
use comic_proto::v1::{EpisodeEnd, EpisodeStatistics};
use comic_proto::{Field, UnrollBuffer, UnrollLayout};
use comic_tasks::{Environment, Episode, MAX_REWARD_TERMS, Outcome};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use crate::Error;
use crate::acting::{ActingRow, clip_action};
use crate::seeds::EnvironmentSeeds;

#[derive(Debug)]
pub(super) struct Lane<E> {
    environment: E,
    number: u32,
    /// Of its own noise, so that no other environment has a part in it.
    rng: Pcg64,
    unroll: UnrollBuffer,
    /// The current observation is its episode's first.
    first: bool,
    /// The current observation is its episode's last: no action follows it.
    ended: bool,
    episode: Episode,
    /// The task of the current unroll, which is that of its first row; an episode of another waits for the next unroll.
    task: usize,
    /// Steps and sums of the reward terms since the episode began.
    steps: u32,
    returns: [f64; MAX_REWARD_TERMS],
    /// Sum of the head's heights, m.
    head_heights: f64,
    /// Episodes that ended in the current unroll.
    finished: Vec<EpisodeStatistics>,
    /// Scratch: the action that the simulator sees.
    clipped: Vec<f32>,
}

impl<E: Environment> Lane<E> {
    /// Resets the environment; its noise comes from `seed` and its number.
    pub(super) fn new(
        mut environment: E,
        number: u32,
        seed: u64,
        layout: &UnrollLayout,
        row: &mut ActingRow<'_>,
    ) -> Self {
        environment.reset();
        let episode = environment.episode();
        let lane = Self {
            environment,
            number,
            rng: Pcg64::seed_from_u64(EnvironmentSeeds::new(seed, number).noise),
            unroll: UnrollBuffer::new(layout),
            first: true,
            ended: false,
            episode,
            task: episode.task,
            steps: 0,
            returns: [0.0; MAX_REWARD_TERMS],
            head_heights: 0.0,
            finished: Vec::new(),
            clipped: vec![0.0; layout.shape().action],
        };
        lane.observe(row);
        lane
    }

    /// The environment's number.
    pub(super) fn number(&self) -> u32 {
        self.number
    }

    /// Index of the task of the current unroll.
    pub(super) fn task(&self) -> u32 {
        self.task as u32
    }

    /// Draws the latent's noise of the coming step.
    pub(super) fn draw_latent_noise(&mut self, row: &mut ActingRow<'_>) {
        row.draw_latent_noise(&mut self.rng);
    }

    /// Whether the current observation is an episode's last.
    pub(super) fn at_episode_end(&self) -> bool {
        self.ended
    }

    /// Whether the current observation begins an episode that is of another task than this unroll.
    pub(super) fn waits(&self) -> bool {
        self.episode.task != self.task
    }

    /// The current observation as row `t`. What it looks like is drawn here, once for the row and once for acting.
    pub(super) fn write_observation(&mut self, t: usize, row: &mut ActingRow<'_>) -> Result<(), Error> {
        if t == 0 {
            self.task = self.episode.task;
            self.unroll.row_mut(Field::State, 0).copy_from_slice(row.state);
        }
        if self.waits() {
            self.unroll.repeat_observation(t);
            return Ok(());
        }
        self.environment.draw(row.image)?;
        self.unroll.image_mut(t).copy_from_slice(row.image);
        self.unroll.row_mut(Field::Proprioception, t).copy_from_slice(row.proprioception);
        self.unroll.row_mut(Field::Task, t).copy_from_slice(row.task);
        self.unroll.row_mut(Field::First, t)[0] = f32::from(u8::from(self.first));
        self.unroll.set_clip(t, self.episode.clip as u32);
        Ok(())
    }

    /// A transition: samples the action, writes row `t`, steps, observes.
    pub(super) fn step(&mut self, t: usize, row: &mut ActingRow<'_>) {
        self.write_decision(t, row);
        let action = self.unroll.row_mut(Field::Action, t);
        row.sample(action, &mut self.rng);
        clip_action(action, &mut self.clipped);
        let step = self.environment.step(&self.clipped);
        let reward = self.unroll.row_mut(Field::Reward, t);
        for (reward, term) in reward.iter_mut().zip(&step.reward_terms) {
            *reward = *term as f32;
        }
        self.unroll.row_mut(Field::Discount, t)[0] = step.discount as f32;
        self.unroll.row_mut(Field::Valid, t)[0] = 1.0;

        self.first = false;
        self.steps += 1;
        for (sum, term) in self.returns.iter_mut().zip(&step.reward_terms) {
            *sum += term;
        }
        self.head_heights += step.head_height;
        row.previous_latent.copy_from_slice(row.latent);
        self.observe(row);
        self.end(step.outcome);
    }

    /// Row `t` is an episode's last observation: no action, no reward, and a discount of 0 for whoever forgets the
    /// mask. The decision stands there all the same, since a distribution without a deviation is none.
    pub(super) fn pass(&mut self, t: usize, row: &ActingRow<'_>) {
        self.write_decision(t, row);
        self.unroll.row_mut(Field::Action, t).copy_from_slice(row.mode());
        self.unroll.row_mut(Field::Reward, t).fill(0.0);
        self.unroll.row_mut(Field::Discount, t)[0] = 0.0;
        self.unroll.row_mut(Field::Valid, t)[0] = 0.0;
    }

    /// Resets the environment; the current observation becomes the new episode's first.
    pub(super) fn begin_episode(&mut self, row: &mut ActingRow<'_>) {
        self.environment.reset();
        self.episode = self.environment.episode();
        self.first = true;
        self.ended = false;
        self.steps = 0;
        self.returns = [0.0; MAX_REWARD_TERMS];
        self.head_heights = 0.0;
        row.forget();
        self.observe(row);
    }

    /// The full unroll and the episodes that ended in it; an empty one takes its place.
    pub(super) fn take_unroll(&mut self, layout: &UnrollLayout) -> (Bytes, Vec<EpisodeStatistics>) {
        let full = std::mem::replace(&mut self.unroll, UnrollBuffer::new(layout));
        (full.into_bytes(), std::mem::take(&mut self.finished))
    }

    /// The pose of the next reference frame as an action; mid-range where no action follows.
    pub(super) fn servo_action(&self, action: &mut [f32]) {
        if self.ended {
            action.fill(0.0);
        } else {
            self.environment.servo_action(action);
        }
    }

    fn observe(&self, row: &mut ActingRow<'_>) {
        self.environment.observe(row.proprioception, row.task);
        *row.of_task = self.episode.task;
    }

    fn write_decision(&mut self, t: usize, row: &ActingRow<'_>) {
        self.unroll.row_mut(Field::PreviousLatent, t).copy_from_slice(row.previous_latent);
        self.unroll.row_mut(Field::LatentNoise, t).copy_from_slice(row.latent_noise);
        self.unroll.row_mut(Field::Mean, t).copy_from_slice(row.mean);
        self.unroll.row_mut(Field::Std, t).copy_from_slice(row.std);
        self.unroll.row_mut(Field::LogWeights, t).copy_from_slice(row.log_weights);
    }

    /// Keeps the episode's statistics if it is over.
    fn end(&mut self, outcome: Outcome) {
        let end = match outcome {
            Outcome::Running => return,
            Outcome::Terminated => EpisodeEnd::Terminated,
            Outcome::Truncated => EpisodeEnd::Truncated,
            Outcome::Diverged => EpisodeEnd::Diverged,
        };
        self.ended = true;
        let terms = self.unroll.row_mut(Field::Reward, 0).len();
        self.finished.push(EpisodeStatistics {
            clip: self.episode.clip as u32,
            steps: self.steps,
            steps_left_at_start: self.episode.steps_left as u32,
            returns: self.returns.iter().take(terms).map(|sum| *sum as f32).collect(),
            end: end.into(),
            head_height: Some((self.head_heights / f64::from(self.steps.max(1))) as f32),
        });
    }
}
