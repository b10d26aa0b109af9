//! The low levels, compared with libtorch's own layers and with the properties that they must have.

#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

use comic_experiment::{LowLevelName, Lstm, Network, Primitives, TaskPart, TaskSpec, resolve};
use comic_networks::{ActionDistribution, DiagonalGaussian, Policy, RecurrentState, Routing, VmpoPolicy};
use tch::{Device, Kind, Tensor, nn};

/// libtorch has one generator per process, so tests that seed it must not run at the same time.
static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

fn random(size: &[i64]) -> Tensor {
    Tensor::randn(size, (Kind::Float, Device::Cpu))
}

fn spec() -> TaskSpec {
    let task = TaskPart { name: "tracking".into(), observation: 11, clips: 1, max_reward: 1.0 };
    TaskSpec { proprioception: 7, task: 11, action: 3, tasks: vec![task], ..TaskSpec::default() }
}

fn policy(network: &Network) -> (nn::VarStore, VmpoPolicy) {
    let store = nn::VarStore::new(Device::Cpu);
    let policy = VmpoPolicy::new(&store.root(), &spec(), network, &[0.1, -0.2, 0.3]).unwrap();
    (store, policy)
}

#[test]
fn the_sum_of_a_mixtures_kl_parts_is_an_upper_bound_of_its_kl() {
    let _guard = GENERATOR.lock().unwrap();
    tch::manual_seed(1);
    let (rows, count, actions, samples) = (6, 4, 3, 10_000);
    let weights = || random(&[rows, count]).log_softmax(-1, None::<Kind>);
    let mean = random(&[rows, count, actions]) * 0.5;
    let std = (random(&[rows, count, actions]) * 0.3).exp();
    let moved = DiagonalGaussian {
        mean: &mean + random(&[rows, count, actions]) * 0.3,
        // KL_μ uses the old standard deviation, so the bound holds only if the new standard deviation is not smaller.
        std: &std * (random(&[rows, count, actions]).abs() * 0.3).exp(),
    };
    let old = ActionDistribution::Mixture { log_weights: weights(), components: DiagonalGaussian { mean, std } };
    let new = ActionDistribution::Mixture { log_weights: weights(), components: moved };
    let ActionDistribution::Mixture { log_weights, components } = &old else { unreachable!() };
    let chosen = log_weights.exp().multinomial(samples, true);
    let index = chosen.unsqueeze(-1).expand([rows, samples, actions], false);
    let noise = random(&[rows, samples, actions]);
    let drawn = components.mean.gather(1, &index, false).addcmul(&components.std.gather(1, &index, false), &noise);
    let by_sample = |sample: i64| {
        let action = drawn.select(1, sample);
        old.log_prob(&action) - new.log_prob(&action)
    };
    let terms: Vec<Tensor> = (0..samples).map(by_sample).collect();
    let kl = Tensor::stack(&terms, 0).mean_dim(0i64, false, Kind::Float);
    let bound = new.kl_mean(&old) + new.kl_std(&old) + new.kl_weights(&old).unwrap();
    let slack = (&bound - &kl).min().double_value(&[]);
    assert!(slack > 0.0, "bound {bound:?}, sampled {kl:?}");
    assert!(kl.min().double_value(&[]) > 0.05, "the two differ: {kl:?}");
}

#[test]
fn the_lstm_low_level_equals_libtorchs_lstm() {
    let _guard = GENERATOR.lock().unwrap();
    tch::manual_seed(2);
    let network = Network {
        low_level: LowLevelName::Lstm,
        lstm: Lstm { units: vec![6] },
        policy_head_scale: 1.0,
        encoder: vec![8],
        ..Network::default()
    };
    let (store, policy) = policy(&network);
    let (unrolls, steps, latent) = (4, 9, network.latent.size as i64);
    let (proprioception, task) = (random(&[unrolls, steps, 7]), random(&[unrolls, steps, 11]));
    let (previous, noise) = (random(&[unrolls, steps, latent]), random(&[unrolls, steps, latent]));
    let state = random(&[unrolls, 12]);
    let observation = policy.normalise(&proprioception, &task, None, &Routing::single());
    let acting = policy.act(&observation, &previous, &noise, RecurrentState { state: &state, first: None });

    let mut variables = store.variables();
    let mut take = |name: &str| variables.remove(&format!("low_level.{name}")).unwrap();
    let (input, bias, recurrent) = (take("lstm.0.input.weight"), take("lstm.0.input.bias"), take("lstm.0.recurrent"));
    let (head, head_bias) = (take("head.weight"), take("head.bias"));
    let joined = Tensor::cat(&[acting.latent.reshape([unrolls, steps, -1]), proprioception], -1);
    let [h, c] = [0, 6].map(|start| state.narrow(1, start, 6).unsqueeze(0).contiguous());
    let weights = [input, recurrent, bias.shallow_clone(), bias.zeros_like()];
    let (hidden, h, c) = joined.lstm(&[h, c], &weights, true, 1, 0.0, false, false, true);
    let expected = hidden.linear(&head, Some(&head_bias)).narrow(-1, 0, 3).reshape([unrolls * steps, 3]);
    let close = |found: &Tensor, expected: &Tensor| (found - expected).abs().max().double_value(&[]) < 1e-5;
    assert!(close(&acting.action.mean(), &expected));
    assert!(close(&acting.state, &Tensor::cat(&[h.squeeze_dim(0), c.squeeze_dim(0)], 1)));
}

#[test]
fn fixed_biases_separate_the_primitives_and_are_not_trained() {
    let _guard = GENERATOR.lock().unwrap();
    let network = |biases| Network {
        low_level: LowLevelName::Mixture,
        primitives: Primitives { count: 5, biases, torso: vec![8], hidden: 6, gate: vec![7] },
        policy_head_scale: 0.0,
        ..Network::default()
    };
    let means = |network: &Network| {
        let (store, policy) = policy(network);
        let zeros = |width: i64| Tensor::zeros([1, width], (Kind::Float, Device::Cpu));
        let latent = network.latent.size as i64;
        let observation = policy.normalise(&zeros(7), &zeros(11), None, &Routing::single());
        let recurrent = RecurrentState { state: &zeros(0), first: None };
        let (mean, ..) = policy.act(&observation, &zeros(latent), &zeros(latent), recurrent).action.to_rows();
        let parameters: usize = store.trainable_variables().iter().map(Tensor::numel).sum();
        (Vec::<f32>::try_from(mean.view(-1)).unwrap(), parameters)
    };
    let ((apart, trained), (together, as_many)) = (means(&network(true)), means(&network(false)));
    assert_eq!(trained, as_many);
    let pose = [0.1f32, -0.2, 0.3];
    for (component, bias) in [-0.66f32, -0.33, 0.0, 0.33, 0.66].into_iter().enumerate() {
        for (dimension, start) in pose.into_iter().enumerate() {
            let index = component * 3 + dimension;
            assert!((apart[index] - start - bias).abs() < 1e-6 && (together[index] - start).abs() < 1e-6, "{apart:?}");
        }
    }
}

#[test]
fn a_product_starts_with_the_initial_std() {
    let _guard = GENERATOR.lock().unwrap();
    let network = Network {
        low_level: LowLevelName::Product,
        policy_head_scale: 0.0,
        initial_std: 0.2,
        primitives: Primitives { gate: vec![400], ..Primitives::default() },
        ..Network::default()
    };
    let (store, policy) = policy(&network);
    let mut gate = store.variables().remove("low_level.gate.head.weight").unwrap();
    let _ = tch::no_grad(|| gate.zero_());
    let zeros = |width: i64| Tensor::zeros([1, width], (Kind::Float, Device::Cpu));
    let observation = policy.normalise(&zeros(7), &zeros(11), None, &Routing::single());
    let recurrent = RecurrentState { state: &zeros(0), first: None };
    let acting = policy.act(&observation, &zeros(60), &zeros(60), recurrent);
    // The least exponent moves the initial exponents from 0.5 by 0.0005.
    assert!((acting.action.std() - 0.2).abs().max().double_value(&[]) < 2e-4);
    let pose = Tensor::from_slice(&[0.1f32, -0.2, 0.3]);
    assert!((acting.action.mean() - pose).abs().max().double_value(&[]) < 1e-6);
}

#[test]
fn the_std_of_a_product_is_bounded_above_and_below() {
    let _guard = GENERATOR.lock().unwrap();
    let network = Network { low_level: LowLevelName::Product, min_std: 0.1, ..Network::default() };
    let (store, policy) = policy(&network);
    let zeros = |width: i64| Tensor::zeros([1, width], (Kind::Float, Device::Cpu));
    let act = |logit: f64, raw: f64| {
        let mut variables = store.variables();
        let _ = tch::no_grad(|| variables.get_mut("low_level.gate.head.bias").unwrap().fill_(logit));
        let heads = variables.get_mut("low_level.primitives.head_biases").unwrap();
        let _ = tch::no_grad(|| heads.narrow(2, 3, 3).fill_(raw));
        let observation = policy.normalise(&zeros(7), &zeros(11), None, &Routing::single());
        let recurrent = RecurrentState { state: &zeros(0), first: None };
        policy.act(&observation, &zeros(60), &zeros(60), recurrent).action
    };
    let wide = act(-200.0, 1.0);
    wide.log_prob(&zeros(3)).sum(Kind::Float).backward();
    for (name, parameter) in store.variables().into_iter().filter(|(_, parameter)| parameter.requires_grad()) {
        let gradient = parameter.grad();
        assert!(!gradient.defined() || gradient.isfinite().all().int64_value(&[]) == 1, "{name}");
    }
    assert!(wide.std().max().double_value(&[]) < 100.0);
    let narrow = act(50.0, -1e4);
    assert!((narrow.std() - 0.1).abs().max().double_value(&[]) < 1e-6, "{:?}", narrow.std());
}

/// CoMic supplement 2.3: "low-level architectures with a similar number of parameters as the MLP low-level".
#[test]
fn the_papers_low_levels_have_similar_sizes() {
    let _guard = GENERATOR.lock().unwrap();
    let spec = TaskSpec { proprioception: 205, task: 620, action: 56, ..TaskSpec::default() };
    let size = |preset: &str| {
        let network = resolve(preset, &[]).unwrap().network;
        let store = nn::VarStore::new(Device::Cpu);
        VmpoPolicy::new(&store.root(), &spec, &network, &[0.0; 56]).unwrap();
        let parameters = store.variables().into_iter().filter(|(name, _)| name.starts_with("low_level."));
        parameters.map(|(_, parameter)| parameter.numel()).sum::<usize>()
    };
    let mlp = size("tracking-mlp") as f64;
    for (preset, share) in [("tracking-lstm", 1.18), ("tracking-mixture", 0.81), ("tracking-product", 1.0)] {
        let found = size(preset) as f64 / mlp;
        assert!((found - share).abs() < 0.02, "{preset} has {found:.3} of the MLP's {mlp} parameters");
    }
}
