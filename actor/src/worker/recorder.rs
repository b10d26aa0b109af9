//! Writes what the environments of a worker do into their unrolls.

use std::ops::ControlFlow;
use std::sync::Arc;

use bytes::Bytes;
use comic_experiment::LARGEST_ACTION_GRADIENT;
use comic_proto::v1::{EpisodeEnd, EpisodeStatistics};
use comic_proto::{Field, UnrollBuffer, UnrollLayout};
use comic_tasks::{Environment, Outcome};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use crate::Error;
use crate::acting_loop::{Recorder, Rollout};
use crate::forward_pass::{ActingRow, Actuated, ForwardPass, LowLevelShape};
use crate::seeds::EnvironmentSeeds;

/// The unrolls of all environments of a worker, filled row by row.
#[derive(Debug)]
pub(super) struct UnrollRecorder {
    layout: Arc<UnrollLayout>,
    unrolls: Vec<OpenUnroll>,
    /// The row that is written now.
    pub(super) t: usize,
    /// Transitions recorded in the current iteration.
    pub(super) steps: u64,
    /// Episodes that ended in the current iteration.
    pub(super) episodes: u64,
}

/// The unroll that one environment fills.
#[derive(Debug)]
struct OpenUnroll {
    /// Noise of this environment only, so that other environments cannot change it.
    rng: Pcg64,
    buffer: UnrollBuffer,
    /// The recurrent state that a frozen low level read in each row, `[T, S]`; empty if no derivative goes through it.
    low_level_states: Vec<f32>,
    /// The task of the unroll: that of its first row. An episode of another task waits for the next unroll.
    task: usize,
    /// Episodes that ended in this unroll.
    episodes: Vec<EpisodeStatistics>,
}

/// What a full unroll holds.
pub(super) struct RecordedUnroll {
    pub(super) payload: Bytes,
    pub(super) episodes: Vec<EpisodeStatistics>,
    pub(super) task: u32,
}

impl UnrollRecorder {
    /// Empty unrolls of environments with these numbers; `seed` and the number decide an environment's noise.
    /// `low_level` is the frozen low level that acts, if any.
    pub(super) fn new(
        layout: Arc<UnrollLayout>,
        low_level: Option<LowLevelShape>,
        numbers: impl Iterator<Item = u32>,
        seed: u64,
    ) -> Self {
        let shape = layout.shape();
        let goes_back = shape.action_gradient > 0;
        let states = low_level.filter(|_| goes_back).map_or(0, |low_level| shape.length * low_level.state);
        let open = |number| OpenUnroll {
            rng: Pcg64::seed_from_u64(EnvironmentSeeds::new(seed, number).noise),
            buffer: UnrollBuffer::new(&layout),
            low_level_states: vec![0.0; states],
            task: 0,
            episodes: Vec::new(),
        };
        Self { unrolls: numbers.map(open).collect(), layout, t: 0, steps: 0, episodes: 0 }
    }

    /// Writes the derivatives with respect to the actions of an environment's unroll. `gradients` are those with respect to the
    /// commands, one for each transition, in their order. A task without derivatives has none, and the rows stay 0.
    ///
    /// # Errors
    /// [`Error::Derivatives`]: there is not one for each transition. A low level that fails.
    pub(super) fn write_gradients(
        &mut self,
        index: usize,
        gradients: &[[f32; 56]],
        forward: &mut impl ForwardPass,
    ) -> Result<(), Error> {
        if gradients.is_empty() {
            return Ok(());
        }
        let OpenUnroll { buffer, low_level_states, .. } = &mut self.unrolls[index];
        let shape = *buffer.layout().shape();
        let transitions: Vec<usize> = (0..shape.length).filter(|t| buffer.row(Field::Valid, *t)[0] == 1.0).collect();
        if transitions.len() != gradients.len() {
            return Err(Error::Derivatives { transitions: transitions.len(), derivatives: gradients.len() });
        }
        let of = |field| transitions.iter().flat_map(|t| buffer.row(field, *t)).copied().collect();
        let state = low_level_states.len() / shape.length.max(1);
        let states = transitions.iter().flat_map(|t| &low_level_states[t * state..(t + 1) * state]);
        let actuated = Actuated {
            steps: transitions.len(),
            action: of(Field::Action),
            proprioception: of(Field::Proprioception),
            low_level_state: states.copied().collect(),
            derivatives: gradients.as_flattened().to_vec(),
        };
        let found = forward.action_derivatives(actuated)?;
        if found.len() != transitions.len() * shape.action_gradient {
            let derivatives = found.len() / shape.action_gradient.max(1);
            return Err(Error::Derivatives { transitions: transitions.len(), derivatives });
        }
        for (t, row) in transitions.into_iter().zip(found.chunks_exact(shape.action_gradient.max(1))) {
            // A low level can make a derivative larger than the wire takes.
            if row.iter().all(|entry| entry.abs() <= LARGEST_ACTION_GRADIENT) {
                buffer.row_mut(Field::ActionGradient, t).copy_from_slice(row);
            }
        }
        Ok(())
    }

    /// The full unroll of an environment. An empty one replaces it.
    pub(super) fn take(&mut self, index: usize) -> RecordedUnroll {
        let unroll = &mut self.unrolls[index];
        let full = std::mem::replace(&mut unroll.buffer, UnrollBuffer::new(&self.layout));
        let episodes = std::mem::take(&mut unroll.episodes);
        RecordedUnroll { payload: full.into_bytes(), episodes, task: unroll.task as u32 }
    }
}

impl<E: Environment> Recorder<E> for UnrollRecorder {
    /// Writes the current observation as row `t`. The camera image is drawn here, once for the row and for acting.
    fn observe(&mut self, index: usize, rollout: &mut Rollout<E>, row: &mut ActingRow<'_>) -> Result<(), Error> {
        let (OpenUnroll { buffer, task, .. }, t) = (&mut self.unrolls[index], self.t);
        if t == 0 {
            *task = rollout.episode.task;
            buffer.row_mut(Field::State, 0).copy_from_slice(&row[Field::State]);
        }
        if rollout.episode.task != *task {
            buffer.repeat_observation(t);
            return Ok(());
        }
        rollout.environment.draw(row.image)?;
        buffer.image_mut(t).copy_from_slice(row.image);
        for field in [Field::Proprioception, Field::Task] {
            buffer.row_mut(field, t).copy_from_slice(&row[field]);
        }
        buffer.row_mut(Field::First, t)[0] = f32::from(u8::from(rollout.steps == 0));
        buffer.set_clip(t, rollout.episode.clip as u32);
        Ok(())
    }

    fn draw_latent_noise(&mut self, index: usize, row: &mut ActingRow<'_>) {
        row.draw_latent_noise(&mut self.unrolls[index].rng);
    }

    fn choose(&mut self, index: usize, rollout: &Rollout<E>, row: &mut ActingRow<'_>) {
        let unroll = &mut self.unrolls[index];
        if rollout.episode.task == unroll.task && !rollout.ended {
            row.sample(&mut unroll.rng);
            // The low level replaces it when it acts.
            if !unroll.low_level_states.is_empty() {
                let state = row.low_level_state.len();
                unroll.low_level_states[self.t * state..][..state].copy_from_slice(row.low_level_state);
            }
        }
    }

    fn step(
        &mut self,
        index: usize,
        rollout: &mut Rollout<E>,
        row: &mut ActingRow<'_>,
    ) -> Result<ControlFlow<()>, Error> {
        let (unroll, t) = (&mut self.unrolls[index], self.t);
        if rollout.episode.task != unroll.task {
            // An episode of another task waits: the row stays padding.
            row.reset_recurrent_state();
        } else if rollout.ended {
            unroll.write_last_observation(t, row);
            rollout.environment.reset();
            rollout.begin_episode(row);
        } else {
            unroll.write_transition(t, rollout, row);
            self.steps += 1;
            self.episodes += u64::from(rollout.ended);
        }
        Ok(ControlFlow::Continue(()))
    }
}

impl OpenUnroll {
    /// Takes a step, and writes it with the chosen action as row `t`.
    fn write_transition<E: Environment>(&mut self, t: usize, rollout: &mut Rollout<E>, row: &mut ActingRow<'_>) {
        self.write_distribution(t, row);
        self.buffer.row_mut(Field::Action, t).copy_from_slice(row.action);
        let step = rollout.step(row);
        let reward = self.buffer.row_mut(Field::Reward, t);
        for (reward, term) in reward.iter_mut().zip(&step.reward_terms) {
            *reward = *term as f32;
        }
        self.buffer.row_mut(Field::Discount, t)[0] = step.discount as f32;
        self.buffer.row_mut(Field::Valid, t)[0] = 1.0;
        self.end_episode(rollout, step.outcome);
    }

    /// Row `t` is an episode's last observation: it has no action and no reward, and its discount is 0 for a reader that
    /// ignores `Valid`. It has a distribution and an action all the same, since zeros as deviations would be invalid.
    fn write_last_observation(&mut self, t: usize, row: &ActingRow<'_>) {
        self.write_distribution(t, row);
        self.buffer.row_mut(Field::Action, t).copy_from_slice(row.mode());
        self.buffer.row_mut(Field::Reward, t).fill(0.0);
        self.buffer.row_mut(Field::Discount, t)[0] = 0.0;
        self.buffer.row_mut(Field::Valid, t)[0] = 0.0;
    }

    fn write_distribution(&mut self, t: usize, row: &ActingRow<'_>) {
        for field in [Field::PreviousLatent, Field::LatentNoise, Field::Mean, Field::Std, Field::LogWeights] {
            self.buffer.row_mut(field, t).copy_from_slice(&row[field]);
        }
    }

    /// Keeps the statistics of an episode that is over.
    fn end_episode<E>(&mut self, rollout: &Rollout<E>, outcome: Outcome) {
        let end = match outcome {
            Outcome::Running => return,
            Outcome::Terminated => EpisodeEnd::Terminated,
            Outcome::Truncated => EpisodeEnd::Truncated,
            Outcome::Diverged => EpisodeEnd::Diverged,
        };
        let terms = self.buffer.layout().shape().reward_terms;
        self.episodes.push(EpisodeStatistics {
            clip: rollout.episode.clip as u32,
            steps: rollout.steps,
            steps_left_at_start: rollout.episode.steps_left as u32,
            returns: rollout.returns.iter().take(terms).map(|sum| *sum as f32).collect(),
            end: end.into(),
            head_height: Some((rollout.head_heights / f64::from(rollout.steps.max(1))) as f32),
        });
    }
}
