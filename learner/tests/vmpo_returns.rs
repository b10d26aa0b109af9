//! Targets of the value function: the recursion, and the ends of episodes.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use comic_learner::vmpo::returns;
use proptest::prelude::*;
use tch::Tensor;

const GAMMA: f64 = 0.9;

/// One unroll with one reward term.
#[derive(Clone, Debug)]
struct Unroll {
    reward: Vec<f32>,
    discount: Vec<f32>,
    valid: Vec<f32>,
    values: Vec<f32>,
}

impl Unroll {
    fn targets(&self, lambda: f64) -> Vec<f32> {
        let steps = self.reward.len() as i64;
        let tensor = |values: &[f32], shape: &[i64]| Tensor::from_slice(values).reshape(shape);
        let targets = returns(
            &tensor(&self.reward, &[1, steps, 1]),
            &tensor(&self.discount, &[1, steps]),
            &tensor(&self.valid, &[1, steps]),
            &tensor(&self.values, &[1, steps + 1, 1]),
            GAMMA,
            lambda,
        );
        Vec::try_from(targets.view(-1)).unwrap()
    }

    /// The definition, as a recursion.
    fn definition(&self, lambda: f32) -> Vec<f32> {
        let mut next = self.values[self.reward.len()];
        let mut targets: Vec<f32> = (0..self.reward.len())
            .rev()
            .map(|t| {
                let mixed = (1.0 - lambda) * self.values[t + 1] + lambda * next;
                let transition = self.reward[t] + GAMMA as f32 * self.discount[t] * mixed;
                next = if self.valid[t] == 1.0 { transition } else { self.values[t] };
                next
            })
            .collect();
        targets.reverse();
        targets
    }
}

fn close(left: &[f32], right: &[f32]) -> bool {
    left.iter().zip(right).all(|(left, right)| (left - right).abs() <= 1e-5 * left.abs().max(1.0))
}

fn unroll() -> impl Strategy<Value = Unroll> {
    (2usize..40).prop_flat_map(|steps| {
        let numbers = |count| prop::collection::vec(-2f32..2.0, count);
        let flags = |chance| prop::collection::vec(prop::bool::weighted(chance).prop_map(f32::from), steps);
        (numbers(steps), flags(0.8), flags(0.8), numbers(steps + 1))
            .prop_map(|(reward, discount, valid, values)| Unroll { reward, discount, valid, values })
    })
}

#[test]
fn the_return_runs_to_the_unrolls_end_and_bootstraps_there() {
    let unroll =
        Unroll { reward: vec![1.0, 2.0], discount: vec![1.0; 2], valid: vec![1.0; 2], values: vec![7.0, 8.0, 10.0] };
    assert!(close(&unroll.targets(1.0), &[1.0 + 0.9 * (2.0 + 0.9 * 10.0), 2.0 + 0.9 * 10.0]));
}

#[test]
fn after_a_termination_nothing_counts_but_its_own_reward() {
    let unroll = Unroll {
        reward: vec![1.0, 2.0, 0.0, 4.0],
        discount: vec![1.0, 0.0, 1.0, 1.0],
        valid: vec![1.0, 1.0, 0.0, 1.0],
        values: vec![5.0, 5.0, 100.0, 5.0, 5.0],
    };
    assert!(close(&unroll.targets(1.0)[..2], &[1.0 + 0.9 * 2.0, 2.0]));
}

#[test]
fn a_truncation_bootstraps_from_that_episodes_last_observation() {
    let unroll = Unroll {
        reward: vec![1.0, 2.0, 0.0, 4.0],
        discount: vec![1.0; 4],
        valid: vec![1.0, 1.0, 0.0, 1.0],
        values: vec![5.0, 5.0, 100.0, 5.0, 5.0],
    };
    assert!(close(&unroll.targets(1.0)[..2], &[1.0 + 0.9 * (2.0 + 0.9 * 100.0), 2.0 + 0.9 * 100.0]));
}

proptest! {
    #[test]
    fn targets_follow_their_definition(unroll in unroll(), lambda in 0f32..=1.0) {
        prop_assert!(close(&unroll.targets(f64::from(lambda)), &unroll.definition(lambda)));
    }

    #[test]
    fn lambda_zero_is_one_step(unroll in unroll()) {
        let targets = unroll.targets(0.0);
        for t in (0..targets.len()).filter(|t| unroll.valid[*t] == 1.0) {
            let expected = unroll.reward[t] + GAMMA as f32 * unroll.discount[t] * unroll.values[t + 1];
            prop_assert!(close(&targets[t..=t], &[expected]));
        }
    }

    #[test]
    fn a_step_across_an_episodes_boundary_has_no_influence(
        (unroll, boundary) in unroll().prop_flat_map(|unroll| { let steps = unroll.reward.len(); (Just(unroll), 1..steps) }),
        lambda in 0f64..=1.0,
        noise in -1e6f32..1e6,
    ) {
        let mut unroll = unroll;
        unroll.valid[boundary] = 0.0;
        let before = unroll.targets(lambda);
        let mut other = unroll;
        // The boundary row's own reward and discount, and everything after it.
        other.reward[boundary..].fill(noise);
        other.discount[boundary..].fill(0.5);
        other.values[boundary + 1..].fill(noise);
        prop_assert_eq!(&before[..=boundary], &other.targets(lambda)[..=boundary]);
    }
}
