//! Go-to-target (`locomotion/tasks/go_to_target.py`): a sparse reward near a target, which moves after some rewarded steps.

use std::f64::consts::PI;
use std::sync::Arc;

use comic_clips::spatial::{into_frame, subtract};
use comic_experiment::GoToTarget;
use rand::Rng as _;
use rand_pcg::Pcg64;

use super::environment::RuledTask;
use super::interface::{Recorded, Rules, Verdict};
use super::poses::{Poses, UP};
use super::speed::{self, Way};
use super::stage::{Arena, Stage};
use crate::achievement::Achievement;
use crate::arenas::floor;
use crate::build_task::{BuildTask, Context};
use crate::environment::Task;
use crate::error::Error;
use crate::gradient::RewardDerivative;
use crate::humanoid;
use crate::humanoid::observation::{Number, fill};

/// Speed towards the target that is differentiated unless the experiment says another, m/s (D).
const WALKING_SPEED: f64 = 1.0;

/// The rules of go-to-target.
#[derive(Debug)]
pub(crate) struct GoToTargetRules {
    config: GoToTarget,
    poses: Poses,
    arena: Arc<Arena>,
}

/// The target, and the number of rewarded steps there.
#[derive(Debug, Default)]
pub(crate) struct State {
    /// x and y on the floor, m.
    pub(crate) target: [f64; 2],
    pub(crate) rewarded_steps: u32,
    /// Whether the root was ever outside the tolerance of the current target in this episode. Otherwise the target appeared
    /// where the humanoid stood.
    pub(crate) was_away: bool,
    /// Steps of this episode near the current target after that. Unlike `rewarded_steps` they are counted for a target that
    /// does not move, too, and an episode begins with 0.
    pub(crate) near_steps: u32,
    /// Targets of this episode that were reached and held.
    pub(crate) held_targets: u32,
    /// Targets that come before random ones, the next one last; for comparisons with recorded episodes.
    pub(crate) script: Vec<[f64; 2]>,
}

impl BuildTask for GoToTarget {
    fn build(&self, context: &Context<'_>) -> Result<Arc<dyn Task>, Error> {
        let poses = Poses::new(self.start_pose, context.catalogue)?;
        Ok(Arc::new(RuledTask::new(GoToTargetRules::new(self, poses)?, context.spec()?)))
    }
}

impl GoToTargetRules {
    pub(crate) fn new(config: &GoToTarget, poses: Poses) -> Result<Self, Error> {
        let arena = Arc::new(Arena::new(humanoid::build_in(floor::with_target()?)?)?);
        Ok(Self { config: config.clone(), poses, arena })
    }

    fn next_target(&self, state: &mut State, random: &mut Pcg64) -> [f64; 2] {
        state.script.pop().unwrap_or_else(|| self.place(random))
    }

    /// Counts the target when it was reached and has been held for long enough, once.
    fn count(&self, near: bool, state: &mut State) {
        state.was_away |= !near;
        if near && state.was_away {
            state.near_steps = state.near_steps.saturating_add(1);
            state.held_targets += u32::from(state.near_steps == self.config.steps_at_target);
        }
    }

    fn place(&self, random: &mut Pcg64) -> [f64; 2] {
        let half = self.config.half_width;
        [random.random_range(-half..=half), random.random_range(-half..=half)]
    }
}

impl Rules for GoToTargetRules {
    type State = State;

    fn stage(&self, _: &mut Pcg64) -> Result<Stage, Error> {
        Ok(Stage::new(Arc::clone(&self.arena)))
    }

    fn begin(&self, stage: &mut Stage, state: &mut State, random: &mut Pcg64) {
        state.target = self.next_target(state, random);
        (state.was_away, state.near_steps, state.held_targets) = (false, 0, 0);
        if !self.config.carry_count {
            state.rewarded_steps = 0;
        }
        let mut pose = self.poses.draw(random);
        if self.config.random_heading {
            pose = pose.turned(UP, random.random_range(-PI..PI));
        }
        let [x, y] = self.place(random);
        let pose = pose.moved(x, y);
        stage.place(&pose.qpos, &pose.qvel);
    }

    fn judge(&self, stage: &mut Stage, state: &mut State, random: &mut Pcg64) -> Verdict {
        let failed = stage.has_fallen();
        // The target moves one step after the last rewarded step. The reward of this step already uses the new target.
        if self.config.moving_target && state.rewarded_steps >= self.config.steps_at_target {
            state.target = self.next_target(state, random);
            (state.rewarded_steps, state.was_away, state.near_steps) = (0, false, 0);
        }
        let (root, _) = stage.root();
        let [x, y] = state.target;
        let near = (x - root[0]).hypot(y - root[1]) < self.config.tolerance;
        if near && self.config.moving_target {
            state.rewarded_steps += 1;
        }
        self.count(near, state);
        Verdict::of(f64::from(u8::from(near)), failed)
    }

    /// The targets that were reached and held: within the tolerance for `steps_at_target` steps, which need not follow each
    /// other, after the root was outside. Success: at least one.
    fn achievement(&self, _: &Stage, state: &State, _: bool) -> Achievement {
        Achievement::new(state.held_targets > 0).measuring(&["targets"], [f64::from(state.held_targets)])
    }

    /// The target relative to the root, in the root's frame, m.
    fn observe<T: Number>(&self, stage: &Stage, state: &State, out: &mut [T]) {
        let (root, rotation) = stage.root();
        let [x, y] = state.target;
        fill(out, into_frame(rotation, subtract([x, y, 0.0], *root)));
    }

    fn time_limit(&self) -> f64 {
        self.config.time_limit
    }

    fn target(&self, state: &State) -> Option<[f64; 2]> {
        Some(state.target)
    }

    fn gradient_decay(&self) -> Option<f64> {
        Some(self.config.gradient.decay)
    }

    /// Of the root's speed towards the target while it is not within the tolerance, and of the head's height.
    fn differentiate(&self, stage: &Stage, state: &State) -> RewardDerivative {
        let (root, _) = stage.root();
        let way = [state.target[0] - root[0], state.target[1] - root[1]];
        let distance = way[0].hypot(way[1]);
        let way = Way { direction: way.map(|entry| entry / distance), distance };
        let way = (distance >= self.config.tolerance).then_some(&way);
        speed::differentiate(stage, way, WALKING_SPEED, &self.config.gradient)
    }
}

impl Recorded for GoToTargetRules {
    fn observation(&self, stage: &Stage, state: &State) -> Vec<(&'static str, Vec<f64>)> {
        let mut target = vec![0.0; 3];
        self.observe(stage, state, &mut target);
        vec![("walker/target", target)]
    }

    fn quantities(&self, stage: &Stage, state: &State) -> Vec<(&'static str, Vec<f64>)> {
        let (root, _) = stage.root();
        let [x, y] = state.target;
        vec![
            ("target", vec![x, y, 0.0]),
            ("counter", vec![f64::from(state.rewarded_steps)]),
            ("distance", vec![(x - root[0]).hypot(y - root[1])]),
            ("disallowed", vec![stage.falls().count() as f64]),
        ]
    }
}

#[cfg(test)]
mod tests {
    use comic_experiment::StartPose;
    use rand::SeedableRng as _;

    use super::*;
    use crate::rules::poses::Pose;

    fn rules(config: &GoToTarget) -> GoToTargetRules {
        GoToTargetRules::new(&GoToTarget { start_pose: StartPose::Upright, ..config.clone() }, Poses::upright())
            .unwrap()
    }

    #[test]
    fn the_target_moves_one_step_after_the_tenth_rewarded_step() {
        let (rules, mut random) = (rules(&GoToTarget::default()), Pcg64::seed_from_u64(1));
        let mut stage = rules.stage(&mut random).unwrap();
        let mut state = State::default();
        rules.begin(&mut stage, &mut state, &mut random);
        let (root, _) = stage.root();
        state.target = [root[0] + 0.9, root[1]];
        state.script = vec![[root[0] + 1.1, root[1]]];
        for _ in 0..10 {
            assert_eq!(rules.judge(&mut stage, &mut state, &mut random).reward_terms[0], 1.0);
        }
        let near = state.target;
        assert_eq!(rules.judge(&mut stage, &mut state, &mut random).reward_terms[0], 0.0);
        assert_ne!(state.target, near);
        assert_eq!(state.rewarded_steps, 0);
    }

    /// The measured targets after each step of an episode in which the root has these distances from its target, m. Every
    /// target is at the same place.
    fn held(config: &GoToTarget, distances: &[f64]) -> Vec<f64> {
        let (rules, mut random) = (rules(config), Pcg64::seed_from_u64(1));
        let mut stage = rules.stage(&mut random).unwrap();
        let mut state = State { rewarded_steps: 3, near_steps: 3, held_targets: 3, was_away: true, ..State::default() };
        state.script = vec![[0.0; 2]; distances.len() + 1];
        rules.begin(&mut stage, &mut state, &mut random);
        let mut step = |distance: &f64| {
            let pose = Pose::upright().moved(*distance, 0.0);
            stage.place(&pose.qpos, &pose.qvel);
            let reward = rules.judge(&mut stage, &mut state, &mut random).reward_terms[0];
            assert_eq!(reward, f64::from(u8::from(*distance < 1.0)));
            let achievement = rules.achievement(&stage, &state, false);
            let targets = achievement.measures().collect::<Vec<_>>();
            assert_eq!((targets.len(), targets[0].0), (1, "targets"));
            assert_eq!(achievement.success, targets[0].1 > 0.0);
            targets[0].1
        };
        distances.iter().map(&mut step).collect()
    }

    fn fixed() -> GoToTarget {
        GoToTarget { moving_target: false, ..GoToTarget::default() }
    }

    #[test]
    fn a_target_counts_after_its_tenth_step_and_a_fixed_one_once() {
        // The target moves in the step after the tenth one near it. The body leaves it in that step, and comes again.
        let way = [vec![1.1], vec![0.9; 10]].concat().repeat(3);
        let expected: Vec<f64> = (0..33).map(|step| f64::from((step + 1) / 11)).collect();
        assert_eq!(held(&GoToTarget::default(), &way), expected);
        assert_eq!(held(&fixed(), &way), [vec![0.0; 10], vec![1.0; 23]].concat());
        // Steps near a target need not follow each other.
        let in_and_out = [1.1, 0.9].repeat(10);
        assert_eq!(held(&GoToTarget::default(), &in_and_out), [vec![0.0; 19], vec![1.0]].concat());
    }

    #[test]
    fn standing_still_is_no_success_neither_far_from_a_target_nor_at_one() {
        for config in [GoToTarget::default(), fixed()] {
            for distance in [1.1, 0.9] {
                assert_eq!(held(&config, &[distance; 40]), [0.0; 40], "{distance} m away");
            }
        }
    }

    #[test]
    fn the_count_starts_at_0_in_each_episode_unless_it_is_kept() {
        for (carry_count, expected) in [(false, 0), (true, 7)] {
            let (rules, mut random) =
                (rules(&GoToTarget { carry_count, ..GoToTarget::default() }), Pcg64::seed_from_u64(1));
            let mut stage = rules.stage(&mut random).unwrap();
            let mut state = State { rewarded_steps: 7, ..State::default() };
            rules.begin(&mut stage, &mut state, &mut random);
            assert_eq!(state.rewarded_steps, expected);
        }
    }

    #[test]
    fn starts_targets_and_headings_are_uniform() {
        let (rules, mut random) = (rules(&GoToTarget::default()), Pcg64::seed_from_u64(2));
        let mut stage = rules.stage(&mut random).unwrap();
        let mut state = State::default();
        let mut draws: [Vec<f64>; 5] = Default::default();
        for _ in 0..2000 {
            rules.begin(&mut stage, &mut state, &mut random);
            let (root, rotation) = stage.root();
            let heading = rotation[5].atan2(rotation[2]) * 4.0 / PI;
            let values = [root[0], root[1], state.target[0], state.target[1], heading];
            draws.iter_mut().zip(values).for_each(|(all, value)| all.push(value));
        }
        for values in draws {
            // Uniform over ±4: the mean's standard error is 0.052, the variance 16/3 with a standard error of 0.107.
            let mean = values.iter().sum::<f64>() / 2000.0;
            let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / 2000.0;
            assert!(mean.abs() < 0.25, "{mean}");
            assert!((variance - 16.0 / 3.0).abs() < 0.5, "{variance}");
            assert!(values.iter().all(|value| value.abs() <= 4.0 + 1e-9));
        }
    }
}
