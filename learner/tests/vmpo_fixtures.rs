//! Numbers of other code: rlax's `vmpo_loss`, PyTorch's distributions, rlax's returns.
//!
//! Reads every `vmpo_*.npz`, `gaussian_*.npz`, `mixture_*.npz`, `product_*.npz` and `returns_*.npz` of the folder that
//! COMIC_VMPO_FIXTURES names, by default `tests/fixtures/vmpo`. `tests/python/make_vmpo_fixtures.py` and
//! `make_distribution_fixtures.py` make them.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod fixture;

use comic_learner::algorithm::masked_mean::ValidSteps;
use comic_learner::vmpo::{Evidence, KlLimits, Multipliers, policy_improvement, returns};
use comic_learner::world::World;
use comic_networks::{ActionDistribution, DiagonalGaussian};
use fixture::{Fixture, Folder, agree};
use tch::{Device, Kind, Tensor};

const FOLDER: Folder = Folder {
    variable: "COMIC_VMPO_FIXTURES",
    name: "vmpo",
    script: "make_vmpo_fixtures.py",
    kinds: &["vmpo_", "gaussian_", "returns_", "mixture_", "product_"],
};

/// PyTorch's numbers are float64. In that precision divergences of 1e-7 are compared to five digits, too. Training computes in
/// float32, where rounding leaves little of them.
const PRECISIONS: [Kind; 2] = [Kind::Double, Kind::Float];

/// The size of the terms in the divergences that are differences, per dimension ½ (σ_old² / σ² − 1) − ln(σ_old / σ). Where the
/// distributions are near, these terms are much larger than their sum.
const TERMS: f64 = 1.0;

#[test]
fn losses_and_gradients_equal_rlax() {
    for mut fixture in FOLDER.fixtures("vmpo_") {
        let learnt = ["log_prob", "kl_mean", "kl_std"].map(|name| fixture.array(name).set_requires_grad(true));
        let [log_prob, kl_mean, kl_std] = &learnt;
        let advantage = fixture.array("advantage");
        let [temperature, alpha_mean, alpha_std] =
            ["temperature", "alpha_mean", "alpha_std"].map(|name| fixture.scalar(name) as f32);
        let multipliers = Multipliers::new(&[temperature], &[alpha_mean, alpha_std], Device::Cpu);
        let limits = KlLimits {
            epsilon_eta: fixture.scalar("epsilon_eta"),
            epsilon_mean: fixture.scalar("epsilon_mean"),
            epsilon_std: fixture.scalar("epsilon_std"),
            epsilon_discrete: 1e-3,
            top_fraction: fixture.scalar("top_fraction"),
            control_variate: 0.0,
        };
        let valid = advantage.ones_like();
        let groups = [valid.to_kind(Kind::Bool)];
        let evidence = Evidence {
            log_prob,
            advantage: &advantage,
            kl_mean,
            kl_std,
            kl_weights: None,
            kl: None,
            valid: &ValidSteps::alone(&valid),
            groups: &groups,
            world: &World::alone(),
        };
        let improvement = policy_improvement(&evidence, &multipliers, &limits);
        fixture.compare("policy_loss", &improvement.policy);
        // η ln(mean of exp(A / η)), and its derivative, which is the difference of this and of the mean of A / η.
        let largest = advantage.abs().max().double_value(&[]);
        fixture.compare_difference("temperature_loss", &improvement.temperature, largest);
        fixture.compare("alpha_loss", &improvement.alpha);
        let inputs = [log_prob, kl_mean, kl_std, multipliers.parameter()];
        let gradients = Tensor::run_backward(&[improvement.total()], &inputs, false, false);
        for (name, gradient) in ["grad_log_prob", "grad_kl_mean", "grad_kl_std"].into_iter().zip(&gradients) {
            fixture.compare(name, gradient);
        }
        let multipliers = [
            ("grad_temperature", largest / f64::from(temperature)),
            // ε − the mean KL.
            ("grad_alpha_mean", limits.epsilon_mean),
            ("grad_alpha_std", limits.epsilon_std),
        ];
        for (index, (name, terms)) in multipliers.into_iter().enumerate() {
            fixture.compare_difference(name, &gradients[3].select(0, index as i64), terms);
        }
    }
}

#[test]
fn gaussians_equal_pytorchs_distributions() {
    for mut fixture in PRECISIONS.into_iter().flat_map(|precision| FOLDER.fixtures_in(precision, "gaussian_")) {
        let policy = DiagonalGaussian { mean: fixture.array("mean"), std: fixture.array("std") };
        let behaviour = DiagonalGaussian { mean: fixture.array("other_mean"), std: fixture.array("other_std") };
        let action = fixture.array("action");
        fixture.compare("log_prob", &policy.log_prob(&action));
        fixture.compare("entropy", &policy.entropy());
        fixture.compare_difference("kl", &behaviour.kl(&policy), TERMS);
        fixture.compare("kl_mean", &policy.kl_mean(&behaviour));
        fixture.compare_difference("kl_std", &policy.kl_std(&behaviour), TERMS);
        fixture.compare("kl_standard", &policy.kl_to_standard_normal());
        if let Some(previous) = fixture.find("previous") {
            let alpha = fixture.scalar("alpha");
            let first = previous.select(-1, 0).zeros_like();
            fixture.compare("kl_ar1", &policy.kl_to_ar1(alpha, &previous, &first));
        }
    }
}

#[test]
fn returns_equal_rlax_on_each_episodes_piece() {
    for mut fixture in FOLDER.fixtures("returns_") {
        let arrays = ["reward", "discount", "valid", "values"].map(|name| fixture.array(name));
        let [reward, discount, valid, values] = &arrays;
        let gamma = fixture.scalar("gamma");
        fixture.compare("returns", &returns(reward, discount, valid, values, gamma, 1.0));
    }
}

/// The arrays with gradients.
const LEARNT: [&str; 3] = ["logits", "mean", "std"];

fn log_softmax(logits: &Tensor) -> Tensor {
    logits.log_softmax(-1, None::<Kind>)
}

fn compare_gradients(fixture: &mut Fixture, total: &Tensor, learnt: &[Tensor; 3]) {
    let gradients = Tensor::run_backward(&[total], learnt, false, false);
    for (name, gradient) in LEARNT.into_iter().zip(&gradients) {
        fixture.compare(&format!("grad_{name}"), gradient);
    }
}

#[test]
fn mixtures_equal_pytorchs_distributions() {
    for mut fixture in PRECISIONS.into_iter().flat_map(|precision| FOLDER.fixtures_in(precision, "mixture_")) {
        let learnt = LEARNT.map(|name| fixture.array(name).set_requires_grad(true));
        let [logits, mean, std] = &learnt;
        let components = DiagonalGaussian { mean: mean.shallow_clone(), std: std.shallow_clone() };
        let policy = ActionDistribution::Mixture { log_weights: log_softmax(logits), components };
        let components = DiagonalGaussian { mean: fixture.array("old_mean"), std: fixture.array("old_std") };
        let behaviour =
            ActionDistribution::Mixture { log_weights: log_softmax(&fixture.array("old_logits")), components };
        let log_prob = policy.log_prob(&fixture.array("action"));
        let (kl_mean, kl_std) = (policy.kl_mean(&behaviour), policy.kl_std(&behaviour));
        let kl_weights = policy.kl_weights(&behaviour).unwrap();
        fixture.compare("log_prob", &log_prob);
        fixture.compare("kl_mean", &kl_mean);
        fixture.compare_difference("kl_std", &kl_std, TERMS);
        // The sum of w_old (ln w_old − ln w), where each ln w is rounded as its logit is.
        let [logit, old_logit] = ["logits", "old_logits"].map(|name| fixture.array(name).abs().max().double_value(&[]));
        fixture.compare_difference("kl_weights", &kl_weights, logit.max(old_logit));
        fixture.compare("expectation", &policy.mean());
        let total = (log_prob + kl_mean + kl_std + kl_weights).sum(None::<Kind>);
        compare_gradients(&mut fixture, &total, &learnt);
    }
}

#[test]
fn products_equal_gaussian_distributions_computed_by_hand() {
    for mut fixture in PRECISIONS.into_iter().flat_map(|precision| FOLDER.fixtures_in(precision, "product_")) {
        let learnt = LEARNT.map(|name| fixture.array(name).set_requires_grad(true));
        let [logits, mean, std] = &learnt;
        let primitives = DiagonalGaussian { mean: mean.shallow_clone(), std: std.shallow_clone() };
        let product = primitives.product(&logits.sigmoid());
        let primitives = DiagonalGaussian { mean: fixture.array("old_mean"), std: fixture.array("old_std") };
        let behaviour = primitives.product(&fixture.array("old_logits").sigmoid());
        fixture.compare("product_mean", &product.mean);
        fixture.compare("product_std", &product.std);
        let log_prob = product.log_prob(&fixture.array("action"));
        let (kl_mean, kl_std) = (product.kl_mean(&behaviour), product.kl_std(&behaviour));
        fixture.compare("log_prob", &log_prob);
        fixture.compare("kl_mean", &kl_mean);
        fixture.compare_difference("kl_std", &kl_std, TERMS);
        let total = (log_prob + kl_mean + kl_std).sum(None::<Kind>);
        compare_gradients(&mut fixture, &total, &learnt);
    }
}

/// Numbers of a gradient: float32, of both signs, and zeros.
fn gradient(scale: f64) -> Tensor {
    (Tensor::from_slice(&[1.0, -0.7, 0.3, 0.0, 1e-3]) * scale).to_kind(Kind::Float)
}

/// From the smallest gradients of the fixtures to the largest losses. `terms` 0 is the comparison of a sum, 1 that of a difference.
const CASES: [(f64, f64); 7] = [(1e-8, 0.0), (1e-8, 1.0), (1e-5, 0.0), (1e-5, 1.0), (1.0, 0.0), (1.0, 1.0), (1e3, 0.0)];

#[test]
fn the_comparison_detects_zeros_and_a_wrong_sign_at_every_scale() {
    for (scale, terms) in CASES {
        let expected = gradient(scale);
        agree(&expected, &expected, terms).unwrap();
        for wrong in [expected.zeros_like(), -&expected, &expected * f64::NAN, expected.select(0, 0)] {
            assert!(agree(&expected, &wrong, terms).is_err(), "{wrong} for {expected}, terms of {terms}");
        }
    }
}

#[test]
fn the_comparison_detects_one_wrong_number_at_every_scale() {
    for (scale, _) in CASES {
        let expected = gradient(scale);
        for (index, wrong) in [(0, 1.0001), (1, -0.7001), (2, 0.0), (2, -0.3), (3, 1e-5), (4, 0.0), (4, -1e-3)] {
            let found = expected.copy();
            let _ = found.select(0, index).fill_(wrong * scale);
            assert!(agree(&expected, &found, 0.0).is_err(), "{found} for {expected}");
        }
    }
}

#[test]
fn the_comparison_allows_what_float32_rounds() {
    for (scale, _) in CASES {
        let expected = gradient(scale);
        let epsilon = f64::from(f32::EPSILON);
        agree(&expected, &(&expected * (1.0 + 4.0 * epsilon)), 0.0).unwrap();
        // A sum of terms as large as the largest number, and a small one of terms a thousand times its size.
        agree(&expected, &(&expected + 2.0 * epsilon * scale), 0.0).unwrap();
        agree(&expected, &(&expected + 2.0 * epsilon * 1e3 * scale), 1e3 * scale).unwrap();
    }
}
