//! Numbers of other code: rlax's `vmpo_loss`, PyTorch's distributions, rlax's returns.
//!
//! Reads every `vmpo_*.npz`, `gaussian_*.npz`, `mixture_*.npz`, `product_*.npz` and `returns_*.npz` of the folder that
//! COMIC_VMPO_FIXTURES names, by default `tests/fixtures/vmpo`. `tests/python/make_vmpo_fixtures.py` and
//! `make_distribution_fixtures.py` make them.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod fixture;

use comic_learner::vmpo::{Evidence, KlLimits, Multipliers, policy_improvement, returns};
use comic_networks::{ActionDistribution, DiagonalGaussian};
use fixture::{Fixture, Folder};
use tch::{Device, Kind, Tensor};

const FOLDER: Folder = Folder {
    variable: "COMIC_VMPO_FIXTURES",
    name: "vmpo",
    script: "make_vmpo_fixtures.py",
    kinds: &["vmpo_", "gaussian_", "returns_", "mixture_", "product_"],
};

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
            valid: &valid,
            groups: &groups,
        };
        let improvement = policy_improvement(&evidence, &multipliers, &limits);
        fixture.compare("policy_loss", &improvement.policy);
        fixture.compare("temperature_loss", &improvement.temperature);
        fixture.compare("alpha_loss", &improvement.alpha);
        let inputs = [log_prob, kl_mean, kl_std, multipliers.parameter()];
        let gradients = Tensor::run_backward(&[improvement.total()], &inputs, false, false);
        for (name, gradient) in ["grad_log_prob", "grad_kl_mean", "grad_kl_std"].into_iter().zip(&gradients) {
            fixture.compare(name, gradient);
        }
        for (index, name) in ["grad_temperature", "grad_alpha_mean", "grad_alpha_std"].into_iter().enumerate() {
            fixture.compare(name, &gradients[3].select(0, index as i64));
        }
    }
}

#[test]
fn gaussians_equal_pytorchs_distributions() {
    for mut fixture in FOLDER.fixtures("gaussian_") {
        let policy = DiagonalGaussian { mean: fixture.array("mean"), std: fixture.array("std") };
        let behaviour = DiagonalGaussian { mean: fixture.array("other_mean"), std: fixture.array("other_std") };
        let action = fixture.array("action");
        fixture.compare("log_prob", &policy.log_prob(&action));
        fixture.compare("entropy", &policy.entropy());
        fixture.compare("kl", &behaviour.kl(&policy));
        fixture.compare("kl_mean", &policy.kl_mean(&behaviour));
        fixture.compare("kl_std", &policy.kl_std(&behaviour));
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
    for mut fixture in FOLDER.fixtures("mixture_") {
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
        fixture.compare("kl_std", &kl_std);
        fixture.compare("kl_weights", &kl_weights);
        fixture.compare("expectation", &policy.mean());
        let total = (log_prob + kl_mean + kl_std + kl_weights).sum(Kind::Float);
        compare_gradients(&mut fixture, &total, &learnt);
    }
}

#[test]
fn products_equal_gaussian_distributions_computed_by_hand() {
    for mut fixture in FOLDER.fixtures("product_") {
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
        fixture.compare("kl_std", &kl_std);
        let total = (log_prob + kl_mean + kl_std).sum(Kind::Float);
        compare_gradients(&mut fixture, &total, &learnt);
    }
}
