//! The rows of unrolls, with an environment and a policy that count episodes and steps.

use comic_proto::{Field, UnrollShape};
use comic_tasks::{Achievement, Episode, MAX_REWARD_TERMS, Outcome, Step};
use proptest::prelude::*;

use super::*;
use crate::forward_pass::ActingBatch;

mod derivatives;
mod running;
mod transfer;

/// An observation names its episode and its step, so a row can be recognised; episode k lasts `lengths[k]` steps.
#[derive(Debug)]
struct Counter {
    lengths: Vec<usize>,
    /// The task of each episode, in turn; its clip is the same number.
    tasks: Vec<usize>,
    /// Counted from 1 after the first reset.
    episodes: usize,
    step: usize,
    last_action: f32,
    /// Derivatives for each unroll, of any number.
    derivatives: usize,
}

impl Counter {
    fn new(lengths: &[usize]) -> Self {
        let lengths = lengths.to_vec();
        Self { lengths, tasks: Vec::new(), episodes: 0, step: 0, last_action: 0.0, derivatives: 0 }
    }
    fn task(&self) -> usize {
        if self.tasks.is_empty() { 0 } else { self.tasks[(self.episodes - 1) % self.tasks.len()] }
    }
    fn length(&self) -> usize {
        self.lengths[(self.episodes - 1) % self.lengths.len()]
    }
}

impl Environment for Counter {
    fn reset(&mut self) {
        self.episodes += 1;
        self.step = 0;
    }
    fn reset_to(&mut self, _clip: usize, _start: usize) -> Result<(), comic_tasks::Error> {
        Ok(())
    }
    fn take_gradients(&mut self) -> Vec<[f32; 56]> {
        (1..=self.derivatives).map(|number| [number as f32; 56]).collect()
    }
    fn step(&mut self, action: &[f32]) -> Step {
        assert!(self.step < self.length(), "an episode was stepped beyond its end");
        assert!(action.iter().all(|value| (-1.0..=1.0).contains(value)), "the simulator saw an unclipped action");
        self.last_action = action[0];
        self.step += 1;
        let mut reward_terms = [0.0; MAX_REWARD_TERMS];
        reward_terms[0] = 1.0;
        reward_terms[1] = self.step as f64;
        let ended = self.step == self.length();
        let (discount, outcome) = match (ended, self.episodes % 3) {
            (false, _) => (1.0, Outcome::Running),
            (true, 0) => (0.0, Outcome::Terminated),
            (true, 1) => (1.0, Outcome::Truncated),
            (true, _) => (0.0, Outcome::Diverged),
        };
        Step { reward_terms, discount, outcome, head_height: self.step as f64 }
    }
    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]) {
        proprioception.copy_from_slice(&[self.episodes as f32, self.step as f32]);
        task.fill(self.last_action);
    }
    fn draw(&mut self, _image: &mut [u8]) -> Result<(), comic_tasks::Error> {
        Ok(())
    }
    fn episode(&self) -> Episode {
        let clip = if self.tasks.is_empty() { self.episodes % 2 } else { self.task() };
        Episode { clip, start: 0, steps_left: self.length(), task: self.task() }
    }
    fn achievement(&self) -> Achievement {
        Achievement::default()
    }
    fn servo_action(&self, action: &mut [f32]) {
        action.fill(self.step as f32 / 1000.0);
    }
}

/// The mean is the parameters' first byte. The latent counts the episode's steps (z_t = z_{t−1} + 1), and so does the
/// recurrent state.
#[derive(Debug, Default)]
struct Plain {
    parameter: f32,
}

impl ForwardPass for Plain {
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error> {
        self.parameter = f32::from(parameters[0]);
        Ok(())
    }
    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        let previous = batch[Field::PreviousLatent].to_vec();
        for (latent, previous) in batch.latent.iter_mut().zip(previous) {
            *latent = previous + 1.0;
        }
        batch[Field::State].iter_mut().for_each(|steps| *steps += 1.0);
        batch[Field::Mean].fill(self.parameter);
        batch[Field::Std].fill(0.5);
        Ok(())
    }
}

fn layout(length: usize) -> Arc<UnrollLayout> {
    Arc::new(UnrollLayout::new(UnrollShape {
        length,
        proprioception: 2,
        task: 1,
        action: 3,
        latent: 2,
        reward_terms: 2,
        image: 0,
        components: 1,
        state: 3,
        action_gradient: 0,
    }))
}

fn directive(version: u64) -> Arc<Directive> {
    Arc::new(Directive { learner_epoch: 7, version, parameters: Bytes::from(vec![version as u8]) })
}

/// Reads an unroll as the learner does, by the layout.
struct Rows<'a> {
    layout: &'a UnrollLayout,
    payload: &'a [u8],
}

impl Rows<'_> {
    fn row(&self, field: Field, t: usize) -> Vec<f32> {
        let width = self.layout.width(field);
        let bytes = &self.payload[self.layout.range(field)];
        bytes[t * width * 4..(t + 1) * width * 4]
            .chunks_exact(4)
            .map(|word| f32::from_le_bytes(word.try_into().unwrap()))
            .collect()
    }
    fn one(&self, field: Field, t: usize) -> f32 {
        self.row(field, t)[0]
    }
    fn clip(&self, t: usize) -> u32 {
        self.one(Field::Clip, t).to_bits()
    }
    /// Episode and step of the observation.
    fn place(&self, t: usize) -> (usize, usize) {
        let row = self.row(Field::Proprioception, t);
        (row[0] as usize, row[1] as usize)
    }
}

/// `unrolls` unrolls of environments with these episode lengths; `[environment][unroll]`.
fn record(length: usize, environments: &[Vec<usize>], unrolls: usize) -> (Arc<UnrollLayout>, Vec<Vec<FinishedUnroll>>) {
    record_from(0, length, environments, unrolls)
}

/// As [`record`], for environments that are numbered from `first` on.
fn record_from(
    first: u32,
    length: usize,
    environments: &[Vec<usize>],
    unrolls: usize,
) -> (Arc<UnrollLayout>, Vec<Vec<FinishedUnroll>>) {
    let layout = layout(length);
    let counters = environments.iter().map(|lengths| Counter::new(lengths)).collect();
    let mut worker = Worker::new(counters, Plain::default(), Arc::clone(&layout), first, 3).unwrap();
    worker.adopt(&directive(0)).unwrap();
    let mut recorded = vec![Vec::new(); environments.len()];
    for _ in 0..unrolls {
        let finished = worker.unroll(&|| false, &Progress::default()).unwrap().unwrap();
        for (own, unroll) in recorded.iter_mut().zip(finished) {
            own.push(unroll);
        }
    }
    (layout, recorded)
}

/// One environment's unrolls, whose episodes have these lengths and tasks.
fn record_tasks(length: usize, lengths: &[usize], tasks: &[usize]) -> (Arc<UnrollLayout>, Vec<FinishedUnroll>) {
    let layout = layout(length);
    let environment = Counter { tasks: tasks.to_vec(), ..Counter::new(lengths) };
    let mut worker = Worker::new(vec![environment], Plain::default(), Arc::clone(&layout), 0, 3).unwrap();
    worker.adopt(&directive(0)).unwrap();
    let unrolls = (0..12).flat_map(|_| worker.unroll(&|| false, &Progress::default()).unwrap().unwrap()).collect();
    (layout, unrolls)
}

fn episode_lengths() -> impl Strategy<Value = Vec<usize>> {
    prop::collection::vec(1_usize..12, 1..6)
}

proptest! {
    /// The valid rows in order hold every transition once, for all lengths of episodes and unrolls.
    #[test]
    fn every_transition_appears_exactly_once(
        length in 1_usize..10,
        environments in prop::collection::vec(episode_lengths(), 1..4),
    ) {
        let (layout, recorded) = record(length, &environments, 8);
        for (unrolls, lengths) in recorded.iter().zip(&environments) {
            let mut expected = (1, 0);
            for unroll in unrolls {
                let rows = Rows { layout: &layout, payload: &unroll.payload };
                for t in 0..length {
                    if rows.one(Field::Valid, t) == 0.0 {
                        continue;
                    }
                    prop_assert_eq!(rows.place(t), expected);
                    prop_assert_eq!(rows.place(t + 1), (expected.0, expected.1 + 1), "the next row is the outcome");
                    prop_assert_eq!(rows.one(Field::Reward, t), 1.0);
                    let over = expected.1 + 1 == lengths[(expected.0 - 1) % lengths.len()];
                    let discount = if over && expected.0 % 3 != 1 { 0.0 } else { 1.0 };
                    prop_assert_eq!(rows.one(Field::Discount, t), discount);
                    expected = if over { (expected.0 + 1, 0) } else { (expected.0, expected.1 + 1) };
                }
            }
        }
    }

    /// First[t+1] = 1 iff Valid[t] = 0; First[0] = 1 iff row 0 begins an episode; an invalid row has no reward.
    #[test]
    fn first_and_valid_mark_the_episode_boundaries(length in 1_usize..10, lengths in episode_lengths()) {
        let (layout, recorded) = record(length, std::slice::from_ref(&lengths), 8);
        for unroll in &recorded[0] {
            let rows = Rows { layout: &layout, payload: &unroll.payload };
            for t in 0..=length {
                let (episode, step) = rows.place(t);
                prop_assert_eq!(rows.one(Field::First, t) == 1.0, step == 0);
                prop_assert_eq!(rows.clip(t), (episode % 2) as u32);
                if t < length {
                    let valid = rows.one(Field::Valid, t) == 1.0;
                    prop_assert_eq!(rows.one(Field::First, t + 1) == 1.0, !valid);
                    prop_assert_eq!(valid, step < lengths[(episode - 1) % lengths.len()]);
                    prop_assert!(valid || (rows.one(Field::Reward, t) == 0.0 && rows.one(Field::Discount, t) == 0.0));
                }
            }
        }
    }

    /// Row 0 repeats row T of the unroll before. If that row was an episode's last, row 0 begins a new episode.
    #[test]
    fn the_next_unroll_continues(length in 1_usize..10, lengths in episode_lengths()) {
        let (layout, recorded) = record(length, std::slice::from_ref(&lengths), 8);
        for pair in recorded[0].windows(2) {
            let (before, after) = (
                Rows { layout: &layout, payload: &pair[0].payload },
                Rows { layout: &layout, payload: &pair[1].payload },
            );
            let (episode, step) = before.place(length);
            let over = step == lengths[(episode - 1) % lengths.len()];
            prop_assert_eq!(after.place(0), if over { (episode + 1, 0) } else { (episode, step) });
            if !over {
                prop_assert_eq!(before.row(Field::Task, length), after.row(Field::Task, 0));
            }
        }
    }

    /// The statistics of an episode are the sums over its valid rows.
    #[test]
    fn rewards_add_up_to_the_episode_statistics(length in 1_usize..10, lengths in episode_lengths()) {
        let (layout, recorded) = record(length, std::slice::from_ref(&lengths), 8);
        let mut sums = [0.0_f32; 2];
        let mut steps = 0;
        let mut expected = Vec::new();
        let mut reported = Vec::new();
        for unroll in &recorded[0] {
            let rows = Rows { layout: &layout, payload: &unroll.payload };
            for t in (0..length).filter(|t| rows.one(Field::Valid, *t) == 1.0) {
                let reward = rows.row(Field::Reward, t);
                sums = [sums[0] + reward[0], sums[1] + reward[1]];
                steps += 1;
                let (episode, step) = rows.place(t + 1);
                let episode_length = lengths[(episode - 1) % lengths.len()];
                if step == episode_length {
                    expected.push((steps, episode_length as u32, sums.to_vec()));
                    (sums, steps) = ([0.0; 2], 0);
                }
            }
            reported.extend(unroll.episodes.iter().map(|e| (e.steps, e.steps_left_at_start, e.returns.clone())));
            prop_assert_eq!(&reported, &expected, "an episode is reported in the unroll it ends in");
            for episode in &unroll.episodes {
                // The head's height in metres is the step's number, like the second reward term.
                let mean = episode.returns[1] / episode.steps as f32;
                prop_assert!((episode.head_height.unwrap() - mean).abs() < 1e-5, "{:?}", episode);
            }
        }
    }

    /// An unroll belongs to one task. An episode of another task waits for the next unroll, and padding fills the rows.
    #[test]
    fn an_unroll_belongs_to_one_task_and_padding_fills_it(
        length in 1_usize..10,
        lengths in episode_lengths(),
        tasks in prop::collection::vec(0_usize..3, 1..6),
    ) {
        let (layout, unrolls) = record_tasks(length, &lengths, &tasks);
        let task_of = |episode: usize| tasks[(episode - 1) % tasks.len()];
        let (mut expected, mut padded) = ((1, 0), false);
        for unroll in &unrolls {
            let rows = Rows { layout: &layout, payload: &unroll.payload };
            let task = rows.clip(0);
            prop_assert_eq!(unroll.task, task, "each task has one clip");
            prop_assert_eq!(rows.place(0), expected, "no step is lost or repeated");
            prop_assert!(!padded || rows.one(Field::First, 0) == 1.0, "an episode that waited begins the unroll");
            prop_assert_eq!(rows.row(Field::State, 0), vec![expected.1 as f32; 3], "its recurrent state is zero");
            padded = false;
            for t in 0..length {
                let ends = expected.1 == lengths[(expected.0 - 1) % lengths.len()];
                prop_assert_eq!(rows.clip(t), task);
                prop_assert_eq!(rows.one(Field::Valid, t) == 1.0, !padded && !ends);
                if padded {
                    prop_assert_eq!(rows.one(Field::First, t), 1.0);
                    prop_assert_eq!(rows.place(t), rows.place(t - 1), "the last observation again");
                    prop_assert_eq!(rows.row(Field::Std, t), vec![1.0; 3]);
                } else {
                    prop_assert_eq!(rows.place(t), expected);
                    expected = if ends { (expected.0 + 1, 0) } else { (expected.0, expected.1 + 1) };
                    padded = task_of(expected.0) as u32 != task;
                }
            }
            // Row T may be an episode's last: then the next unroll begins with the next episode.
            if !padded && expected.1 == lengths[(expected.0 - 1) % lengths.len()] {
                expected = (expected.0 + 1, 0);
            }
            let header = comic_proto::v1::UnrollHeader {
                layout_hash: layout.hash().to_vec(),
                episodes: unroll.episodes.clone(),
                task: unroll.task,
                ..Default::default()
            };
            let checked = comic_proto::Expected { clips: &[1, 1, 1], epoch: 0, newest_version: 0 };
            prop_assert_eq!(comic_proto::validate(&layout, &header, &unroll.payload.clone().into(), &checked), Ok(()));
        }
    }

    /// The recurrent state of an unroll's first row comes from the episode's steps before, also in earlier unrolls.
    #[test]
    fn the_state_travels_from_unroll_to_unroll_and_begins_empty(length in 1_usize..10, lengths in episode_lengths()) {
        let (layout, recorded) = record(length, &[lengths], 8);
        for unroll in &recorded[0] {
            let rows = Rows { layout: &layout, payload: &unroll.payload };
            prop_assert_eq!(rows.row(Field::State, 0), vec![rows.place(0).1 as f32; 3]);
        }
    }

    /// An environment's unrolls do not depend on its worker or on the other environments.
    #[test]
    fn an_environments_unrolls_are_its_own(
        length in 1_usize..10,
        environments in prop::collection::vec(episode_lengths(), 1..5),
        cut in any::<prop::sample::Index>(),
    ) {
        let cut = cut.index(environments.len() + 1);
        let (_, together) = record(length, &environments, 4);
        let (_, mut apart) = record(length, &environments[..cut], 4);
        apart.extend(record_from(cut as u32, length, &environments[cut..], 4).1);
        for (number, (one, other)) in together.iter().flatten().zip(apart.iter().flatten()).enumerate() {
            prop_assert_eq!(&one.payload, &other.payload);
            prop_assert_eq!((one.environment, other.environment), ((number / 4) as u32, (number / 4) as u32));
        }
    }

    /// z_{t−1} is 0 at an episode's first step and the latent of the step before at all others, also across unrolls.
    #[test]
    fn the_previous_latent_follows_the_episode(length in 1_usize..10, lengths in episode_lengths()) {
        let (layout, recorded) = record(length, &[lengths], 8);
        for unroll in &recorded[0] {
            let rows = Rows { layout: &layout, payload: &unroll.payload };
            for t in (0..length).filter(|t| rows.one(Field::Valid, *t) == 1.0) {
                prop_assert_eq!(rows.one(Field::PreviousLatent, t), rows.place(t).1 as f32);
            }
        }
    }
}

#[test]
fn the_unroll_records_the_unclipped_action_and_the_simulator_sees_the_clipped_one() {
    let layout = layout(32);
    let mut worker = Worker::new(vec![Counter::new(&[1000])], Plain::default(), Arc::clone(&layout), 0, 3).unwrap();
    worker.adopt(&directive(1)).unwrap();
    let unroll = worker.unroll(&|| false, &Progress::default()).unwrap().unwrap().remove(0);
    let rows = Rows { layout: &layout, payload: &unroll.payload };
    let beyond = (0..32).filter(|t| rows.one(Field::Action, *t) > 1.0).count();
    assert!(beyond > 5, "mean 1 and std 0.5 leave the range half of the time, seen {beyond}");
    for t in 0..32 {
        assert_eq!(rows.one(Field::Task, t + 1), rows.one(Field::Action, t).clamp(-1.0, 1.0));
        assert_eq!(rows.one(Field::Mean, t), 1.0);
        assert_eq!(rows.one(Field::Std, t), 0.5);
    }
}

#[test]
fn parameters_change_at_unroll_boundaries_only_and_the_header_names_them() {
    let layout = layout(5);
    let mut worker = Worker::new(vec![Counter::new(&[3])], Plain::default(), Arc::clone(&layout), 0, 3).unwrap();
    for version in 1..4 {
        worker.adopt(&directive(version)).unwrap();
        let unroll = worker.unroll(&|| false, &Progress::default()).unwrap().unwrap().remove(0);
        let rows = Rows { layout: &layout, payload: &unroll.payload };
        assert_eq!((unroll.learner_epoch, unroll.version), (7, version));
        assert!((0..5).all(|t| rows.one(Field::Mean, t) == version as f32));
    }
}

#[test]
fn a_seed_fixes_every_byte() {
    let environments = [vec![4, 7], vec![3]];
    let (_, once) = record(6, &environments, 3);
    let (_, again) = record(6, &environments, 3);
    for (a, b) in once.iter().flatten().zip(again.iter().flatten()) {
        assert_eq!(a.payload, b.payload);
    }
}
