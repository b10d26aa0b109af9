//! Adam against its textbook definition, and its state.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use comic_experiment::Optimiser;
use comic_learner::adam::{Adam, clip_by_global_norm, global_norm};
use proptest::prelude::*;
use tch::{Device, Kind, Tensor};

fn parameter(values: &[f32]) -> Tensor {
    Tensor::from_slice(values).set_requires_grad(true)
}

fn values(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(tensor.detach().view(-1)).unwrap()
}

/// Whether a step counts.
fn counts(yes: bool) -> Tensor {
    Tensor::from(yes)
}

fn bits(tensor: &Tensor) -> Vec<u32> {
    values(tensor).into_iter().map(f32::to_bits).collect()
}

proptest! {
    #[test]
    fn every_step_is_the_textbooks(
        start in -1f32..1.0,
        gradients in prop::collection::vec(-3f32..3.0, 1..30),
        learning_rate in 1e-4f64..1e-1,
    ) {
        let config = Optimiser::default();
        let mut adam = Adam::new(&config);
        let learnt = parameter(&[start]);
        let group = adam.add_group("all", vec![("x".into(), learnt.shallow_clone())], learning_rate);
        let (mut x, mut m, mut v) = (f64::from(start), 0.0, 0.0);
        for (index, gradient) in gradients.iter().enumerate() {
            adam.step(group, &[Tensor::from_slice(&[*gradient])], &counts(true)).unwrap();
            let gradient = f64::from(*gradient);
            m = config.beta1 * m + (1.0 - config.beta1) * gradient;
            v = config.beta2 * v + (1.0 - config.beta2) * gradient * gradient;
            let steps = (index + 1) as i32;
            let (m_hat, v_hat) = (m / (1.0 - config.beta1.powi(steps)), v / (1.0 - config.beta2.powi(steps)));
            x -= learning_rate * m_hat / (v_hat.sqrt() + config.epsilon);
            prop_assert!((f64::from(values(&learnt)[0]) - x).abs() < 1e-5 * (1.0 + learning_rate * f64::from(steps)));
        }
    }

    #[test]
    fn a_clipped_gradient_has_the_limits_norm_or_its_own(
        gradient in prop::collection::vec(-10f32..10.0, 3),
        limit in 0.1f64..20.0,
    ) {
        let mut gradients = vec![Tensor::from_slice(&gradient[..2]), Tensor::from_slice(&gradient[2..])];
        let norm = global_norm(&gradients);
        let before = norm.double_value(&[]);
        clip_by_global_norm(&mut gradients, &norm, limit);
        let after = global_norm(&gradients).double_value(&[]);
        prop_assert!((after - before.min(limit)).abs() < 1e-4 * limit.max(1.0));
    }
}

#[test]
fn each_group_has_its_own_learning_rate() {
    let mut adam = Adam::new(&Optimiser::default());
    let (slow, fast) = (parameter(&[0.0]), parameter(&[0.0]));
    let slow_group = adam.add_group("slow", vec![("a".into(), slow.shallow_clone())], 1e-3);
    let fast_group = adam.add_group("fast", vec![("b".into(), fast.shallow_clone())], 1e-1);
    for group in [slow_group, fast_group] {
        adam.step(group, &[Tensor::from_slice(&[1f32])], &counts(true)).unwrap();
    }
    assert!((values(&slow)[0] + 1e-3).abs() < 1e-6 && (values(&fast)[0] + 1e-1).abs() < 1e-5);
    adam.set_learning_rate(slow_group, 0.5);
    assert_eq!((adam.learning_rate(slow_group), adam.learning_rate(fast_group)), (0.5, 1e-1));
}

#[test]
fn a_restored_adam_continues_bit_for_bit() {
    let make = |start: &Tensor| {
        let mut adam = Adam::new(&Optimiser::default());
        let learnt = start.detach().copy().set_requires_grad(true);
        adam.add_group("all", vec![("x".into(), learnt.shallow_clone())], 1e-2);
        (adam, learnt)
    };
    let gradient = |step: i64| Tensor::arange(5, (Kind::Float, Device::Cpu)) * 0.3 - step as f64 * 0.2;
    let start = Tensor::zeros([5], (Kind::Float, Device::Cpu));
    let (mut adam, learnt) = make(&start);
    (0..4).for_each(|step| adam.step(0, &[gradient(step)], &counts(true)).unwrap());
    let (mut restored, restored_parameter) = make(&learnt);
    restored.load_state(&adam.state()).unwrap();
    (4..8).for_each(|step| {
        adam.step(0, &[gradient(step)], &counts(true)).unwrap();
        restored.step(0, &[gradient(step)], &counts(true)).unwrap();
    });
    assert_eq!(values(&learnt), values(&restored_parameter));
}

/// The same update with its corrections computed on the host, in double precision.
struct OnTheHost {
    parameter: Tensor,
    first: Tensor,
    second: Tensor,
    steps: i32,
}

impl OnTheHost {
    fn step(&mut self, gradient: &Tensor, learning_rate: f64) {
        let Optimiser { beta1, beta2, epsilon, .. } = Optimiser::default();
        self.steps += 1;
        let (bias1, bias2) = (1.0 - beta1.powf(self.steps.into()), 1.0 - beta2.powf(self.steps.into()));
        let step_size = learning_rate * bias2.sqrt() / bias1;
        let _ = self.first.lerp_(gradient, 1.0 - beta1);
        let _ = self.second.lerp_(&gradient.square(), 1.0 - beta2);
        let divisor = (self.second.sqrt() + epsilon * bias2.sqrt()) * (-1.0 / step_size);
        let _ = self.parameter.addcdiv_(&self.first, &divisor);
    }
}

#[test]
fn a_step_that_counts_equals_the_same_step_composed_of_operations() {
    let start = Tensor::linspace(-1.0, 1.0, 37, (Kind::Float, Device::Cpu));
    let mut adam = Adam::new(&Optimiser::default());
    let learnt = start.copy().set_requires_grad(true);
    let group = adam.add_group("all", vec![("x".into(), learnt.shallow_clone())], 3e-3);
    let zeros = || start.zeros_like();
    let mut expected = OnTheHost { parameter: start.copy(), first: zeros(), second: zeros(), steps: 0 };
    for step in 0..500 {
        let gradient = (&start * f64::from(step)).sin() * f64::from(10f32.powi(step % 9 - 6));
        adam.step(group, &[gradient.copy()], &counts(true)).unwrap();
        expected.step(&gradient, 3e-3);
        let difference = (&learnt.detach() - &expected.parameter).abs().max().double_value(&[]);
        assert!(difference < 1e-6, "step {step}: {difference}");
    }
}

#[test]
fn a_step_that_does_not_count_changes_not_one_bit() {
    let mut adam = Adam::new(&Optimiser::default());
    let learnt = parameter(&[0.5, -1e-30, 0.0, 7.0]);
    let group = adam.add_group("all", vec![("x".into(), learnt.shallow_clone())], 0.1);
    let poison = Tensor::from_slice(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38]);
    for step in 0..5 {
        let state =
            |adam: &Adam| adam.state().iter().map(|(_, tensor)| bits(&tensor.to_kind(Kind::Float))).collect::<Vec<_>>();
        let (parameter_before, state_before) = (bits(&learnt), state(&adam));
        adam.step(group, &[poison.copy()], &counts(false)).unwrap();
        assert_eq!((bits(&learnt), state(&adam)), (parameter_before, state_before), "before step {step}");
        // A moment that is −0 at the end.
        adam.step(group, &[Tensor::from_slice(&[1.0, -1e-30, -1e-45, step as f32])], &counts(true)).unwrap();
    }
}
