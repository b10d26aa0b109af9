//! The rules of both corridors (`locomotion/tasks/corridors.py`).

use std::fmt::Debug;
use std::sync::Arc;

use comic_experiment::{Corridor, Vision};
use rand_pcg::Pcg64;

use super::interface::{Recorded, Rules, Verdict};
use super::poses::Poses;
use super::speed::{self, Way};
use super::stage::{Arena, Stage};
use crate::achievement::Achievement;
use crate::arenas::corridor::Extent;
use crate::error::Error;
use crate::gradient::RewardDerivative;
use crate::humanoid::observation::{Number, fill};

/// Distance along the corridor at which an episode begins (m, `walker_spawn_position` of dm_control's examples).
pub(crate) const START: f64 = 0.5;

/// The obstacles of a corridor. Each arena has its own random ones.
pub(crate) trait Obstacles: Debug + Send + Sync + 'static {
    /// A new arena with random obstacles, which knows where each ends.
    ///
    /// # Errors
    /// MuJoCo refuses the arena.
    fn draw(&self, extent: Extent, random: &mut Pcg64) -> Result<Arena, Error>;
}

/// The rules of both corridors.
#[derive(Debug)]
pub(crate) struct CorridorRules<O> {
    config: Corridor,
    poses: Poses,
    obstacles: O,
}

/// The use of the current arena, and the way of the current episode.
#[derive(Debug, Default)]
pub(crate) struct State {
    /// Control steps in the current arena; `None` when the next episode needs another arena.
    steps: Option<u32>,
    /// The root's farthest place along the corridor before a failure, m.
    farthest: f64,
}

impl<O: Obstacles> CorridorRules<O> {
    pub(crate) fn new(config: &Corridor, poses: Poses, obstacles: O) -> Self {
        Self { config: config.clone(), poses, obstacles }
    }

    fn draw_arena(&self, random: &mut Pcg64) -> Result<Arc<Arena>, Error> {
        let extent = Extent { length: self.config.length, width: self.config.width };
        Ok(Arc::new(self.obstacles.draw(extent, random)?))
    }

    /// Whether an episode came far enough, which is to the corridor's end, or [`Corridor::SUCCESS_SHARE`] of the way at the
    /// target velocity without a failure. A wall is 2 m after the corridor's end.
    fn is_success(&self, farthest: f64, failed: bool) -> bool {
        let Corridor { length, target_velocity, time_limit, .. } = self.config;
        let enough = START + Corridor::SUCCESS_SHARE * target_velocity * time_limit;
        farthest >= length || (!failed && farthest >= enough)
    }
}

/// 1 at `target` (m/s). It falls linearly to 0 at velocity 0 and at twice the target (`rewards.tolerance` with margin
/// `target`).
pub(crate) fn velocity_reward(velocity: f64, target: f64) -> f64 {
    let distance = if velocity < target { target - velocity } else { velocity - target } / target;
    if velocity == target {
        1.0
    } else if distance.abs() < 1.0 {
        1.0 - distance
    } else {
        0.0
    }
}

impl<O: Obstacles> Rules for CorridorRules<O> {
    type State = State;

    fn stage(&self, random: &mut Pcg64) -> Result<Stage, Error> {
        Ok(Stage::new(self.draw_arena(random)?))
    }

    fn begin(&self, stage: &mut Stage, state: &mut State, random: &mut Pcg64) {
        let worn = state.steps.is_none_or(|steps| steps >= self.config.arena_steps);
        // A first arena was compiled, so this one can be. If it fails, the old arena stays in use.
        if worn && let Ok(arena) = self.draw_arena(random) {
            stage.enter(arena);
            state.steps = Some(0);
        }
        state.farthest = START;
        let pose = self.poses.draw(random).moved(START, 0.0);
        stage.place(&pose.qpos, &pose.qvel);
    }

    fn judge(&self, stage: &mut Stage, state: &mut State, _: &mut Pcg64) -> Verdict {
        state.steps = state.steps.map(|steps| steps.saturating_add(1));
        stage.data.subtree_vel();
        let walker = &stage.arena.walker;
        let velocity = stage.data.subtree_linvel()[walker.root][0];
        let [hands_and_feet @ .., _head] = walker.appendages;
        let below = hands_and_feet.iter().any(|body| stage.data.xpos()[*body][2] < self.config.fall_height);
        let failed = below || stage.has_fallen();
        if !failed {
            state.farthest = state.farthest.max(stage.root().0[0]);
        }
        Verdict::of(velocity_reward(velocity, self.config.target_velocity), failed)
    }

    /// How far the root came from the start before a failure, m, and the gaps or walls whose far end was then behind it.
    fn achievement(&self, stage: &Stage, state: &State, failed: bool) -> Achievement {
        let passed = stage.arena.obstacle_ends.iter().filter(|end| **end < state.farthest).count();
        Achievement::new(self.is_success(state.farthest, failed))
            .measuring(&["metres", "obstacles"], [(state.farthest - START).max(0.0), passed as f64])
    }

    /// The root's height, m.
    fn observe<T: Number>(&self, stage: &Stage, _: &State, out: &mut [T]) {
        fill(out, [stage.root().0[2]]);
    }

    fn time_limit(&self) -> f64 {
        self.config.time_limit
    }

    fn vision(&self) -> Vision {
        self.config.vision
    }

    fn gradient_decay(&self) -> Option<f64> {
        Some(self.config.gradient.decay)
    }

    /// Of the root's speed along the corridor, and of the head's height.
    fn differentiate(&self, stage: &Stage, _: &State) -> RewardDerivative {
        let way = Way { direction: [1.0, 0.0], distance: f64::INFINITY };
        speed::differentiate(stage, Some(&way), self.config.target_velocity, &self.config.gradient)
    }
}

impl<O: Obstacles> Recorded for CorridorRules<O> {
    fn observation(&self, _: &Stage, _: &State) -> Vec<(&'static str, Vec<f64>)> {
        Vec::new()
    }

    fn quantities(&self, stage: &Stage, _: &State) -> Vec<(&'static str, Vec<f64>)> {
        let walker = &stage.arena.walker;
        let [hands_and_feet @ .., _head] = walker.appendages;
        vec![
            ("xvel", vec![stage.data.subtree_linvel()[walker.root][0]]),
            ("ee_z", hands_and_feet.map(|body| stage.data.xpos()[body][2]).to_vec()),
            ("disallowed", vec![stage.falls().count() as f64]),
        ]
    }
}

#[cfg(test)]
mod tests {
    use comic_experiment::{Gaps, StartPose, Walls};
    use rand::SeedableRng as _;

    use super::*;
    use crate::rules::poses::Pose;

    #[test]
    fn the_reward_is_a_triangle_around_the_target_velocity() {
        for (velocity, expected) in
            [(-1.0, 0.0), (0.0, 0.0), (1.5, 0.5), (3.0, 1.0), (4.5, 0.5), (6.0, 0.0), (9.0, 0.0)]
        {
            assert_eq!(velocity_reward(velocity, 3.0), expected, "{velocity} m/s");
        }
    }

    fn rules<O: Obstacles>(obstacles: O, arena_steps: u32) -> CorridorRules<O> {
        let config = Corridor { start_pose: StartPose::Upright, arena_steps, ..Corridor::default() };
        CorridorRules::new(&config, Poses::upright(), obstacles)
    }

    /// Plays `count` episodes of `steps` steps. After each: whether the next episode has another arena.
    fn changes<O: Obstacles>(rules: &CorridorRules<O>, count: usize, steps: usize) -> Vec<bool> {
        let (mut random, mut state) = (Pcg64::seed_from_u64(1), State::default());
        let mut stage = rules.stage(&mut random).unwrap();
        rules.begin(&mut stage, &mut state, &mut random);
        let mut change = |_| {
            let before = Arc::clone(&stage.arena);
            for _ in 0..steps {
                stage.step(&[0.0; 56]);
                rules.judge(&mut stage, &mut state, &mut random);
            }
            rules.begin(&mut stage, &mut state, &mut random);
            !Arc::ptr_eq(&before, &stage.arena)
        };
        (0..count).map(&mut change).collect()
    }

    #[test]
    fn an_arena_is_used_for_its_number_of_steps() {
        assert_eq!(changes(&rules(Walls::default(), 0), 3, 2), [true; 3]);
        assert_eq!(changes(&rules(Walls::default(), 5), 6, 2), [false, false, true, false, false, true]);
    }

    #[test]
    fn all_arenas_of_gaps_have_one_memory_layout() {
        let (rules, mut random) = (rules(Gaps::default(), 0), Pcg64::seed_from_u64(1));
        let mut stage = rules.stage(&mut random).unwrap();
        for _ in 0..10 {
            let arena = rules.draw_arena(&mut random).unwrap();
            assert!(arena.models.take_over(&mut stage.data));
        }
    }

    /// Puts the body at `x` along the corridor (m): above the ground, or below the fall height, where it fails.
    fn put(stage: &mut Stage, x: f64, fails: bool) {
        let mut pose = Pose::upright().moved(x, 0.0);
        pose.position_mut()[2] += if fails { -5.0 } else { 0.5 };
        stage.place(&pose.qpos, &pose.qvel);
    }

    /// Visits the first three obstacles of a corridor, and compares what the episode has achieved after each place.
    fn measures_the_way<O: Obstacles>(obstacles: O) {
        let (rules, mut random, mut state) = (rules(obstacles, 512), Pcg64::seed_from_u64(1), State::default());
        let mut stage = rules.stage(&mut random).unwrap();
        state.farthest = 70.0;
        rules.begin(&mut stage, &mut state, &mut random);
        let [first, second, third, ..] = stage.arena.obstacle_ends[..] else {
            panic!("a corridor has more than three obstacles")
        };
        for (x, fails, metres, passed) in [
            (START, false, 0.0, 0.0),
            (first - 0.01, false, first - 0.01 - START, 0.0),
            (first + 0.01, false, first + 0.01 - START, 1.0),
            (second + 0.01, false, second + 0.01 - START, 2.0),
            (1.0, false, second + 0.01 - START, 2.0),
            (third + 0.01, true, second + 0.01 - START, 2.0),
        ] {
            put(&mut stage, x, fails);
            assert_eq!(rules.judge(&mut stage, &mut state, &mut random).failed, fails, "{x}");
            let achievement = rules.achievement(&stage, &state, fails);
            let expected = Achievement::new(false).measuring(&["metres", "obstacles"], [metres, passed]);
            assert!(!achievement.success);
            for ((name, found), (expected_name, expected)) in achievement.measures().zip(expected.measures()) {
                assert_eq!(name, expected_name);
                assert!((found - expected).abs() < 1e-9, "{name} at {x}: {found} is not {expected}");
            }
        }
    }

    #[test]
    fn a_body_past_a_gap_or_a_wall_counts_it_unless_it_fell_there() {
        measures_the_way(Gaps::default());
        measures_the_way(Walls::default());
    }

    #[test]
    fn half_the_way_without_a_fall_is_success_and_so_is_the_corridors_end() {
        let rules = rules(Gaps::default(), 0);
        // Half of 3 m/s × 45 s from the start at 0.5 m.
        for (farthest, failed, success) in [
            (START, false, false),
            (67.9, false, false),
            (68.0, false, true),
            (68.0, true, false),
            (99.9, true, false),
            (100.0, true, true),
        ] {
            assert_eq!(rules.is_success(farthest, failed), success, "{farthest} m, failed: {failed}");
        }
        let config = Corridor { length: 20.0, start_pose: StartPose::Upright, ..Corridor::default() };
        let short = CorridorRules::new(&config, Poses::upright(), Gaps::default());
        assert!(!short.is_success(19.9, false) && short.is_success(20.0, false), "a short corridor has an end");
    }

    #[test]
    fn spare_boxes_do_not_change_the_physics() {
        let config = Gaps::default();
        let extent = Extent { length: 30.0, width: 10.0 };
        let one = crate::arenas::corridor::platform(0, 6.0, 2.0, extent);
        let blocks = [crate::arenas::corridor::first_platform(extent), one];
        let heights = [0, 7].map(|spare| {
            let arena = crate::arenas::corridor::with_gaps(extent, &blocks, spare).unwrap();
            let model = crate::humanoid::build_in(arena);
            let mut stage = Stage::new(Arc::new(Arena::new(model.unwrap()).unwrap()));
            let pose = Poses::upright().draw(&mut Pcg64::seed_from_u64(1)).moved(config.corridor.width / 2.0, 0.0);
            stage.place(&pose.qpos, &pose.qvel);
            for _ in 0..60 {
                stage.step(&[0.1; 56]);
            }
            stage.data.qpos().to_vec()
        });
        assert_eq!(heights[0], heights[1]);
    }
}
