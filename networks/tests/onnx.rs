//! Policies as ONNX: onnxruntime, PyTorch and our own networks compute the same actions from dm_control's observations.

#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::process::Command;

use comic_experiment::{Experiment, TaskSpec, resolve};
use comic_networks::export::{Exported, Source};
use comic_networks::{FrozenLowLevel, Policy, RecurrentState, Routing, new_policy, to_safetensors};
use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use tch::{Device, Kind, Tensor, nn};

/// libtorch has one generator per process, so tests that seed it must not run at the same time.
static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// Largest difference of an entry of an action, or of the memory.
const TOLERANCE: f64 = 1e-5;

/// Small networks, each of which has all its kinds of layers.
const SMALL: [&str; 11] = [
    "network.encoder=[24,20]",
    "network.mlp.hidden=[24,20]",
    "network.lstm.units=[12,10]",
    "network.primitives.count=3",
    "network.primitives.torso=[16,14]",
    "network.primitives.hidden=12",
    "network.primitives.gate=[14,10]",
    "network.latent.size=6",
    "network.image_features=8",
    "network.normaliser_steps=1",
    "network.initial_pose=mid-range",
];
/// The same for a policy of SVG(0).
const SMALL_SVG0: [&str; 6] = [
    "algorithm=svg0",
    "svg0.encoder=[16,14]",
    "svg0.core=12",
    "svg0.policy=10",
    "network.image_features=8",
    "network.normaliser_steps=1",
];

/// A prior of the state, which is learned with the policy.
const PRIOR: &str = "network.latent.prior={state={hidden=[10,9]}}";

fn experiment(preset: &str, fields: &[&str], more: &[&str]) -> Experiment {
    let overrides: Vec<String> = fields.iter().chain(more).map(|field| (*field).to_string()).collect();
    resolve(preset, &overrides).unwrap()
}

/// A policy of the experiment with random parameters, statistics included. Outputs of layers are of order 1, so that every
/// activation bends them.
fn policy(experiment: &Experiment) -> (nn::VarStore, Box<dyn Policy>) {
    tch::manual_seed(1);
    let spec = TaskSpec::new(experiment, Vec::new()).unwrap();
    let store = nn::VarStore::new(Device::Cpu);
    let policy = new_policy(&store.root(), &spec, experiment, &vec![0.0; spec.action]).unwrap();
    // Sorted by name, so the same experiment gives the same policy.
    for (name, tensor) in store.variables().into_iter().collect::<BTreeMap<_, _>>() {
        let noise = tensor.detach().rand_like() * 2.0 - 1.0;
        let values = match tensor.size()[..] {
            _ if name.starts_with("normaliser.") && name.ends_with("_std") => noise * 0.5 + 1.0,
            [_] if name.ends_with("norm.weight") => noise * 0.5 + 1.0,
            [_] => noise * 0.5,
            [_, inputs, _] if name.ends_with("heads") => noise * (3.0 / inputs as f64).sqrt(),
            ref size => noise * (3.0 * size[0] as f64 / tensor.numel() as f64).sqrt(),
        };
        tch::no_grad(|| tensor.shallow_clone().copy_(&values));
    }
    (store, policy)
}

fn exported(part: &str, experiment: &Experiment) -> Exported {
    let parameters = to_safetensors(&policy(experiment).0).unwrap();
    Exported::new(part.parse().unwrap(), experiment, Source::default(), &parameters, None).unwrap()
}

/// A policy with the frozen low level inside, and its file.
struct Case {
    policy: Box<dyn Policy>,
    low_level: Option<FrozenLowLevel>,
    file: Exported,
}

impl Case {
    /// The policy of this experiment, and in transfer its low level.
    fn new(experiment: &Experiment, low_level: Option<&Exported>) -> Self {
        let (store, policy) = policy(experiment);
        let (parameters, inside) = (to_safetensors(&store).unwrap(), low_level.map(|file| &file.bytes[..]));
        let part = "policy".parse().unwrap();
        let file = Exported::new(part, experiment, Source::default(), &parameters, inside).unwrap();
        Self { policy, low_level: low_level.map(|file| file.freeze_for(experiment).unwrap()), file }
    }

    /// One step from `memory` `[N, M]`: action and memory, `[N, A + M]`.
    fn step(&self, inputs: &HashMap<String, Vec<Vec<f32>>>, memory: &Tensor) -> Tensor {
        let task = inputs.iter().find(|(name, _)| name.starts_with("observation:")).map(|(_, rows)| tensor(rows));
        let (proprioception, image) = (tensor(&inputs["proprioception"]), inputs.get("image"));
        let image = image.map(|rows| tensor(rows).to_kind(Kind::Uint8));
        let observation = self.policy.normalise(&proprioception, &task.unwrap(), image.as_ref(), &Routing::single());
        let own = &self.file.experiment;
        let sizes = [own.latent_size(), own.state_size(), own.frozen_state_size()].map(|size| size as i64);
        let [latent, state, low_level] = &memory.split_with_sizes(sizes, 1)[..] else { panic!("three sizes") };
        let recurrent = RecurrentState { state, first: None };
        let acting = self.policy.act(&observation, latent, &latent.zeros_like(), recurrent);
        let (action, low_level) = match &self.low_level {
            Some(frozen) => frozen.act(&acting.action.mode(), &proprioception, low_level),
            None => (acting.action.mode(), low_level.shallow_clone()),
        };
        Tensor::cat(&[action.clamp(-1.0, 1.0), acting.latent, acting.state, low_level], 1)
    }
}

fn alone(preset: &str, more: &[&str]) -> Case {
    Case::new(&experiment(preset, &SMALL, more), None)
}

/// A policy of this preset whose actions are latents of a frozen low level of this kind.
fn composed(preset: &str, fields: &[&str], low_level: &str, prior: &str) -> Case {
    let kind = format!("network.low_level={low_level}");
    let low_level = exported("low-level", &experiment("tracking-mlp", &SMALL, &[&kind, PRIOR]));
    let sha256 = format!("transfer.sha256={}", hex::encode(Sha256::digest(&low_level.bytes)));
    let prior = format!("transfer.prior={prior}");
    let mut experiment = experiment(preset, fields, &["transfer.low_level=low_level.safetensors", &sha256, &prior]);
    low_level.describe_low_level(&mut experiment.network).unwrap();
    Case::new(&experiment, Some(&low_level))
}

fn cases() -> BTreeMap<&'static str, Case> {
    BTreeMap::from([
        ("mlp", alone("tracking-mlp", &[])),
        ("lstm", alone("tracking-mlp", &["network.low_level=lstm"])),
        ("mixture", alone("tracking-mlp", &["network.low_level=mixture"])),
        ("product", alone("tracking-mlp", &["network.low_level=product", "network.primitives.biases=true"])),
        ("mixture_without_latent", alone("tracking-mlp", &["network.low_level=mixture", "network.latent.size=0"])),
        ("prior_of_the_state", alone("go-to-target", &[PRIOR])),
        ("image", alone("gaps", &["network.low_level=lstm"])),
        ("composed_mlp", composed("go-to-target", &SMALL, "mlp", "state")),
        ("composed_lstm_and_image", composed("gaps", &SMALL, "lstm", "standard")),
        ("composed_svg0", composed("go-to-target", &SMALL_SVG0, "lstm", "standard")),
        ("composed_svg0_and_image", composed("gaps", &SMALL_SVG0, "mixture", "state")),
    ])
}

/// What `run_onnx.py` prints for a step.
#[derive(Deserialize)]
struct Step {
    policy: String,
    inputs: HashMap<String, Vec<Vec<f32>>>,
    outputs: HashMap<String, Vec<Vec<f32>>>,
    /// Of the first environment alone.
    alone: HashMap<String, Vec<Vec<f32>>>,
    torch: Vec<Vec<f32>>,
}

/// `[N, size]`.
fn tensor(rows: &[Vec<f32>]) -> Tensor {
    Tensor::from_slice(&rows.concat()).reshape([rows.len() as i64, rows[0].len() as i64])
}

/// Action and memory, `[N, A + M]`.
fn joined(outputs: &HashMap<String, Vec<Vec<f32>>>) -> Tensor {
    let parts = ["action", "next_recurrent_state"].into_iter().filter_map(|name| outputs.get(name));
    Tensor::cat(&parts.map(|rows| tensor(rows)).collect::<Vec<_>>(), 1)
}

fn difference(one: &Tensor, other: &Tensor) -> f64 {
    assert_eq!(one.size(), other.size());
    (one - other).abs().max().double_value(&[])
}

/// Standard deviation of each action over the rows, and the mean over the actions.
fn spread(actions: &Tensor) -> f64 {
    actions.std_dim(0, true, false).mean(Kind::Double).double_value(&[])
}

#[test]
fn policies_act_in_onnxruntime_as_in_pytorch_and_here_on_golden_observations() {
    let _guard = GENERATOR.lock().unwrap();
    // Other tests use the other cores.
    tch::set_num_threads(1);
    let _no_grad = tch::no_grad_guard();
    let directory = tempfile::tempdir().unwrap();
    let cases = cases();
    for (name, case) in &cases {
        let path = |extension: &str| directory.path().join(format!("{name}.{extension}"));
        std::fs::write(path("onnx"), case.file.to_onnx().unwrap()).unwrap();
        case.file.save_script(&path("pt")).unwrap();
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let python = root.join(".deps/python/requirements-tests/bin/python");
    let mut command = Command::new(&python);
    let output = command.arg(root.join("tests/python/run_onnx.py")).arg(directory.path()).output();
    let output = output.unwrap_or_else(|error| panic!("{}: {error}; `cargo xtask test` makes it", python.display()));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    let mut memories: HashMap<String, Tensor> = HashMap::new();
    let (mut steps, mut actions) = (HashMap::<String, usize>::new(), HashMap::<String, Vec<Tensor>>::new());
    for line in String::from_utf8(output.stdout).unwrap().lines() {
        let step: Step = serde_json::from_str(line).unwrap();
        let (name, case) = (step.policy.as_str(), &cases[step.policy.as_str()]);
        let (found, rows) = (joined(&step.outputs), step.torch.len() as i64);
        let size = case.file.spec.inputs.last().unwrap().size as i64;
        let start = || Tensor::zeros([rows, size], (Kind::Float, Device::Cpu));
        let expected = case.step(&step.inputs, memories.get(name).unwrap_or(&start()));
        for (whose, other) in [("PyTorch", &tensor(&step.torch)), ("our networks", &expected)] {
            let error = difference(&found, other);
            assert!(error < TOLERANCE, "{name}: onnxruntime and {whose} differ by {error}");
        }
        let error = difference(&joined(&step.alone), &expected.narrow(0, 0, 1));
        assert!(error < TOLERANCE, "{name}: one environment alone differs by {error}");
        if size > 0 && memories.contains_key(name) {
            let forgetful = case.step(&step.inputs, &start());
            assert!(difference(&found, &forgetful) > 100.0 * TOLERANCE, "{name}: the memory has no influence");
        }
        actions.entry(name.into()).or_default().push(found.narrow(1, 0, 56));
        memories.insert(name.into(), expected.narrow(1, expected.size()[1] - size, size));
        *steps.entry(name.into()).or_default() += 1;
    }
    for name in cases.keys() {
        assert!(steps[*name] >= 3, "{name}: {} steps", steps[*name]);
        let spread = spread(&Tensor::cat(&actions[*name], 0));
        assert!(spread > 0.01, "{name}: the actions hardly depend on the observations: {spread}");
        println!("{name}: {} steps, actions spread by {spread:.3}", steps[*name]);
    }
}

#[test]
fn the_same_policy_is_written_as_the_same_bytes() {
    let _guard = GENERATOR.lock().unwrap();
    let case = composed("go-to-target", &SMALL, "lstm", "state");
    assert!(case.file.to_onnx().unwrap() == case.file.to_onnx().unwrap());
}

#[test]
fn onnx_needs_a_policy_of_one_task() {
    let _guard = GENERATOR.lock().unwrap();
    let joint = experiment("joint-get-up", &SMALL, &[]);
    for part in ["policy", "low-level", "encoder:get-up"] {
        let refused = exported(part, &joint).to_onnx().unwrap_err().to_string();
        assert!(refused.contains("policy:TASK") && refused.contains("ONNX"), "{part}: {refused}");
    }
    assert!(exported("policy:get-up", &joint).to_onnx().is_ok());
}
