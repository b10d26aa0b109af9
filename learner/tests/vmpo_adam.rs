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
            adam.step(group, &[Tensor::from_slice(&[*gradient])]);
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
fn groups_have_learning_rates_of_their_own() {
    let mut adam = Adam::new(&Optimiser::default());
    let (slow, fast) = (parameter(&[0.0]), parameter(&[0.0]));
    let slow_group = adam.add_group("slow", vec![("a".into(), slow.shallow_clone())], 1e-3);
    let fast_group = adam.add_group("fast", vec![("b".into(), fast.shallow_clone())], 1e-1);
    for group in [slow_group, fast_group] {
        adam.step(group, &[Tensor::from_slice(&[1f32])]);
    }
    assert!((values(&slow)[0] + 1e-3).abs() < 1e-6 && (values(&fast)[0] + 1e-1).abs() < 1e-5);
    adam.set_learning_rate(slow_group, 0.5);
    assert_eq!((adam.learning_rate(slow_group), adam.learning_rate(fast_group)), (0.5, 1e-1));
}

#[test]
fn a_restored_adam_goes_on_bit_for_bit_and_a_reset_one_starts_anew() {
    let make = |start: &Tensor| {
        let mut adam = Adam::new(&Optimiser::default());
        let learnt = start.detach().copy().set_requires_grad(true);
        adam.add_group("all", vec![("x".into(), learnt.shallow_clone())], 1e-2);
        (adam, learnt)
    };
    let gradient = |step: i64| Tensor::arange(5, (Kind::Float, Device::Cpu)) * 0.3 - step as f64 * 0.2;
    let start = Tensor::zeros([5], (Kind::Float, Device::Cpu));
    let (mut adam, learnt) = make(&start);
    (0..4).for_each(|step| adam.step(0, &[gradient(step)]));
    let (mut restored, restored_parameter) = make(&learnt);
    restored.load_state(&adam.state()).unwrap();
    (4..8).for_each(|step| {
        adam.step(0, &[gradient(step)]);
        restored.step(0, &[gradient(step)]);
    });
    assert_eq!(values(&learnt), values(&restored_parameter));
    let (mut fresh, fresh_parameter) = make(&learnt);
    adam.reset();
    adam.step(0, &[gradient(9)]);
    fresh.step(0, &[gradient(9)]);
    assert_eq!(values(&learnt), values(&fresh_parameter));
}
