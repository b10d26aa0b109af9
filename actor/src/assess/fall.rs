//! Episodes until the fall.

use std::ops::ControlFlow;
use std::sync::Arc;

use comic_clips::spatial::rotated;
use comic_tasks::{Simulated, Step, Task};
use rand_pcg::Pcg64;

use super::row::Fallen;
use crate::Error;
use crate::acting_loop::{Recorder, Rollout};
use crate::film::recorder::Recorder as Film;
use crate::forward_pass::ActingRow;

/// Height of the head below which the humanoid has fallen, m.
const FALLEN: f64 = 1.2;
/// When the places of the humanoids are compared, s.
const COMPARED_AFTER: f64 = 3.0;

/// An episode under way.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Falling {
    /// The place of its start among all starts.
    number: usize,
    /// Where the root was at the start, x and y, m.
    from: [f64; 2],
    /// Angle about the vertical between +x and the root's forward axis at the start, rad.
    yaw: f64,
    /// The root after three seconds, as [`Fallen::place`].
    place: Option<[f64; 2]>,
}

/// Plays the starts `0..all`, and sees when each episode falls.
pub(super) struct FallRecorder {
    task: Arc<dyn Task>,
    /// The episode of each environment.
    episodes: Vec<Falling>,
    /// The next start.
    next: usize,
    all: usize,
    pub(super) finished: Vec<Fallen>,
    /// Films the first start.
    pub(super) film: Option<Film>,
    /// The noise of all environments.
    rng: Pcg64,
}

pub(super) type Walking = Rollout<Box<dyn Simulated>>;

impl FallRecorder {
    /// For so many environments and episodes.
    pub(super) fn new(task: &Arc<dyn Task>, environments: usize, all: usize, film: Option<Film>, rng: Pcg64) -> Self {
        let episodes = vec![Falling::default(); environments];
        Self { task: Arc::clone(task), episodes, next: 0, all, finished: Vec::new(), film, rng }
    }

    /// Begins the next start's episode; the environment stays idle when there is none.
    pub(super) fn begin_next(
        &mut self,
        index: usize,
        rollout: &mut Walking,
        row: &mut ActingRow<'_>,
    ) -> Result<(), Error> {
        rollout.ended = true;
        if self.next == self.all {
            return Ok(());
        }
        // A task has few starts for evaluations. A new environment is at the start that its seed draws, of which there are
        // many, and which is the same for every source of latents.
        rollout.environment = Arc::clone(&self.task).environment(self.next as u64)?;
        rollout.begin_episode(row);
        let [from @ .., w, x, y, z] = root(rollout);
        let [ahead_x, ahead_y, _] = rotated([w, x, y, z], [0.0, 0.0, 1.0]);
        let [from_x, from_y, _] = from;
        let (from, yaw) = ([from_x, from_y], ahead_y.atan2(ahead_x));
        self.episodes[index] = Falling { number: self.next, from, yaw, place: None };
        self.next += 1;
        self.shoot(index, rollout)
    }

    fn shoot(&mut self, index: usize, rollout: &mut Walking) -> Result<(), Error> {
        match (&mut self.film, self.episodes[index].number) {
            (Some(film), 0) => film.shoot(rollout.environment.as_mut()),
            _ => Ok(()),
        }
    }
}

/// Position (m, world) and quaternion of the root.
fn root(rollout: &Walking) -> [f64; 7] {
    let qpos = rollout.environment.simulation().qpos();
    std::array::from_fn(|index| qpos.get(index).copied().unwrap_or(0.0))
}

impl Falling {
    /// From the start to this place in the world, m: ahead and to the left, seen in the direction of the start.
    fn way_to(&self, x: f64, y: f64) -> [f64; 2] {
        let (dx, dy) = (x - self.from[0], y - self.from[1]);
        let (sin, cos) = self.yaw.sin_cos();
        [cos * dx + sin * dy, cos * dy - sin * dx]
    }
}

/// Whether the humanoid has fallen. After a divergence the head's height is 0, so a divergence is a fall.
///
/// Go-to-target ends an episode when a part of the body other than a foot touches the ground. That is no fall while the head
/// is up: a knee or a hand may touch. To end there would hide whether a fall follows, so the simulation goes on.
fn has_fallen(step: &Step) -> bool {
    step.head_height < FALLEN
}

impl Recorder<Box<dyn Simulated>> for FallRecorder {
    fn observe(&mut self, _index: usize, _rollout: &mut Walking, _row: &mut ActingRow<'_>) -> Result<(), Error> {
        Ok(())
    }

    fn draw_latent_noise(&mut self, _index: usize, _row: &mut ActingRow<'_>) {}

    fn choose(&mut self, _index: usize, rollout: &Walking, row: &mut ActingRow<'_>) {
        if !rollout.ended {
            row.sample(&mut self.rng);
        }
    }

    fn step(&mut self, index: usize, rollout: &mut Walking, row: &mut ActingRow<'_>) -> Result<ControlFlow<()>, Error> {
        if rollout.ended {
            return Ok(ControlFlow::Continue(()));
        }
        let step = rollout.step(row);
        let (upright, timestep) = (!has_fallen(&step), self.task.control_timestep());
        // Only the time limit and a fall end an episode.
        rollout.ended = !upright || rollout.steps as usize >= rollout.episode.steps_left;
        let [x, y, ..] = root(rollout);
        let way = self.episodes[index].way_to(x, y);
        if upright {
            if f64::from(rollout.steps) == (COMPARED_AFTER / timestep).round() {
                self.episodes[index].place = Some(way);
            }
            self.shoot(index, rollout)?;
        }
        if rollout.ended {
            // After a divergence positions mean nothing.
            let metres = Some(way[0].hypot(way[1])).filter(|metres| metres.is_finite()).unwrap_or(0.0);
            let (seconds, place) = (f64::from(rollout.steps) * timestep, self.episodes[index].place);
            self.finished.push(Fallen { seconds, upright, metres, place });
            self.begin_next(index, rollout, row)?;
        }
        Ok(ControlFlow::Continue(()))
    }
}

#[cfg(test)]
mod tests {
    use comic_clips::Catalogue;
    use comic_experiment::{Experiment, StartPose, TaskName};
    use comic_proto::UnrollShape;
    use comic_tasks::{MAX_REWARD_TERMS, Outcome};
    use rand::SeedableRng as _;

    use super::*;
    use crate::acting_loop::{ActingLoop, Controller};
    use crate::policy::TorchPolicy;

    #[test]
    fn an_episode_that_the_task_ends_is_no_fall_and_a_divergence_is_one() {
        for (outcome, head_height, fallen) in [
            (Outcome::Running, 1.5, false),
            (Outcome::Terminated, 1.3, false),
            (Outcome::Truncated, 1.3, false),
            (Outcome::Terminated, 1.1, true),
            (Outcome::Diverged, 0.0, true),
        ] {
            let step = Step { reward_terms: [0.0; MAX_REWARD_TERMS], discount: 1.0, outcome, head_height };
            assert_eq!(has_fallen(&step), fallen, "{step:?}");
        }
    }

    #[test]
    fn the_way_is_seen_in_the_direction_of_the_start() {
        let start = Falling { from: [1.0, 2.0], yaw: std::f64::consts::FRAC_PI_2, ..Falling::default() };
        for (place, [ahead, left]) in [([1.0, 5.0], [3.0, 0.0]), ([0.0, 2.0], [0.0, 1.0]), ([1.0, 1.0], [-1.0, 0.0])] {
            let [found_ahead, found_left] = start.way_to(place[0], place[1]);
            assert!((found_ahead - ahead).hypot(found_left - left) < 1e-12, "{place:?}: {found_ahead} {found_left}");
        }
    }

    /// Go-to-target from the upright pose, for so many seconds.
    fn task(time_limit: f64) -> Arc<dyn Task> {
        let mut experiment = Experiment { task: TaskName::GoToTarget, ..Experiment::default() };
        experiment.go_to_target.start_pose = StartPose::Upright;
        experiment.go_to_target.time_limit = time_limit;
        comic_tasks::build(&experiment, &Catalogue::open(&experiment.clips).unwrap()).unwrap()
    }

    /// The episodes under the action 0, in so many environments.
    fn episodes(time_limit: f64, environments: usize, all: usize) -> Vec<Fallen> {
        let task = task(time_limit);
        let shape = UnrollShape::new(task.spec(), &Experiment::default());
        let made = (0..environments as u64).map(|seed| Arc::clone(&task).environment(seed).unwrap()).collect();
        let mut acting = ActingLoop::new(made, &shape, None);
        let mut recorder = FallRecorder::new(&task, environments, all, None, Pcg64::seed_from_u64(1));
        for (index, rollout) in acting.rollouts.iter_mut().enumerate() {
            recorder.begin_next(index, rollout, &mut acting.batch.row(index)).unwrap();
        }
        let mut controller = Controller::<TorchPolicy>::Zero;
        while recorder.finished.len() < all {
            let _ = acting.iterate(&mut controller, &mut recorder).unwrap();
        }
        recorder.finished
    }

    #[test]
    fn the_time_limit_ends_an_episode_upright_and_a_fall_ends_it_before() {
        // More episodes than a task has starts for evaluations.
        let short = episodes(0.09, 16, 70);
        assert!(short.len() == 70 && short.iter().all(|one| one.upright && (one.seconds - 0.09).abs() < 1e-9));
        // Without control a body falls within a few seconds, in every direction alike.
        let long = episodes(10.0, 2, 3);
        assert!(long.iter().all(|one| !one.upright && one.seconds < 5.0), "{long:?}");
    }
}
