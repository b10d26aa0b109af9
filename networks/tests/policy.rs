//! Policy and value function: their initial values, and that acting and learning give the same numbers.

#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

use comic_experiment::{Mlp, Network, TaskPart, TaskSpec};
use comic_networks::{
    DiagonalGaussian, Error, NORMALISED_LIMIT, NormalisedObservation, NormaliserStatistics, Policy, RecurrentState,
    Routing, Value, VmpoPolicy,
};
use tch::{Device, Kind, Tensor, nn};

const ROWS: i64 = 24;

fn spec() -> TaskSpec {
    TaskSpec {
        proprioception: 7,
        task: 11,
        action: 3,
        reward_terms: vec!["a".into(), "b".into()],
        image: 0,
        clips: vec!["x".into(), "y".into(), "z".into()],
        tasks: vec![TaskPart { name: "tracking".into(), observation: 11, clips: 3, max_reward: 1.0 }],
    }
}

fn network() -> Network {
    let mut network =
        Network { encoder: vec![16, 16], mlp: Mlp { hidden: vec![16] }, value: vec![16, 16], ..Network::default() };
    network.latent.size = 5;
    network
}

fn policy(network: &Network, seed: i64, pose: &[f32]) -> (nn::VarStore, VmpoPolicy) {
    let store = nn::VarStore::new(Device::Cpu);
    let _guard = GENERATOR.lock().unwrap();
    tch::manual_seed(seed);
    let policy = VmpoPolicy::new(&store.root(), &spec(), network, pose).unwrap();
    (store, policy)
}

/// libtorch has one generator per process, so tests that seed it must not run at the same time.
static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

fn inputs() -> [Tensor; 4] {
    [7, 11, 5, 5].map(|width| {
        let values: Vec<f32> = (0..ROWS * width).map(|index| ((index * 37 % 101) as f32 / 50.0) - 1.0).collect();
        Tensor::from_slice(&values).reshape([ROWS, width])
    })
}

/// Acts without a recurrent state, on `[B, ·]` or `[B, T, ·]`.
fn pass(policy: &VmpoPolicy, observation: &NormalisedObservation, previous: &Tensor, noise: &Tensor) -> Pass {
    let state = Tensor::zeros([previous.size()[0], 0], (Kind::Float, Device::Cpu));
    let acting = policy.act(observation, previous, noise, RecurrentState { state: &state, first: None });
    let (mean, std, log_weights) = acting.action.to_rows();
    assert!(log_weights.is_none());
    Pass { latent: acting.latent, posterior: acting.latent_posterior.unwrap(), action: DiagonalGaussian { mean, std } }
}

/// The output of a policy with the MLP: one Gaussian, and a latent.
struct Pass {
    latent: Tensor,
    posterior: DiagonalGaussian,
    action: DiagonalGaussian,
}

fn act(policy: &VmpoPolicy) -> Pass {
    let [proprioception, task, previous, noise] = inputs();
    pass(policy, &policy.normalise(&proprioception, &task, None, &Routing::single()), &previous, &noise)
}

#[test]
fn the_numbers_are_the_same_bit_for_bit_with_and_without_gradients() {
    let (_store, policy) = policy(&network(), 1, &[0.0; 3]);
    let (with, without) = (act(&policy), tch::no_grad(|| act(&policy)));
    assert!(with.action.mean.requires_grad() && !without.action.mean.requires_grad());
    assert_eq!(with.latent, without.latent);
    assert_eq!(with.action.mean, without.action.mean);
    assert_eq!(with.action.std, without.action.std);
}

#[test]
fn acting_and_learning_give_the_same_numbers_to_rounding() {
    let (_store, policy) = policy(&network(), 1, &[0.0; 3]);
    let (learning, acting) = (act(&policy), comic_networks::acting(|| act(&policy)));
    assert!(!acting.action.mean.requires_grad());
    let pairs = [
        (learning.latent, acting.latent),
        (learning.action.mean, acting.action.mean),
        (learning.action.std, acting.action.std),
    ];
    for (learning, acting) in pairs {
        assert!(learning.allclose(&acting, 1e-5, 1e-6, false), "{learning} {acting}");
    }
}

#[test]
fn unrolls_and_rows_give_the_same_numbers() {
    let (_store, policy) = policy(&network(), 1, &[0.0; 3]);
    let [proprioception, task, previous, noise] = inputs();
    let unrolled = |tensor: &Tensor| tensor.reshape([4, 6, -1]);
    let observation = policy.normalise(&unrolled(&proprioception), &unrolled(&task), None, &Routing::single());
    let acting = pass(&policy, &observation, &unrolled(&previous), &unrolled(&noise));
    assert_eq!(acting.action.mean, act(&policy).action.mean);
}

#[test]
fn the_latent_is_its_mean_plus_its_standard_deviation_times_the_noise() {
    let (_store, policy) = policy(&network(), 1, &[0.0; 3]);
    let acting = act(&policy);
    let [.., noise] = inputs();
    let expected = &acting.posterior.mean + &acting.posterior.std * noise;
    assert!(acting.latent.allclose(&expected, 1e-6, 1e-6, false));
}

#[test]
fn the_gradient_of_the_actions_log_probability_reaches_the_encoder() {
    let (store, policy) = policy(&network(), 1, &[0.0; 3]);
    let action = Tensor::ones([ROWS, 3], (Kind::Float, Device::Cpu));
    act(&policy).action.log_prob(&action).sum(Kind::Float).backward();
    for name in [
        "encoder.tracking.layers.0.weight",
        "encoder.tracking.head.weight",
        "encoder.tracking.linear_path",
        "low_level.head.bias",
    ] {
        let variables = store.variables();
        assert!(variables[name].grad().abs().max().double_value(&[]) > 0.0, "{name}");
    }
}

#[test]
fn mean_and_standard_deviations_start_at_their_initial_values() {
    let mut network = Network { policy_head_scale: 0.0, initial_std: 0.1, ..network() };
    network.latent.initial_std = 0.3;
    let (mut store, policy) = policy(&network, 1, &[0.5, -0.25, 0.0]);
    let acting = act(&policy);
    let pose = Tensor::from_slice(&[0.5f32, -0.25, 0.0]).expand([ROWS, 3], false);
    assert_eq!(acting.action.mean, pose);
    assert!((&acting.action.std - 0.1).abs().max().double_value(&[]) < 1e-6);
    // The weights of the encoder's head are not scaled down. Without them the latent has its initial standard
    // deviation.
    let mut weights = store.variables().remove("encoder.tracking.head.weight").unwrap();
    let _ = tch::no_grad(|| weights.zero_());
    assert!((act(&policy).posterior.std - 0.3).abs().max().double_value(&[]) < 1e-6);
    store.freeze();
}

#[test]
fn standard_deviations_are_never_below_their_minimum() {
    let mut network = network();
    (network.min_std, network.latent.min_std) = (0.02, 0.05);
    let (store, policy) = policy(&network, 1, &[0.0; 3]);
    for name in ["low_level.head.bias", "encoder.tracking.head.bias"] {
        let mut bias = store.variables().remove(name).unwrap();
        let _ = tch::no_grad(|| bias.fill_(-1e4));
    }
    let acting = act(&policy);
    for (std, floor) in [(acting.action.std, 0.02), (acting.posterior.std, 0.05)] {
        assert!((std - floor).abs().max().double_value(&[]) < 1e-8, "the minimum is {floor}");
    }
}

#[test]
fn the_seed_determines_every_initial_parameter() {
    let bytes = |seed| comic_networks::to_safetensors(&policy(&network(), seed, &[0.0; 3]).0).unwrap();
    assert_eq!(bytes(3), bytes(3));
    assert_ne!(bytes(3), bytes(4));
}

#[test]
fn a_pose_with_the_wrong_length_is_refused() {
    let store = nn::VarStore::new(Device::Cpu);
    let error = VmpoPolicy::new(&store.root(), &spec(), &network(), &[0.0; 4]).unwrap_err();
    assert!(matches!(error, Error::Length { expected: 3, found: 4, .. }));
}

#[test]
fn the_normaliser_is_a_parameter_is_not_trained_and_clamps() {
    let network = Network { normaliser_steps: 1, ..network() };
    let (store, policy) = policy(&network, 1, &[0.0; 3]);
    let before = act(&policy).action.mean;
    let statistics = NormaliserStatistics {
        proprioception_mean: vec![0.5; 7],
        proprioception_std: vec![0.0; 7],
        task_mean: vec![-1.0; 11],
        task_std: vec![2.0; 11],
    };
    policy.set_normaliser(&statistics).unwrap();
    assert_ne!(act(&policy).action.mean, before);
    assert!(store.variables().contains_key("normaliser.proprioception_mean"));
    let trained: i64 = store.trainable_variables().iter().map(|tensor| tensor.numel() as i64).sum();
    let all: i64 = store.variables().values().map(|tensor| tensor.numel() as i64).sum();
    assert_eq!(all - trained, 2 * (7 + 11));
    // Proprioception is now divided by the least standard deviation; 1e3 and 1e6 are equal only because of the clamp.
    let [_, task, previous, noise] = inputs();
    let far = |value: f64| {
        let proprioception = Tensor::full([ROWS, 7], value, (Kind::Float, Device::Cpu));
        pass(&policy, &policy.normalise(&proprioception, &task, None, &Routing::single()), &previous, &noise)
            .action
            .mean
    };
    const { assert!(NORMALISED_LIMIT < 1e3) };
    assert_eq!(far(1e3), far(1e6));
}

#[test]
fn statistics_that_do_not_fit_change_nothing() {
    let (store, policy) = policy(&Network { normaliser_steps: 1, ..network() }, 1, &[0.0; 3]);
    let before = comic_networks::to_safetensors(&store).unwrap();
    let fitting = NormaliserStatistics {
        proprioception_mean: vec![0.5; 7],
        proprioception_std: vec![1.0; 7],
        task_mean: vec![0.0; 11],
        task_std: vec![1.0; 11],
    };
    let short = NormaliserStatistics { task_std: vec![1.0; 10], ..fitting.clone() };
    let infinite = NormaliserStatistics { task_mean: vec![f32::INFINITY; 11], ..fitting.clone() };
    let negative = NormaliserStatistics { task_std: vec![-1.0; 11], ..fitting };
    for statistics in [short, infinite, negative] {
        assert!(policy.set_normaliser(&statistics).is_err());
    }
    assert_eq!(comic_networks::to_safetensors(&store).unwrap(), before);
}

#[test]
fn the_value_has_one_output_per_reward_term_and_depends_on_the_clip() {
    let (_store, policy) = policy(&network(), 1, &[0.0; 3]);
    let store = nn::VarStore::new(Device::Cpu);
    let value = {
        let _guard = GENERATOR.lock().unwrap();
        Value::new(&store.root(), &spec(), &network())
    };
    let [proprioception, task, ..] = inputs();
    let unrolled = |tensor: &Tensor| tensor.reshape([4, 6, -1]);
    let observation = policy.normalise(&unrolled(&proprioception), &unrolled(&task), None, &Routing::single());
    let of = |clip: i64| {
        let clip = Tensor::full([4, 6], clip, (Kind::Int64, Device::Cpu));
        value.forward(&observation, &clip, &clip.zeros_like().to_kind(Kind::Float))
    };
    assert_eq!(of(0).size(), [4, 6, 2]);
    assert_ne!(of(0), of(2));
}

#[test]
fn the_image_changes_the_latent_and_its_encoder_gets_gradients() {
    let spec = TaskSpec { image: 64 * 64 * 3, ..spec() };
    let network = Network { image_features: 6, ..network() };
    let store = nn::VarStore::new(Device::Cpu);
    let policy = {
        let _guard = GENERATOR.lock().unwrap();
        tch::manual_seed(3);
        VmpoPolicy::new(&store.root(), &spec, &network, &[0.0; 3]).unwrap()
    };
    let rows = 2;
    let zeros = |width: i64| Tensor::zeros([rows, width], (Kind::Float, Device::Cpu));
    let image = |grey: i64| Tensor::full([rows, 64 * 64 * 3], grey, (Kind::Uint8, Device::Cpu));
    let latent = |grey| {
        let image = image(grey);
        pass(&policy, &policy.normalise(&zeros(7), &zeros(11), Some(&image), &Routing::single()), &zeros(5), &zeros(5))
            .posterior
            .mean
    };
    let (dark, bright) = (latent(0), latent(255));
    assert!((&dark - &bright).abs().max().double_value(&[]) > 1e-3);
    bright.sum(Kind::Float).backward();
    let encoder: Vec<_> =
        store.variables().into_iter().filter(|(name, _)| name.starts_with("image_encoder.")).collect();
    assert_eq!(encoder.len(), 8, "two convolutions, a linear layer and a norm, each with weight and bias");
    for (name, parameter) in encoder {
        assert!(parameter.grad().abs().sum(Kind::Float).double_value(&[]) > 0.0, "{name} gets no gradient");
    }
}

#[test]
fn an_image_gives_the_same_numbers_in_unrolls_and_in_rows() {
    let spec = TaskSpec { image: 64 * 64 * 3, ..spec() };
    let store = nn::VarStore::new(Device::Cpu);
    let policy = {
        let _guard = GENERATOR.lock().unwrap();
        tch::manual_seed(4);
        VmpoPolicy::new(&store.root(), &spec, &network(), &[0.0; 3]).unwrap()
    };
    let image = Tensor::arange(64 * 64 * 3, (Kind::Int64, Device::Cpu)).remainder(251).to_kind(Kind::Uint8);
    let acted = |leading: &[i64]| {
        let shape = |width: i64| [leading, &[width]].concat();
        let zeros = |width: i64| Tensor::zeros(shape(width), (Kind::Float, Device::Cpu));
        let image = image.reshape(shape(64 * 64 * 3));
        let observation = policy.normalise(&zeros(7), &zeros(11), Some(&image), &Routing::single());
        pass(&policy, &observation, &zeros(5), &zeros(5)).posterior.mean
    };
    assert_eq!(acted(&[1]), acted(&[1, 1]));
}

#[test]
fn a_scheduled_standard_deviation_is_a_parameter_and_is_not_trained() {
    let network = Network { final_std: 0.01, ..network() };
    let (store, policy) = self::policy(&network, 1, &[0.0; 3]);
    assert_eq!(act(&policy).action.std.double_value(&[0, 0]) as f32, network.initial_std as f32, "it starts there");
    policy.set_scheduled_std(0.25);
    let action = act(&policy).action;
    assert_eq!(Vec::<f32>::try_from(action.std.flatten(0, -1)).unwrap(), vec![0.25; 3 * ROWS as usize]);
    let scheduled = &store.variables()["low_level.scheduled_std"];
    assert_eq!((scheduled.double_value(&[0]), scheduled.requires_grad()), (0.25, false));
    let (learned, policy) = self::policy(&self::network(), 1, &[0.0; 3]);
    policy.set_scheduled_std(0.25);
    assert!(!learned.variables().contains_key("low_level.scheduled_std"));
    assert!(act(&policy).action.std.double_value(&[0, 0]) > 0.5, "a learned one has no schedule");
}
