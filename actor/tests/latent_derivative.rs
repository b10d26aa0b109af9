//! The derivative with respect to a policy's action in transfer, through the frozen low level, against finite differences of
//! the true simulation.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use std::path::Path;
use std::sync::Arc;

use comic_actor::forward_pass::{Actuated, ForwardPass as _};
use comic_actor::policy::TorchPolicy;
use comic_clips::Catalogue;
use comic_experiment::{ACTION_SIZE, PROPRIOCEPTION_SIZE, TaskSpec, resolve};
use comic_networks::FrozenLowLevel;
use comic_networks::export::Exported;
use comic_tasks::{Environment as _, Simulated, Task};
use tch::{Kind, Tensor};

/// Control steps before the derivative is taken, and whose rewards it is the derivative of.
const BEFORE: usize = 4;
const HORIZON: usize = 5;
/// Directions in which the derivative is compared.
const DIRECTIONS: usize = 8;
/// The corridor's target velocity, m/s.
const TARGET: f64 = 1.5;

/// The reward that the corridor differentiates: 1 less |v − target| / target, rounded within a fifth.
fn reward(speed: f64) -> f64 {
    let error = ((speed - TARGET) / TARGET).abs();
    1.0 - if error < 0.2 { error * error / 0.4 } else { error - 0.1 }
}

fn row(values: &[f32]) -> Tensor {
    Tensor::from_slice(values).view([1, -1])
}

fn observe(environment: &dyn Simulated) -> Tensor {
    let (mut proprioception, mut task) = ([0.0; PROPRIOCEPTION_SIZE], [0.0; 1]);
    environment.observe(&mut proprioception, &mut task);
    row(&proprioception)
}

fn command(low_level: &FrozenLowLevel, action: &Tensor, proprioception: &Tensor) -> [f32; ACTION_SIZE] {
    let (command, _) = low_level.act(action, proprioception, &Tensor::zeros([1, 0], (Kind::Float, tch::Device::Cpu)));
    let mut values = [0.0; ACTION_SIZE];
    command.clamp(-1.0, 1.0).copy_data(&mut values, ACTION_SIZE);
    values
}

/// A walk's start, and some steps of the low level.
fn walking(task: &Arc<dyn Task>, low_level: &FrozenLowLevel, start: usize, mean: &Tensor) -> Box<dyn Simulated> {
    let mut environment = Arc::clone(task).environment(1).unwrap();
    environment.record_gradients().unwrap();
    environment.reset_to(0, start).unwrap();
    for _ in 0..BEFORE {
        let command = command(low_level, mean, &observe(environment.as_ref()));
        environment.step(&command);
    }
    environment.take_gradients();
    environment
}

/// Cosine and ratio of sizes of the derivative and of central differences, with respect to the action of one step, along
/// [`DIRECTIONS`] random directions. Each difference needs two simulations, and an arena for each.
fn agreement(task: &Arc<dyn Task>, low_level: &FrozenLowLevel, start: usize, action: &Tensor) -> (f64, f64) {
    let mut environment = walking(task, low_level, start, &action.zeros_like());
    let proprioception = observe(environment.as_ref());
    let mut commands = Vec::new();
    for _ in 0..HORIZON {
        let command = command(low_level, action, &observe(environment.as_ref()));
        environment.step(&command);
        commands.push(command);
    }
    let along = row(&environment.take_gradients()[0]);
    let state = Tensor::zeros([1, 0], (Kind::Float, tch::Device::Cpu));
    let found = low_level.action_derivatives(action, &proprioception, &state, &along).unwrap();
    let directions = Tensor::randn([DIRECTIONS as i64, action.size()[1]], (Kind::Float, tch::Device::Cpu));
    let found = Vec::<f64>::try_from(directions.matmul(&found.view([-1])).to_kind(Kind::Double)).unwrap();
    // Later commands are held fixed.
    let sum = |direction: usize, change: f64| {
        let moved = action + directions.narrow(0, direction as i64, 1) * change;
        let mut environment = walking(task, low_level, start, &action.zeros_like());
        let mut commands = commands.clone();
        commands[0] = command(low_level, &moved, &proprioception);
        let step = |command: &[f32; ACTION_SIZE]| {
            environment.step(command);
            reward(environment.simulation().qvel()[0])
        };
        commands.iter().map(step).sum::<f64>()
    };
    let expected: Vec<f64> =
        (0..DIRECTIONS).map(|direction| (sum(direction, 1e-3) - sum(direction, -1e-3)) / 2e-3).collect();
    let product = |one: &[f64], other: &[f64]| one.iter().zip(other).map(|(one, other)| one * other).sum::<f64>();
    let (own, other) = (product(&found, &found), product(&expected, &expected));
    (product(&found, &expected) / (own * other).sqrt(), (own / other).sqrt())
}

#[test]
fn in_stance_the_latents_derivative_is_that_of_finite_differences() {
    let fields = ["clips=[{source=\"builtin:walk\"}]", "gaps.corridor.gradient.decay=1"].map(String::from);
    let experiment = resolve("transfer-corridor", &fields).unwrap();
    let task = comic_tasks::build(&experiment, &Catalogue::open(&experiment.clips).unwrap()).unwrap();
    let low_level = Exported::open_or_builtin(Path::new("builtin")).unwrap().freeze(&experiment.transfer).unwrap();
    tch::manual_seed(1);
    let action = Tensor::randn([1, experiment.action_size() as i64], (Kind::Float, tch::Device::Cpu)) * 0.3;
    let found: Vec<(f64, f64)> = (0..5).map(|start| agreement(&task, &low_level, start, &action)).collect();
    println!("{found:.3?}");
    let (mut cosines, mut sizes): (Vec<f64>, Vec<f64>) = found.into_iter().unzip();
    cosines.sort_by(f64::total_cmp);
    sizes.sort_by(f64::total_cmp);
    assert!(cosines[2] > 0.9 && (0.75..1.3).contains(&sizes[2]), "{cosines:?} {sizes:?}");
}

/// What the worker asks for is the low level's own derivative, one row for each step.
#[test]
fn the_acting_policy_gives_the_derivatives_of_its_frozen_low_level() {
    let mut experiment = resolve("transfer-corridor", &[]).unwrap();
    let file = Exported::open_or_builtin(Path::new("builtin")).unwrap();
    file.describe_low_level(&mut experiment.network).unwrap();
    let spec = TaskSpec::new(&experiment, Vec::new()).unwrap();
    let mut policy =
        TorchPolicy::untrained(&spec, &experiment, Some(&file.bytes), 1, || Ok([0.0; ACTION_SIZE])).unwrap();
    tch::manual_seed(2);
    let [action, proprioception, along] = [spec.action, PROPRIOCEPTION_SIZE, ACTION_SIZE]
        .map(|width| Tensor::randn([3, width as i64], (Kind::Float, tch::Device::Cpu)));
    let values = |tensor: &Tensor| Vec::<f32>::try_from(tensor.view([-1])).unwrap();
    let actuated = Actuated {
        steps: 3,
        action: values(&action),
        proprioception: values(&proprioception),
        low_level_state: Vec::new(),
        derivatives: values(&along),
    };
    let found = policy.action_derivatives(actuated).unwrap();
    let state = Tensor::zeros([3, 0], (Kind::Float, tch::Device::Cpu));
    let low_level = file.freeze(&experiment.transfer).unwrap();
    let expected = low_level.action_derivatives(&action, &proprioception, &state, &along).unwrap();
    assert_eq!(found, values(&expected));
    assert!(found.iter().any(|entry| *entry != 0.0));
}
