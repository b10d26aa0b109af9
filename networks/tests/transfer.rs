//! Transfer: a frozen low level acts as the policy it was taken from, and a new policy with it is one exported file.

#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

use std::collections::{BTreeMap, HashMap};

use comic_experiment::{Experiment, LowLevelName, TaskSpec, Transfer, TransferPrior, resolve};
use comic_networks::export::{Exported, FittedPrior, KEY, Source};
use comic_networks::{Error, Policy, RecurrentState, Routing, StatePrior, new_policy, to_safetensors};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use sha2::{Digest as _, Sha256};
use tch::{CModule, Device, Kind, Tensor, nn};

/// libtorch has one generator per process, so tests that seed it must not run at the same time.
static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// A preset with small networks.
fn small(preset: &str, more: &[&str]) -> Experiment {
    let sizes = [
        "network.encoder=[8]",
        "network.mlp.hidden=[8]",
        "network.lstm.units=[6,5]",
        "network.primitives.count=3",
        "network.primitives.torso=[8]",
        "network.primitives.hidden=6",
        "network.primitives.gate=[7]",
        "network.latent.size=4",
        "network.normaliser_steps=1",
        "network.policy_head_scale=1",
        "network.initial_pose=mid-range",
    ];
    let overrides: Vec<String> = sizes.iter().chain(more).map(|field| (*field).to_string()).collect();
    resolve(preset, &overrides).unwrap()
}

/// A policy of the experiment with random parameters, statistics included.
fn policy(experiment: &Experiment) -> (nn::VarStore, Box<dyn Policy>, TaskSpec) {
    tch::manual_seed(1);
    let spec = TaskSpec::new(experiment, Vec::new()).unwrap();
    let store = nn::VarStore::new(Device::Cpu);
    let policy = new_policy(&store.root(), &spec, experiment, &vec![0.0; spec.action]).unwrap();
    for (name, tensor) in store.variables().into_iter().collect::<BTreeMap<_, _>>() {
        let mut noise = tensor.detach().rand_like() * 0.5 - 0.25;
        if name.ends_with("_std") {
            noise += 1.0;
        }
        tch::no_grad(|| tensor.shallow_clone().copy_(&noise));
    }
    (store, policy, spec)
}

fn exported(part: &str, experiment: &Experiment, low_level: Option<&[u8]>) -> Result<Exported, Error> {
    let (store, ..) = policy(experiment);
    let parameters = to_safetensors(&store).unwrap();
    Exported::new(part.parse().unwrap(), experiment, Source::default(), &parameters, low_level)
}

/// Go-to-target with this frozen low level.
fn transfer(low_level: &Exported, more: &[&str]) -> Experiment {
    let sha256 = format!("transfer.sha256={}", hex::encode(Sha256::digest(&low_level.bytes)));
    let fields = ["transfer.low_level=low_level.safetensors", sha256.as_str()];
    let mut experiment = small("go-to-target", &[&fields[..], more].concat());
    low_level.describe_low_level(&mut experiment.network).unwrap();
    experiment
}

fn random(rows: i64, width: usize) -> Tensor {
    Tensor::randn([rows, width as i64], (Kind::Float, Device::Cpu))
}

fn difference(one: &Tensor, other: &Tensor) -> f64 {
    (one - other).abs().max().double_value(&[])
}

/// The policy's own low level acts on the latent that its encoder sampled.
#[test]
fn a_frozen_low_level_acts_as_the_policy_it_was_taken_from() {
    let _guard = GENERATOR.lock().unwrap();
    for low_level in LowLevelName::ALL {
        for normaliser in [0, 1] {
            let name = format!("network.low_level={low_level}");
            let steps = format!("network.normaliser_steps={normaliser}");
            let experiment = small("tracking-mlp", &[&name, &steps]);
            let (store, policy, spec) = policy(&experiment);
            let parameters = to_safetensors(&store).unwrap();
            let part = "low-level".parse().unwrap();
            let file = Exported::new(part, &experiment, Source::default(), &parameters, None).unwrap();
            let frozen = file.freeze_for(&transfer(&file, &["transfer.latent_limit=100"])).unwrap();
            let state = random(3, experiment.network.state_size()) * 0.1;
            let (proprioception, task) = (random(3, spec.proprioception), random(3, spec.task));
            let observation = policy.normalise(&proprioception, &task, None, &Routing::single());
            let recurrent = RecurrentState { state: &state, first: None };
            let acting = policy.act(&observation, &random(3, 4), &random(3, 4), recurrent);
            let (action, next) = frozen.act(&acting.latent.detach(), &proprioception, &state);
            assert!(difference(&action, &acting.action.mode()) < 1e-6, "{low_level}, normaliser {normaliser}");
            assert_eq!(frozen.state_size(), experiment.network.state_size());
            assert_eq!(next.size(), acting.state.size());
            if frozen.state_size() > 0 {
                assert!(difference(&next, &acting.state) < 1e-6, "{low_level}");
            }
            assert!(!action.requires_grad(), "a frozen low level has no gradient");
        }
    }
}

/// c · ∂command/∂action against central differences of c · command, for each low level, with and without a prior of the state.
#[test]
fn the_derivative_with_respect_to_the_action_is_that_of_the_command() {
    let _guard = GENERATOR.lock().unwrap();
    for low_level in LowLevelName::ALL {
        for prior in [TransferPrior::Standard, TransferPrior::State] {
            let name = format!("network.low_level={low_level}");
            let experiment = small("tracking-mlp", &[&name, "network.latent.prior={state={hidden=[6]}}"]);
            let file = exported("low-level", &experiment, None).unwrap();
            let frozen = file.freeze(&Transfer { prior, latent_limit: 100.0, ..Transfer::default() }).unwrap();
            let (action, state) = (random(3, 4), random(3, experiment.network.state_size()) * 0.1);
            let (proprioception, along) =
                (random(3, comic_experiment::PROPRIOCEPTION_SIZE), random(3, comic_experiment::ACTION_SIZE));
            let found = frozen.action_derivatives(&action, &proprioception, &state, &along).unwrap();
            assert_eq!(found.size(), [3, 4]);
            if low_level == LowLevelName::Mixture {
                assert_eq!(found.abs().max().double_value(&[]), 0.0, "the latent only chooses the component");
                continue;
            }
            for entry in 0..4 {
                let step = Tensor::zeros([3, 4], (Kind::Float, Device::Cpu));
                let _ = step.select(1, entry).fill_(1e-2);
                let at = |action: Tensor| {
                    let (command, _) = frozen.act(&action, &proprioception, &state);
                    (command * &along).sum_dim_intlist(1, false, Kind::Double)
                };
                let expected = (at(&action + &step) - at(&action - &step)) / 2e-2;
                let error = difference(&found.select(1, entry).to_kind(Kind::Double), &expected);
                let size = expected.abs().max().double_value(&[]);
                // The differences of float32 numbers have an error of their own.
                assert!(size > 1e-4 && error < 0.02 * size + 1e-4, "{low_level}, {prior:?}: {error} of {size}");
            }
        }
    }
}

/// A prior that was learned with the encoder is in the file of the low level, and a fit afterwards replaces it.
#[test]
fn a_learned_prior_is_the_one_that_acting_used() {
    let _guard = GENERATOR.lock().unwrap();
    let experiment = small("tracking-mlp", &["network.latent.prior={state={hidden=[6]}}"]);
    let (store, policy, spec) = policy(&experiment);
    let parameters = to_safetensors(&store).unwrap();
    let file = Exported::new("low-level".parse().unwrap(), &experiment, Source::default(), &parameters, None).unwrap();
    assert_eq!(file.spec.prior.as_ref().map(|prior| &prior.hidden[..]), Some(&[6][..]));
    let transfer = |prior| Transfer { prior, latent_limit: 100.0, ..Transfer::default() };
    let (proprioception, task, none) = (random(3, spec.proprioception), random(3, spec.task), random(3, 0));
    let observation = policy.normalise(&proprioception, &task, None, &Routing::single());
    let recurrent = RecurrentState { state: &none, first: None };
    let acting = policy.act(&observation, &random(3, 4), &random(3, 4), recurrent);
    let prior = acting.latent_prior.unwrap();
    let deviation = random(3, 4);
    let (expected, _) =
        file.freeze(&transfer(TransferPrior::Standard)).unwrap().act(&prior.sample(&deviation), &proprioception, &none);
    let (found, _) = file.freeze(&transfer(TransferPrior::State)).unwrap().act(&deviation, &proprioception, &none);
    assert!(difference(&found, &expected) < 1e-6);

    let store = nn::VarStore::new(Device::Cpu);
    let fitted = StatePrior::new(&(store.root() / "prior"), spec.proprioception, &experiment.network, &[5]);
    let entry = FittedPrior { hidden: vec![5], latents: 9, nats: Some(0.0), standard_nats: Some(0.0) };
    let file = Exported::read(file.with_prior(entry, &store).unwrap().bytes).unwrap();
    let standard = file.freeze(&transfer(TransferPrior::Standard)).unwrap();
    let latent = fitted.forward(&standard.normalise(&proprioception)).sample(&deviation);
    let (expected, _) = standard.act(&latent, &proprioception, &none);
    let (found, _) = file.freeze(&transfer(TransferPrior::State)).unwrap().act(&deviation, &proprioception, &none);
    assert!(difference(&found, &expected) < 1e-6);
}

#[test]
fn latents_beyond_the_limit_act_as_the_limit() {
    let _guard = GENERATOR.lock().unwrap();
    let file = exported("low-level", &small("tracking-mlp", &[]), None).unwrap();
    let frozen = file.freeze_for(&transfer(&file, &["transfer.latent_limit=0.5"])).unwrap();
    let (proprioception, state) = (random(1, comic_experiment::PROPRIOCEPTION_SIZE), random(1, 0));
    let act = |latent: [f32; 4]| frozen.act(&Tensor::from_slice(&latent).view([1, 4]), &proprioception, &state).0;
    assert_eq!(difference(&act([9.0, -9.0, 0.25, 0.5]), &act([0.5, -0.5, 0.25, 0.5])), 0.0);
    assert!(difference(&act([0.5, -0.5, 0.25, 0.5]), &act([0.25, -0.5, 0.25, 0.5])) > 0.0);
}

#[test]
fn the_new_policy_acts_on_the_latent_and_its_mean_is_bounded() {
    let _guard = GENERATOR.lock().unwrap();
    let file = exported("low-level", &small("tracking-mlp", &[]), None).unwrap();
    let experiment = transfer(&file, &["transfer.mean_scale=2"]);
    let (store, policy, spec) = policy(&experiment);
    assert_eq!((spec.action, experiment.latent_size(), experiment.state_size()), (4, 0, 0));
    assert!(store.variables().keys().all(|name| !name.starts_with("low_level") && !name.starts_with("encoder")));
    let observation =
        policy.normalise(&(random(8, spec.proprioception) * 100.0), &random(8, spec.task), None, &Routing::single());
    let none = random(8, 0);
    let acting = policy.act(&observation, &none, &none, RecurrentState { state: &none, first: None });
    let (mean, std, weights) = acting.action.to_rows();
    assert_eq!((mean.size(), std.size(), acting.latent.size()), (vec![8, 4], vec![8, 4], vec![8, 0]));
    assert!(weights.is_none() && acting.latent_posterior.is_none());
    assert!(mean.abs().max().double_value(&[]) <= 2.0);
    let loss = mean.sum(Kind::Float) + std.sum(Kind::Float);
    loss.backward();
    let moved = store.trainable_variables().iter().filter(|variable| variable.grad().defined()).count();
    assert!(moved > 0, "the new policy learns");
}

#[test]
fn policy_and_low_level_are_one_file_and_one_script() {
    let _guard = GENERATOR.lock().unwrap();
    for low_level in [LowLevelName::Mlp, LowLevelName::Lstm] {
        let name = format!("network.low_level={low_level}");
        let file = exported("low-level", &small("tracking-mlp", &[&name]), None).unwrap();
        let experiment = transfer(&file, &[]);
        let composed = exported("policy", &experiment, Some(&file.bytes)).unwrap();
        let again = Exported::read(composed.bytes.clone()).unwrap();
        assert_eq!(again.low_level_file().unwrap(), Some(&file.bytes[..]), "the file inside is unchanged");
        let size = |name: &str| {
            let vectors = again.spec.inputs.iter().chain(&again.spec.outputs);
            vectors.filter(|vector| vector.name == name).map(|vector| vector.size).next_back()
        };
        let state_size = experiment.network.state_size();
        assert_eq!((size("action"), size("recurrent_state")), (Some(56), Some(state_size)));

        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("policy.pt");
        again.save_script(&path).unwrap();
        let script = CModule::load(&path).unwrap();
        let (_, policy, spec) = policy(&experiment);
        let frozen = file.freeze_for(&experiment).unwrap();
        let mut state = Tensor::zeros([1, state_size as i64], (Kind::Float, Device::Cpu));
        for _ in 0..3 {
            let (proprioception, task) = (random(1, spec.proprioception), random(1, spec.task));
            let output = script.forward_ts(&[&proprioception, &task, &state]).unwrap();
            let observation = policy.normalise(&proprioception, &task, None, &Routing::single());
            let none = random(1, 0);
            let acting = policy.act(&observation, &none, &none, RecurrentState { state: &none, first: None });
            let (action, next) = frozen.act(&acting.action.mode(), &proprioception, &state);
            let expected = Tensor::cat(&[action.clamp(-1.0, 1.0), next.shallow_clone()], 1);
            assert!(difference(&output, &expected) < 1e-6, "{low_level}");
            state = next;
        }
    }
}

#[test]
fn what_cannot_be_frozen_is_refused_with_the_reason() {
    let _guard = GENERATOR.lock().unwrap();
    let tracking = small("tracking-mlp", &[]);
    let low_level = exported("low-level", &tracking, None).unwrap();
    let experiment = transfer(&low_level, &[]);
    let refused = |file: &Exported| file.freeze_for(&experiment).unwrap_err().to_string();
    assert!(refused(&exported("policy", &tracking, None).unwrap()).contains("--part low-level"));
    let wider = exported("low-level", &small("tracking-mlp", &["network.latent.size=5"]), None).unwrap();
    assert!(refused(&wider).contains("other sizes than the experiment"));
    let bare = ["network.low_level=mixture", "network.latent.size=0"];
    let bare = exported("low-level", &small("tracking-mixture", &bare), None).unwrap();
    assert!(refused(&bare).contains("network.latent.size = 0"));
    for part in ["low-level", "encoder:go-to-target"] {
        let error = exported(part, &experiment, Some(&low_level.bytes)).unwrap_err();
        assert!(error.to_string().contains("frozen low level"), "{error}");
    }
}

#[test]
fn a_transfers_policy_without_its_low_level_or_with_another_one_is_refused() {
    let _guard = GENERATOR.lock().unwrap();
    let low_level = exported("low-level", &small("tracking-mlp", &[]), None).unwrap();
    let experiment = transfer(&low_level, &[]);
    let error = exported("policy", &experiment, None).unwrap_err();
    assert!(error.to_string().contains("low_level_file"), "{error}");
    let mut other = low_level.bytes.clone();
    *other.last_mut().unwrap() ^= 1;
    let error = exported("policy", &experiment, Some(&other)).unwrap_err();
    assert!(error.to_string().contains("SHA-256"), "{error}");
}

/// A file that holds a transfer's policy as its low level, which holds another one, and so on, ends at the first.
#[test]
fn a_policy_inside_a_policy_is_refused() {
    let _guard = GENERATOR.lock().unwrap();
    let low_level = exported("low-level", &small("tracking-mlp", &[]), None).unwrap();
    let inner = exported("policy", &transfer(&low_level, &[]), Some(&low_level.bytes)).unwrap();
    // The outer file names the inner one by its right hash.
    let right = hex::encode(Sha256::digest(&low_level.bytes));
    let document = SafeTensors::deserialize(&inner.bytes).unwrap();
    let (_, metadata) = SafeTensors::read_metadata(&inner.bytes).unwrap();
    let text = metadata.metadata().clone().unwrap()[KEY].clone();
    let text = text.replace(&right, &hex::encode(Sha256::digest(&inner.bytes)));
    let views = document.tensors().into_iter().map(|(name, view)| match name.as_str() {
        "low_level_file" => (name, TensorView::new(Dtype::U8, vec![inner.bytes.len()], &inner.bytes).unwrap()),
        _ => (name, view),
    });
    let outer = safetensors::serialize(views, Some(HashMap::from([(KEY.to_string(), text)]))).unwrap();
    let error = Exported::read(outer).unwrap_err();
    assert!(error.to_string().contains("the file holds `policy`"), "{error}");
}
