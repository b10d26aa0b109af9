//! Go-to-target (`locomotion/tasks/go_to_target.py`): a sparse reward within a metre of a target that then moves away.

use std::f64::consts::PI;
use std::sync::Arc;

use comic_experiment::GoToTarget;
use rand::Rng as _;
use rand_pcg::Pcg64;

use crate::arenas::floor;
use crate::error::Error;
use crate::humanoid;
use crate::observation::{Number, fill};
use crate::quaternion::{difference, into_frame};
use crate::rules::{Recorded, Rules, Verdict};
use crate::stage::{Arena, Stage};
use crate::start::{Poses, UP};

/// The rules of go-to-target.
#[derive(Debug)]
pub(crate) struct GoToTargetRules {
    config: GoToTarget,
    poses: Poses,
    arena: Arc<Arena>,
}

/// Where the target is, and for how many steps it was reached.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    /// x and y, m; it lies on the floor.
    pub(crate) target: [f64; 2],
    pub(crate) rewarded_steps: u32,
    /// Targets to come before any is drawn, the next one last: for comparisons with recorded episodes.
    pub(crate) script: Vec<[f64; 2]>,
}

impl GoToTargetRules {
    pub(crate) fn new(config: &GoToTarget, poses: Poses) -> Result<Self, Error> {
        let arena = Arc::new(Arena::new(humanoid::build_in(floor::with_target)?)?);
        Ok(Self { config: config.clone(), poses, arena })
    }

    fn next_target(&self, memory: &mut Memory, random: &mut Pcg64) -> [f64; 2] {
        memory.script.pop().unwrap_or_else(|| self.place(random))
    }

    fn place(&self, random: &mut Pcg64) -> [f64; 2] {
        let half = self.config.half_width;
        [random.random_range(-half..=half), random.random_range(-half..=half)]
    }
}

impl Rules for GoToTargetRules {
    type Memory = Memory;

    fn stage(&self, _: &mut Pcg64) -> Result<Stage, Error> {
        Ok(Stage::new(Arc::clone(&self.arena)))
    }

    fn begin(&self, stage: &mut Stage, memory: &mut Memory, random: &mut Pcg64) {
        memory.target = self.next_target(memory, random);
        if !self.config.carry_count {
            memory.rewarded_steps = 0;
        }
        let mut pose = self.poses.draw(random);
        if self.config.random_heading {
            pose = pose.turned(UP, random.random_range(-PI..PI));
        }
        let [x, y] = self.place(random);
        let pose = pose.moved(x, y);
        stage.place(&pose.qpos, &pose.qvel);
    }

    fn judge(&self, stage: &mut Stage, memory: &mut Memory, random: &mut Pcg64) -> Verdict {
        let failed = stage.has_fallen();
        // The target moves a step after the last rewarded one, and this step's reward sees it there already.
        if self.config.moving_target && memory.rewarded_steps >= self.config.steps_at_target {
            memory.target = self.next_target(memory, random);
            memory.rewarded_steps = 0;
        }
        let (root, _) = stage.root();
        let [x, y] = memory.target;
        let near = (x - root[0]).hypot(y - root[1]) < self.config.tolerance;
        if near && self.config.moving_target {
            memory.rewarded_steps += 1;
        }
        Verdict::of(f64::from(u8::from(near)), failed)
    }

    /// The target relative to the root, m, in the root's frame.
    fn observe<T: Number>(&self, stage: &Stage, memory: &Memory, out: &mut [T]) {
        let (root, rotation) = stage.root();
        let [x, y] = memory.target;
        fill(out, into_frame(rotation, difference(&[x, y, 0.0], root)));
    }

    fn time_limit(&self) -> f64 {
        self.config.time_limit
    }

    fn target(&self, memory: &Memory) -> Option<[f64; 2]> {
        Some(memory.target)
    }
}

impl Recorded for GoToTargetRules {
    fn observation(&self, stage: &Stage, memory: &Memory) -> Vec<(&'static str, Vec<f64>)> {
        let mut target = vec![0.0; 3];
        self.observe(stage, memory, &mut target);
        vec![("walker/target", target)]
    }

    fn quantities(&self, stage: &Stage, memory: &Memory) -> Vec<(&'static str, Vec<f64>)> {
        let (root, _) = stage.root();
        let [x, y] = memory.target;
        vec![
            ("target", vec![x, y, 0.0]),
            ("counter", vec![f64::from(memory.rewarded_steps)]),
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

    fn rules(config: &GoToTarget) -> GoToTargetRules {
        GoToTargetRules::new(&GoToTarget { start_pose: StartPose::Upright, ..config.clone() }, Poses::upright())
            .unwrap()
    }

    #[test]
    fn the_target_moves_a_step_after_the_tenth_rewarded_one_and_pays_where_it_is_then() {
        let (rules, mut random) = (rules(&GoToTarget::default()), Pcg64::seed_from_u64(1));
        let mut stage = rules.stage(&mut random).unwrap();
        let mut memory = Memory::default();
        rules.begin(&mut stage, &mut memory, &mut random);
        let (root, _) = stage.root();
        memory.target = [root[0] + 0.9, root[1]];
        memory.script = vec![[root[0] + 1.1, root[1]]];
        for _ in 0..10 {
            assert_eq!(rules.judge(&mut stage, &mut memory, &mut random).reward_terms[0], 1.0);
        }
        let near = memory.target;
        assert_eq!(rules.judge(&mut stage, &mut memory, &mut random).reward_terms[0], 0.0);
        assert_ne!(memory.target, near);
        assert_eq!(memory.rewarded_steps, 0);
    }

    #[test]
    fn counts_begin_anew_with_an_episode_unless_told_otherwise() {
        for (carry_count, expected) in [(false, 0), (true, 7)] {
            let (rules, mut random) =
                (rules(&GoToTarget { carry_count, ..GoToTarget::default() }), Pcg64::seed_from_u64(1));
            let mut stage = rules.stage(&mut random).unwrap();
            let mut memory = Memory { rewarded_steps: 7, ..Memory::default() };
            rules.begin(&mut stage, &mut memory, &mut random);
            assert_eq!(memory.rewarded_steps, expected);
        }
    }

    #[test]
    fn starts_and_targets_fill_the_square_and_headings_the_circle() {
        let (rules, mut random) = (rules(&GoToTarget::default()), Pcg64::seed_from_u64(2));
        let mut stage = rules.stage(&mut random).unwrap();
        let mut memory = Memory::default();
        let mut draws: [Vec<f64>; 5] = Default::default();
        for _ in 0..2000 {
            rules.begin(&mut stage, &mut memory, &mut random);
            let (root, rotation) = stage.root();
            let heading = rotation[5].atan2(rotation[2]) * 4.0 / PI;
            let values = [root[0], root[1], memory.target[0], memory.target[1], heading];
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
