//! Numbers of other code: rlax's `vmpo_loss`, PyTorch's distributions, rlax's returns.
//!
//! Reads every `vmpo_*.npz`, `gaussian_*.npz`, `mixture_*.npz`, `product_*.npz` and `returns_*.npz` of the folder that
//! COMIC_VMPO_FIXTURES names, by default `tests/fixtures/vmpo`. `tests/python/make_vmpo_fixtures.py` and
//! `make_distribution_fixtures.py` make them.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use std::path::{Path, PathBuf};

use comic_experiment::Prior;
use comic_learner::vmpo::{Evidence, KlLimits, Multipliers, policy_improvement, returns};
use comic_networks::{ActionDistribution, DiagonalGaussian};
use npyz::npz::NpzArchive;
use tch::{Device, Kind, Tensor};

/// Of the larger of 1 and the largest expected number of the array.
const TOLERANCE: f64 = 1e-5;

struct Fixture {
    path: PathBuf,
    archive: NpzArchive<std::io::BufReader<std::fs::File>>,
}

impl Fixture {
    fn open(path: &Path) -> Self {
        let archive = NpzArchive::open(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        Self { path: path.to_path_buf(), archive }
    }

    /// An array as float32, whatever float it was written as; `None` when the file has no such array.
    fn find(&mut self, name: &str) -> Option<Tensor> {
        let array =
            self.archive.by_name(name).unwrap_or_else(|error| panic!("{}: {name}: {error}", self.path.display()))?;
        let shape: Vec<i64> = array.shape().iter().map(|size| *size as i64).collect();
        let double = array.dtype().num_bytes() == Some(8);
        let values: Vec<f64> = if double {
            array.into_vec::<f64>().unwrap()
        } else {
            array.into_vec::<f32>().unwrap().into_iter().map(f64::from).collect()
        };
        assert!(values.iter().all(|value| value.is_finite()), "{}: {name} is not finite", self.path.display());
        Some(Tensor::from_slice(&values).to_kind(Kind::Float).reshape(shape))
    }

    fn array(&mut self, name: &str) -> Tensor {
        self.find(name).unwrap_or_else(|| panic!("{} has no array `{name}`", self.path.display()))
    }

    fn scalar(&mut self, name: &str) -> f64 {
        self.array(name).double_value(&[])
    }

    fn compare(&mut self, name: &str, found: &Tensor) {
        let expected = self.array(name);
        assert_eq!(found.size(), expected.size(), "{}: shape of {name}", self.path.display());
        let scale = expected.abs().max().double_value(&[]).max(1.0);
        let error = (found.detach() - &expected).abs().max().double_value(&[]);
        assert!(error <= TOLERANCE * scale, "{}: {name} is off by {error:e} at scale {scale}", self.path.display());
    }
}

/// Every fixture of one kind. A folder may lack a kind if it has fixtures of another kind.
fn fixtures(kind: &str) -> Vec<Fixture> {
    let named = std::env::var_os("COMIC_VMPO_FIXTURES").map(PathBuf::from);
    let own = named.is_none();
    let folder = named.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures/vmpo"));
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "npz"));
    files.sort();
    let is = |path: &Path, kind: &str| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(kind));
    let known = files
        .iter()
        .any(|path| ["vmpo_", "gaussian_", "returns_", "mixture_", "product_"].iter().any(|kind| is(path, kind)));
    assert!(known, "{} holds no fixture; tests/python/make_vmpo_fixtures.py makes them", folder.display());
    files.retain(|path| is(path, kind));
    assert!(!own || !files.is_empty(), "{} has lost its {kind}*.npz", folder.display());
    if files.is_empty() {
        eprintln!("{} holds no {kind}*.npz: that comparison is skipped", folder.display());
    }
    files.iter().map(|path| Fixture::open(path)).collect()
}

#[test]
fn losses_and_gradients_equal_rlax() {
    for mut fixture in fixtures("vmpo_") {
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
    for mut fixture in fixtures("gaussian_") {
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
            let prior = Prior::Ar1 { alpha: fixture.scalar("alpha") };
            let first = previous.select(-1, 0).zeros_like();
            fixture.compare("kl_ar1", &policy.kl_to_prior(&prior, &previous, &first));
        }
    }
}

#[test]
fn returns_equal_rlax_on_each_episodes_piece() {
    for mut fixture in fixtures("returns_") {
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
    for mut fixture in fixtures("mixture_") {
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
    for mut fixture in fixtures("product_") {
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
