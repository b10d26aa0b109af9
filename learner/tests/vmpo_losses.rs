//! Known mistakes of public V-MPO code, each with a number that shows the difference.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use comic_learner::algorithm::masked_mean::{ValidSteps, masked_mean};
use comic_learner::vmpo::{Evidence, Improvement, KlLimits, Multipliers, policy_improvement};
use comic_learner::world::World;
use comic_networks::DiagonalGaussian;
use proptest::prelude::*;
use tch::{Device, Kind, Tensor};

const LIMITS: KlLimits = KlLimits {
    epsilon_eta: 0.1,
    epsilon_mean: 0.2,
    epsilon_std: 0.3,
    epsilon_discrete: 0.4,
    top_fraction: 0.5,
    control_variate: 0.0,
};

/// Four steps, all valid by default. Every tensor can be differentiated.
struct Case {
    log_prob: Tensor,
    advantage: Tensor,
    kl_mean: Tensor,
    kl_std: Tensor,
    valid: Tensor,
    multipliers: Multipliers,
}

impl Case {
    fn new(advantage: &[f32]) -> Self {
        let steps = advantage.len() as i64;
        let learnt = |tensor: Tensor| tensor.set_requires_grad(true);
        let numbers = Tensor::arange(steps, (Kind::Float, Device::Cpu));
        Self {
            log_prob: learnt(&numbers * 0.5 - 1.0),
            advantage: learnt(Tensor::from_slice(advantage)),
            kl_mean: learnt(&numbers * 0.1),
            kl_std: learnt(&numbers * 0.3),
            valid: Tensor::ones([steps], (Kind::Float, Device::Cpu)),
            multipliers: Multipliers::new(&[1.0], &[2.0, 3.0], Device::Cpu),
        }
    }

    fn masked(mut self, valid: &[f32]) -> Self {
        self.valid = Tensor::from_slice(valid);
        self
    }

    fn losses(&self) -> Improvement {
        self.losses_with(&LIMITS, None)
    }

    fn losses_with(&self, limits: &KlLimits, kl: Option<&Tensor>) -> Improvement {
        let evidence = Evidence {
            log_prob: &self.log_prob,
            advantage: &self.advantage,
            kl_mean: &self.kl_mean,
            kl_std: &self.kl_std,
            kl_weights: None,
            kl,
            valid: &ValidSteps::alone(&self.valid),
            groups: &[self.valid.ones_like().to_kind(Kind::Bool)],
            world: &World::alone(),
        };
        policy_improvement(&evidence, &self.multipliers, limits)
    }

    fn gradient(&self, loss: &Tensor, input: &Tensor) -> Vec<f32> {
        let gradient = Tensor::run_backward(&[loss], &[input], true, false).remove(0);
        if gradient.defined() { values(&gradient) } else { vec![0.0; input.numel()] }
    }
}

fn values(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(tensor.detach().view(-1)).unwrap()
}

fn number(tensor: &Tensor) -> f32 {
    tensor.double_value(&[]) as f32
}

fn assert_close(found: f32, expected: f32) {
    assert!((found - expected).abs() <= 1e-5 * expected.abs().max(1.0), "{found} where {expected} is right");
}

#[test]
fn the_temperatures_divisor_is_the_top_half_not_the_batch() {
    // η ε + η ln((e + e) / 2); with the batch of four as divisor it would be ln 2 less.
    assert_close(number(&Case::new(&[1.0, 1.0, 0.0, -1.0]).losses().temperature), 0.1 + 1.0);
}

#[test]
fn the_policy_imitates_the_top_half_in_proportion_to_exp_advantage() {
    let case = Case::new(&[2.0, 0.0, 1.0, -3.0]);
    let (first, second) = (1f32.exp() / (1.0 + 1f32.exp()), 1.0 / (1.0 + 1f32.exp()));
    let losses = case.losses();
    // −Σ ψ ln π, with ln π of −1 and 0 at the two best steps.
    assert_close(number(&losses.policy), first);
    let gradient = case.gradient(&losses.policy, &case.log_prob);
    for (found, expected) in gradient.into_iter().zip([-first, 0.0, -second, 0.0]) {
        assert_close(found, expected);
    }
}

#[test]
fn no_gradient_flows_through_the_weights() {
    let case = Case::new(&[2.0, 0.0, 1.0, -3.0]);
    let losses = case.losses();
    // ψ depends on η and on A (so on the value function), and teaches neither.
    assert_eq!(case.gradient(&losses.policy, case.multipliers.parameter()), [0.0; 3]);
    assert_eq!(case.gradient(&losses.total(), &case.advantage), [0.0; 4]);
}

#[test]
fn alpha_learns_only_from_its_constraint_and_the_policy_only_from_the_penalty() {
    let case = Case::new(&[2.0, 0.0, 1.0, -3.0]);
    let losses = case.losses();
    let multipliers = case.gradient(&losses.alpha, case.multipliers.parameter());
    // Mean KLs are 0.15 and 0.45, one below its limit and one above: dL/dα = ε − KL, without the penalty's + KL.
    assert_close(multipliers[1], 0.2 - 0.15);
    assert_close(multipliers[2], 0.3 - 0.45);
    // dL/dKL = α / N, without the constraint's − α / N.
    case.gradient(&losses.alpha, &case.kl_mean).into_iter().for_each(|gradient| assert_close(gradient, 2.0 / 4.0));
    case.gradient(&losses.alpha, &case.kl_std).into_iter().for_each(|gradient| assert_close(gradient, 3.0 / 4.0));
}

#[test]
fn the_temperature_learns_only_from_its_own_loss() {
    let case = Case::new(&[2.0, 0.0, 1.0, -3.0]);
    let losses = case.losses();
    let own = case.gradient(&losses.temperature, case.multipliers.parameter())[0];
    let all = case.gradient(&losses.total(), case.multipliers.parameter())[0];
    assert_eq!(own, all);
    assert!(own != 0.0);
}

#[test]
fn the_top_half_is_of_the_valid_steps() {
    // Of six steps two are masked: two of the four others are the top half, not three, and not the masked best.
    let case = Case::new(&[9.0, 1.0, 1.0, 0.0, -1.0, 8.0]).masked(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0]);
    let losses = case.losses();
    assert_close(number(&losses.temperature), 0.1 + 1.0);
    let selected: Vec<bool> = case.gradient(&losses.policy, &case.log_prob).iter().map(|value| *value != 0.0).collect();
    assert_eq!(selected, [false, true, true, false, false, false]);
}

#[test]
fn masked_steps_may_hold_anything() {
    let plain = Case::new(&[2.0, 0.0, 1.0, -3.0]).masked(&[1.0, 1.0, 1.0, 0.0]);
    let mut wild = Case::new(&[2.0, 0.0, 1.0, f32::NAN]).masked(&[1.0, 1.0, 1.0, 0.0]);
    let nan = Tensor::from_slice(&[0.0, 0.0, 0.0, f32::NAN]);
    wild.log_prob = (plain.log_prob.detach() + &nan).set_requires_grad(true);
    wild.kl_mean = (plain.kl_mean.detach() + &nan).set_requires_grad(true);
    wild.kl_std = (plain.kl_std.detach() + &nan).set_requires_grad(true);
    let (plain_losses, wild_losses) = (plain.losses(), wild.losses());
    assert_eq!(number(&plain_losses.total()), number(&wild_losses.total()));
    for (left, right) in
        [(&plain.log_prob, &wild.log_prob), (&plain.kl_mean, &wild.kl_mean), (&plain.kl_std, &wild.kl_std)]
    {
        assert_eq!(plain.gradient(&plain_losses.total(), left), wild.gradient(&wild_losses.total(), right));
    }
    let [plain, wild] = [(&plain, plain_losses), (&wild, wild_losses)]
        .map(|(case, losses)| case.gradient(&losses.total(), case.multipliers.parameter()));
    assert_eq!(plain, wild);
}

#[test]
fn large_advantages_and_tiny_temperatures_do_not_overflow() {
    let mut case = Case::new(&[2000.0, 1999.0, -2000.0, -1e4]);
    case.multipliers = Multipliers::new(&[1e-8], &[1.0, 1.0], Device::Cpu);
    let losses = case.losses();
    assert!(number(&losses.total()).is_finite());
    assert!(case.gradient(&losses.total(), case.multipliers.parameter()).iter().all(|value| value.is_finite()));
}

#[test]
fn the_mean_over_no_step_is_zero() {
    let none = Tensor::zeros([3], (Kind::Float, Device::Cpu));
    assert_eq!(number(&masked_mean(&Tensor::from_slice(&[1f32, 2.0, 3.0]), &none)), 0.0);
}

proptest! {
    #[test]
    fn the_weights_are_a_distribution_over_the_top_half(
        advantage in prop::collection::vec(-5f32..5.0, 1..40),
    ) {
        let case = Case::new(&advantage);
        let losses = case.losses();
        let weights: Vec<f32> = case.gradient(&losses.policy, &case.log_prob).iter().map(|value| -value).collect();
        prop_assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        // A step belongs to the top half when fewer steps than that are better, or when it ties with the last of them.
        let half = (advantage.len() / 2).max(1);
        for (value, weight) in advantage.iter().zip(&weights) {
            let better = advantage.iter().filter(|other| *other > value).count();
            prop_assert_eq!(*weight > 0.0, better < half);
        }
    }

    #[test]
    fn the_order_of_steps_does_not_matter(
        advantage in prop::collection::vec((-3i8..3).prop_map(f32::from), 2..30),
    ) {
        // Whole numbers: ties are frequent, and a rank would break them by position.
        let forward = Case::new(&advantage);
        let mut backward = Case::new(&advantage.iter().rev().copied().collect::<Vec<_>>());
        backward.log_prob = forward.log_prob.detach().flip([0]);
        let (left, right) = (forward.losses(), backward.losses());
        prop_assert!((number(&left.policy) - number(&right.policy)).abs() < 1e-5);
        prop_assert!((number(&left.temperature) - number(&right.temperature)).abs() < 1e-5);
    }
}

#[test]
fn each_group_has_its_own_e_step_and_its_losses_are_weighted_by_its_steps() {
    let case = Case::new(&[2.0, 300.0, 0.0, 100.0, 1.0, -3.0]);
    let of = |members: [bool; 6]| Tensor::from_slice(&members);
    let groups = [of([true, false, true, false, true, true]), of([false, true, false, true, false, false])];
    let losses = |groups: &[Tensor], temperatures: &[f32], valid: &Tensor| {
        let evidence = Evidence {
            log_prob: &case.log_prob,
            advantage: &case.advantage,
            kl_mean: &case.kl_mean,
            kl_std: &case.kl_std,
            kl_weights: None,
            kl: None,
            valid: &ValidSteps::alone(valid),
            groups,
            world: &World::alone(),
        };
        let multipliers = Multipliers::new(temperatures, &[2.0, 3.0], Device::Cpu);
        let losses = policy_improvement(&evidence, &multipliers, &LIMITS);
        let eta = Tensor::run_backward(&[&losses.temperature], &[multipliers.parameter()], true, false).remove(0);
        (number(&losses.policy), number(&losses.temperature), values(&eta))
    };
    let both = losses(&groups, &[1.0, 50.0], &case.valid);
    let alone = |group: &Tensor, eta: f32| {
        let valid = group.to_kind(Kind::Float);
        losses(&[group.shallow_clone()], &[eta], &valid)
    };
    let (first, second) = (alone(&groups[0], 1.0), alone(&groups[1], 50.0));
    let share = |first: f32, second: f32| first * 4.0 / 6.0 + second * 2.0 / 6.0;
    assert_close(both.0, share(first.0, second.0));
    assert_close(both.1, share(first.1, second.1));
    assert_close(both.2[0], first.2[0] * 4.0 / 6.0);
    assert_close(both.2[1], second.2[0] * 2.0 / 6.0);
    // A group without a step does not change its temperature.
    assert_eq!(losses(&groups, &[1.0, 50.0], &groups[0].to_kind(Kind::Float)).2[1], 0.0);
}

proptest! {
    /// ln π is quadratic in the action, so its mean over μ_old ± σ_old is its mean under the behaviour policy.
    #[test]
    fn the_control_variates_expected_gradient_is_zero(
        old in prop::collection::vec((-0.2f32..0.2, 0.2f32..0.5), 4),
        new in prop::collection::vec((-0.2f32..0.2, 0.2f32..0.5), 4),
    ) {
        let split = |pairs: &[(f32, f32)]| {
            let (mean, std): (Vec<f32>, Vec<f32>) = pairs.iter().copied().unzip();
            DiagonalGaussian { mean: Tensor::from_slice(&mean), std: Tensor::from_slice(&std) }
        };
        let (old, mut new) = (split(&old), split(&new));
        new.mean = new.mean.set_requires_grad(true);
        new.std = new.std.set_requires_grad(true);
        let actions = Tensor::stack(&[&old.mean + &old.std, &old.mean - &old.std], 0);
        let kl = old.kl(&new).expand([2], false);
        let log_prob = new.log_prob(&actions);
        let loss = |control_variate: f64| {
            let mut case = Case::new(&[0.0, 0.0]);
            case.log_prob = log_prob.shallow_clone();
            case.losses_with(&KlLimits { control_variate, ..LIMITS }, Some(&kl)).policy
        };
        let variate = loss(1.0) - loss(0.0);
        for gradient in Tensor::run_backward(&[&variate], &[&new.mean, &new.std], false, false) {
            for (index, found) in values(&gradient).into_iter().enumerate() {
                prop_assert!(found.abs() < 1e-3, "{}: {}", index, found);
            }
        }
    }
}
