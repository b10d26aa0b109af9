//! Numbers of other code: rlax's Retrace, and whole gradient steps of PyTorch's autograd.
//!
//! Reads every `retrace_*.npz`, `step_*.npz` and `resnet_*.npz` of the folder that COMIC_SVG0_FIXTURES names, by default `tests/fixtures/svg0`.
//! `tests/python/make_svg0_fixtures.py` makes them. They were computed in float64.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod fixture;
mod svg0_support;

use std::collections::HashMap;
use std::sync::Arc;

use comic_experiment::{AlgorithmName, Experiment, TaskPart, TaskSpec};
use comic_learner::algorithm::Algorithm as _;
use comic_learner::algorithm::shape::MinibatchShape;
use comic_learner::svg0::{Networks, Svg0Learner, Terms, Trace, losses, noise, retrace};
use comic_networks::{Policy as _, Routing, Svg0Policy};
use comic_proto::{Field, UnrollLayout, UnrollShape};
use comic_replay::Unrolls;
use fixture::{Fixture, Folder, agree};
use svg0_support::{GENERATOR, Sequences};
use tch::{Device, Kind, Tensor, nn};

const FOLDER: Folder = Folder {
    variable: "COMIC_SVG0_FIXTURES",
    name: "svg0",
    script: "make_svg0_fixtures.py",
    kinds: &["retrace_", "step_", "resnet_"],
};

#[test]
fn targets_equal_rlax_on_each_episodes_piece() {
    for mut fixture in FOLDER.fixtures("retrace_") {
        let [reward, discount, action_value, value, coefficient, valid] =
            ["reward", "discount", "action_value", "value", "coefficient", "valid"].map(|name| fixture.array(name));
        let trace = Trace {
            reward: &reward,
            discount: &discount,
            action_value: &action_value,
            value: &value,
            coefficient: &coefficient,
            valid: &valid,
        };
        fixture.compare("target", &retrace(&trace));
    }
}

/// A gradient step of a fixture.
struct Step {
    fixture: Fixture,
    spec: TaskSpec,
    experiment: Experiment,
    sequences: Sequences,
    noise: Tensor,
}

impl Step {
    fn all() -> Vec<Self> {
        // The networks are too small for several threads.
        tch::set_num_threads(1);
        FOLDER.fixtures("step_").into_iter().map(Self::read).collect()
    }

    fn read(mut fixture: Fixture) -> Self {
        let width = |array: &Tensor| *array.size().last().unwrap() as usize;
        let [proprioception, task, action, reward] =
            ["proprioception", "task", "action", "reward"].map(|name| fixture.array(name));
        let part = TaskPart { name: "task".into(), observation: width(&task), clips: 1, max_reward: 1.0 };
        let spec = TaskSpec {
            proprioception: width(&proprioception),
            task: width(&task),
            action: width(&action),
            reward_terms: (0..width(&reward)).map(|term| format!("term {term}")).collect(),
            clips: vec!["clip".into()],
            tasks: vec![part],
            ..TaskSpec::default()
        };
        let noise = fixture.array("noise");
        let sizes = |values: Tensor| Vec::<f32>::try_from(values).unwrap().iter().map(|size| *size as usize).collect();
        let mut experiment = Experiment { algorithm: AlgorithmName::Svg0, ..Experiment::default() };
        experiment.transfer.mean_scale = fixture.scalar("mean_scale");
        experiment.svg0.min_std = fixture.scalar("min_std");
        experiment.network.normaliser_steps = 1;
        let svg0 = &mut experiment.svg0;
        (svg0.encoder, svg0.action_value) = (sizes(fixture.array("encoder")), sizes(fixture.array("action_value")));
        [svg0.core, svg0.policy, svg0.burn_in] =
            ["core", "policy", "burn_in"].map(|name| fixture.scalar(name) as usize);
        [svg0.discount, svg0.lambda, svg0.entropy, svg0.kl] =
            ["discount", "lambda", "entropy", "kl"].map(|name| fixture.scalar(name));
        svg0.action_samples = noise.size()[1] as usize;
        let [unrolls, length] = [0, 1].map(|dimension| action.size()[dimension] as usize);
        experiment.unroll.length = length;
        let shape = MinibatchShape { unrolls, tasks: 1, unroll: UnrollShape::new(&spec, &experiment) };
        let mut sequences = Unrolls::new(Arc::new(UnrollLayout::new(shape.unroll)), unrolls);
        for field in [
            Field::Proprioception,
            Field::Task,
            Field::Action,
            Field::Mean,
            Field::Std,
            Field::Reward,
            Field::Discount,
            Field::Valid,
            Field::First,
            Field::State,
        ] {
            let name = if field == Field::Discount { "discount_factor" } else { field.name() };
            sequences.f32_mut(field).copy_from_slice(&values(&fixture.array(name)));
        }
        Self { fixture, spec, experiment, sequences: Sequences { unrolls: sequences, shape }, noise }
    }

    /// Networks with the parameters of the fixture, named there with `prefix`.
    fn networks(&mut self, prefix: &str) -> Networks {
        let networks = Networks::new(Device::Cpu, &self.spec, &self.experiment);
        for (name, parameter) in networks.entries(prefix) {
            tch::no_grad(|| parameter.shallow_clone().copy_(&self.fixture.array(&name)));
        }
        networks
    }

    fn terms(&self, online: &Networks, target: &Networks, noise: &Tensor) -> Terms {
        losses(online, target, &self.sequences.tensors(), noise, &self.experiment.svg0)
    }
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten(0, -1).try_into().unwrap()
}

fn gradients(loss: &Tensor, parameters: &[(String, Tensor)]) -> Vec<Tensor> {
    let tensors: Vec<&Tensor> = parameters.iter().map(|(_, tensor)| tensor).collect();
    Tensor::run_backward(&[loss], &tensors, false, false)
}

#[test]
fn losses_and_gradients_equal_pytorch() {
    for mut step in Step::all() {
        let (online, target) = (step.networks(""), step.networks("target_"));
        let terms = step.terms(&online, &target, &step.noise);
        // The action value of a row without a transition means nothing.
        step.fixture.compare("taken", &(&terms.action_value * &terms.valid));
        step.fixture.compare("trace", &(&terms.trace * &terms.valid));
        step.fixture.compare("target", &terms.target);
        step.fixture.compare("value_loss", &terms.value_loss);
        step.fixture.compare("policy_loss", &terms.policy_loss);
        step.fixture.compare("entropy_mean", &terms.entropy);
        step.fixture.compare("kl_mean", &terms.latent_kl);
        let parameters = online.trainable();
        for ((name, _), gradient) in parameters.iter().zip(gradients(&terms.total(), &parameters)) {
            step.fixture.compare(&format!("grad.{name}"), &gradient);
        }
    }
}

/// The first moments of Adam after the first step are 1 − β₁ times the gradient.
#[test]
fn the_learner_descends_these_losses_with_noise_of_its_seed() {
    let _guard = GENERATOR.lock().unwrap();
    for mut step in Step::all() {
        let (online, target) = (step.networks(""), step.networks("target_"));
        let mut learner = Svg0Learner::new(&step.spec, &step.experiment, Device::Cpu).unwrap();
        let mut given: HashMap<_, _> = online.entries("").into_iter().chain(target.entries("target_")).collect();
        let state = learner.state().into_iter().map(|(name, tensor)| {
            let given = given.remove(&name);
            (name, given.unwrap_or(tensor))
        });
        learner.load_state(&state.collect::<Vec<_>>()).unwrap();
        let minibatch = step.sequences.tensors();
        let noise = noise(step.experiment.seed, 0, &minibatch, &step.experiment.svg0);
        learner.step(&minibatch).unwrap();
        let parameters = online.trainable();
        let expected = gradients(&step.terms(&online, &target, &noise).total(), &parameters);
        for ((name, _), gradient) in parameters.iter().zip(expected) {
            let name = format!("adam.first.{name}");
            let (_, moment) = learner.state().into_iter().find(|(found, _)| *found == name).unwrap();
            let gradient = gradient * (1.0 - step.experiment.optimiser.beta1);
            agree(&gradient, &moment, 0.0).unwrap_or_else(|error| panic!("{name}: {error}"));
        }
    }
}

/// Differences of L_π over ± 0.005 along random directions of length 1 in the policy's parameters. There is no burn-in: it moves
/// with the parameters, and the gradient leaves that out.
#[test]
fn the_policys_gradient_is_the_slope_of_its_loss() {
    let _guard = GENERATOR.lock().unwrap();
    for mut step in Step::all() {
        let (online, target) = (step.networks(""), step.networks("target_"));
        step.experiment.svg0.burn_in = 0;
        let noise = noise(2, 0, &step.sequences.tensors(), &step.experiment.svg0);
        let mut parameters = online.trainable();
        parameters.retain(|(name, _)| name.starts_with("policy.latent_policy."));
        let loss = || step.terms(&online, &target, &noise).policy_loss;
        let gradient = gradients(&loss(), &parameters);
        let dot = |one: &[Tensor], other: &[Tensor]| -> f64 {
            one.iter().zip(other).map(|(one, other)| (one * other).sum(Kind::Double).double_value(&[])).sum()
        };
        for _ in 0..5 {
            let mut direction: Vec<Tensor> = gradient.iter().map(Tensor::randn_like).collect();
            // Half along the gradient, so that the slope is not small beside the rounding of a float32 loss.
            let [own, other] = [dot(&gradient, &gradient), dot(&direction, &direction)].map(f64::sqrt);
            direction.iter_mut().zip(&gradient).for_each(|(d, g)| *d = &*d / other + g / own);
            let length = dot(&direction, &direction).sqrt();
            let moved = |by: f64| {
                let shift = |by: f64| {
                    tch::no_grad(|| {
                        for ((_, parameter), direction) in parameters.iter().zip(&direction) {
                            drop(parameter.shallow_clone().g_add_(&(direction * (by / length))));
                        }
                    });
                };
                shift(by);
                let value = loss().double_value(&[]);
                shift(-by);
                value
            };
            let (found, expected) = ((moved(0.005) - moved(-0.005)) / 0.01, dot(&gradient, &direction) / length);
            // Rounding gives up to 1e-4, and the third derivative as much.
            assert!((found - expected).abs() < 1e-3 * own, "a slope of {found}, not {expected}");
        }
    }
}

/// Parameters and pixels follow from the script's formulas.
#[test]
fn features_of_images_equal_pytorch() {
    for mut fixture in FOLDER.fixtures("resnet_") {
        let size = fixture.array("features").size();
        let spec = TaskSpec { image: 64 * 64 * 3, task: 0, ..svg0_support::spec() };
        let mut experiment = svg0_support::experiment();
        experiment.network.image_features = size[1] as usize;
        let store = nn::VarStore::new(Device::Cpu);
        let policy = Svg0Policy::new(&store.root(), &spec, &experiment);
        let mut parameters: Vec<_> =
            store.variables().into_iter().filter(|(name, _)| name.starts_with("image_encoder.")).collect();
        parameters.sort_by(|one, other| one.0.cmp(&other.0));
        for (number, (_, parameter)) in parameters.iter().enumerate() {
            let shape = parameter.size();
            let fan_in: i64 = shape[1..].iter().product();
            let indices = Tensor::arange(parameter.numel() as i64, (Kind::Double, Device::Cpu)) + number as f64;
            let entries = (indices.sin() / (fan_in as f64).sqrt()).to_kind(Kind::Float).reshape(&shape);
            tch::no_grad(|| parameter.shallow_clone().copy_(&entries));
        }
        let bytes: Vec<u8> = (0..size[0] * spec.image as i64).map(|i| ((31 * i * i + 7 * i) % 251) as u8).collect();
        let image = Tensor::from_slice(&bytes).reshape([size[0], -1]);
        let [proprioception, task] =
            [spec.proprioception, 0].map(|width| Tensor::zeros([size[0], width as i64], (Kind::Float, Device::Cpu)));
        let observation = policy.normalise(&proprioception, &task, Some(&image), &Routing::single());
        fixture.compare("features", observation.task());
    }
}
