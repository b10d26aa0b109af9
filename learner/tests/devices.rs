//! Updates on another device equal those on the CPU. The device is XLA if it was built in, as `cargo xtask test --xla` does,
//! otherwise the one that `COMIC_TEST_DEVICE` names. If that is the CPU, two learners on the CPU are compared.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod vmpo_support;

use std::sync::OnceLock;

use comic_experiment::{AlgorithmName, DeviceName, Experiment, Learner, LowLevelName, TaskSpec};
use comic_learner::algorithm::Algorithm;
use comic_learner::algorithm::loss_report::{LossValues, Losses};
use comic_learner::device::Backend;
use tch::Device;
use vmpo_support::{GENERATOR, Unrolls, algorithm_on, every_low_level, experiment, joint_spec, spec, state};

const COUNT: usize = 12;
const BATCHES: u64 = 30;

/// One for the process, because a plugin is started only once.
fn backend() -> &'static Backend {
    static BACKEND: OnceLock<Backend> = OnceLock::new();
    BACKEND.get_or_init(|| {
        let built_in = if cfg!(feature = "xla") { "xla" } else { "cpu" };
        let name = std::env::var("COMIC_TEST_DEVICE").unwrap_or_else(|_| built_in.into());
        let device: DeviceName = name.parse().unwrap();
        Backend::open(&Learner { device, ..Learner::default() }).unwrap()
    })
}

/// V-MPO for every low level with one task, and two tasks over the first of them and over the recurrent one; and SVG(0).
fn experiments() -> Vec<(String, Experiment, TaskSpec)> {
    let of = |mut experiment: Experiment, spec: TaskSpec| {
        // Adam as it is used, so that thirty steps do not run away.
        experiment.optimiser.epsilon = 1e-3;
        experiment.optimiser.learning_rate = 1e-3;
        experiment.optimiser.multiplier_learning_rate = 1e-3;
        experiment.optimiser.max_gradient_norm = 0.5;
        experiment.optimiser.final_learning_rate_share = 0.3;
        experiment.network.normaliser_steps = 1;
        if experiment.network.low_level == LowLevelName::Lstm && spec.tasks.len() == 1 {
            experiment.network.value_lstm = vec![6];
            experiment.vmpo.value_burn_in = 2;
        }
        let (algorithm, low_level) = (experiment.algorithm, experiment.network.low_level);
        (format!("{algorithm}, {low_level} with {} tasks", spec.tasks.len()), experiment, spec)
    };
    let alone = every_low_level().into_iter().map(|experiment| of(experiment, spec()));
    let joint = every_low_level().into_iter().take(2).map(|experiment| of(experiment, joint_spec()));
    alone.chain(joint).chain([of(svg0(), spec())]).collect()
}

/// Small networks of SVG(0), whose targets are copied in every second step.
fn svg0() -> Experiment {
    let mut experiment = Experiment { algorithm: AlgorithmName::Svg0, ..experiment() };
    let svg0 = &mut experiment.svg0;
    (svg0.encoder, svg0.action_value) = (vec![8], vec![16]);
    (svg0.core, svg0.policy, svg0.burn_in, svg0.action_samples) = (6, 5, 2, 4);
    svg0.target_period = 2;
    experiment
}

fn step(learner: &mut dyn Algorithm, device: Device, unrolls: &Unrolls) -> LossValues {
    // In another order, as for one of several gradient steps on a batch.
    let order: Vec<usize> = (0..COUNT).rev().collect();
    let minibatch = unrolls.minibatch_on(device).select(&order);
    // A step of SVG(0) seeds the generator.
    let guard = GENERATOR.lock().unwrap();
    let losses = [learner.step(&minibatch).unwrap()];
    drop(guard);
    drop(minibatch);
    if device != Device::Cpu {
        backend().end_step().unwrap();
    }
    Losses::mean(&losses).unwrap().to_values()
}

/// The largest difference between the tensors of two learners whose names begin with `prefix`, relative to the largest number
/// of the same tensor or to `floor`.
fn distance(left: &dyn Algorithm, right: &dyn Algorithm, prefix: &str, floor: f64) -> (f64, String) {
    let mut worst = (0.0, String::new());
    for ((name, left), (_, right)) in state(left).into_iter().zip(state(right)) {
        let scale = left.iter().fold(floor, |scale: f64, value| scale.max(value.abs()));
        for (left, right) in left.iter().zip(&right).filter(|_| name.starts_with(prefix)) {
            assert!(left.is_finite() && right.is_finite(), "{name}");
            let difference = (left - right).abs() / scale;
            if difference > worst.0 {
                worst = (difference, name.clone());
            }
        }
    }
    worst
}

#[test]
fn the_first_update_and_the_thirtieth_equal_the_cpus_for_every_experiment() {
    let device = backend().device();
    for (name, experiment, spec) in experiments() {
        let mut host = algorithm_on(Device::Cpu, &spec, &experiment, 3);
        let mut there = algorithm_on(device, &spec, &experiment, 3);
        for seed in 0..BATCHES {
            let unrolls = Unrolls::recorded(&experiment, &spec, seed, COUNT);
            let (expected, found) = (step(&mut *host, Device::Cpu, &unrolls), step(&mut *there, device, &unrolls));
            if seed > 0 {
                continue;
            }
            for ((entry, expected), (_, found)) in expected.entries().iter().zip(found.entries()) {
                let difference = (f64::from(*expected) - f64::from(*found)).abs();
                assert!(difference <= 1e-5 * f64::from(expected.abs()).max(1.0), "{name}: {entry} {expected} {found}");
            }
            // The mean of one gradient is a tenth of that gradient.
            let (worst, of) = distance(&*host, &*there, "adam.first.", 1e-6);
            assert!(worst <= 1e-5, "{name}: the gradient of {of} differs by {worst:e}");
        }
        let (worst, of) = distance(&*host, &*there, "", 1e-3);
        assert!(worst <= 1e-4, "{name}: {of} differs by {worst:e} after {BATCHES} updates");
    }
}

#[test]
fn a_state_saved_on_one_device_is_restored_on_the_other() {
    let device = backend().device();
    for (name, experiment, spec) in experiments() {
        let unrolls = |seed| Unrolls::recorded(&experiment, &spec, seed, COUNT);
        let mut host = algorithm_on(Device::Cpu, &spec, &experiment, 4);
        let mut there = algorithm_on(device, &spec, &experiment, 5);
        step(&mut *host, Device::Cpu, &unrolls(0));
        there.load_state(&host.state()).unwrap();
        assert_eq!(state(&*host), state(&*there), "{name}: taken over");
        step(&mut *there, device, &unrolls(1));
        let mut back = algorithm_on(Device::Cpu, &spec, &experiment, 6);
        back.load_state(&there.state()).unwrap();
        assert_eq!(state(&*back), state(&*there), "{name}: and back");
        step(&mut *host, Device::Cpu, &unrolls(1));
        let (worst, of) = distance(&*host, &*back, "", 1e-3);
        assert!(worst <= 1e-4, "{name}: {of} differs by {worst:e}");
    }
}

#[cfg(feature = "xla")]
#[test]
fn whatever_the_mix_of_tasks_and_ends_nothing_is_compiled_twice() {
    let device = backend().device();
    for (name, experiment, spec) in experiments() {
        let mut learner = algorithm_on(device, &spec, &experiment, 7);
        let mut after_warm_up = 0;
        for seed in 0..if spec.tasks.len() > 1 { 200 } else { 20 } {
            if seed == 3 {
                after_warm_up = backend().compilations().unwrap();
            }
            // A value that a schedule changes must not be a constant of a program.
            learner.set_progress(f64::from(seed) / 300.0);
            let losses = step(&mut *learner, device, &Unrolls::recorded(&experiment, &spec, 1000 + seed as u64, COUNT));
            assert!(losses.is_finite(), "{name}");
        }
        assert_eq!(backend().compilations().unwrap(), after_warm_up, "{name}: compiled after the warm-up");
    }
}

#[cfg(feature = "xla")]
#[test]
fn no_other_thread_runs_backward_passes() {
    let (_, experiment, spec) = experiments().remove(0);
    std::thread::scope(|scope| {
        let trains = || {
            backend().train_here().unwrap();
            let device = backend().device();
            let mut learner = algorithm_on(device, &spec, &experiment, 9);
            for seed in 0..10 {
                step(&mut *learner, device, &Unrolls::recorded(&experiment, &spec, seed, COUNT));
            }
        };
        // Opened by this thread.
        backend();
        scope.spawn(trains);
    });
    // libtorch starts its threads in any case. A thread that is used waits for each pass.
    for thread in std::fs::read_dir("/proc/self/task").unwrap() {
        let status = std::fs::read_to_string(thread.unwrap().path().join("status")).unwrap_or_default();
        let field = |name: &str| status.lines().find_map(|line| line.strip_prefix(name)).unwrap_or_default().trim();
        if field("Name:").starts_with("pt_autograd") {
            let waits: u64 = field("voluntary_ctxt_switches:").parse().unwrap();
            assert!(waits < 5, "{} was woken {waits} times", field("Name:"));
        }
    }
}
