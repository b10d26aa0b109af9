//! Diagonal Gaussians: closed forms and properties.

use comic_networks::DiagonalGaussian;
use proptest::prelude::*;
use tch::Tensor;

fn gaussian(mean: &[f32], std: &[f32]) -> DiagonalGaussian {
    let row = |values: &[f32]| Tensor::from_slice(values).unsqueeze(0);
    DiagonalGaussian { mean: row(mean), std: row(std) }
}

fn number(tensor: &Tensor) -> f64 {
    tensor.double_value(&[0])
}

fn close(left: f64, right: f64) -> bool {
    (left - right).abs() <= 1e-5 * left.abs().max(right.abs()).max(1.0)
}

#[test]
fn log_prob_of_the_standard_normal_at_zero_is_minus_half_ln_tau_per_dimension() {
    let log_prob =
        gaussian(&[0.0; 3], &[1.0; 3]).log_prob(&Tensor::zeros([1, 3], (tch::Kind::Float, tch::Device::Cpu)));
    assert!(close(number(&log_prob), -1.5 * std::f64::consts::TAU.ln()));
}

#[test]
fn kl_std_uses_variances_and_not_standard_deviations() {
    // ln 2 + ½ (1/4 − 1). With σ in place of σ² it would be ln 2 + ½ (1/2 − 1).
    let kl = gaussian(&[0.0], &[2.0]).kl_std(&gaussian(&[0.0], &[1.0]));
    assert!(close(number(&kl), std::f64::consts::LN_2 - 0.375));
}

#[test]
fn kl_mean_uses_the_standard_deviation_of_the_behaviour_policy() {
    let kl = gaussian(&[1.0], &[7.0]).kl_mean(&gaussian(&[0.0], &[0.5]));
    assert!(close(number(&kl), 2.0));
}

#[test]
fn ar1_prior_has_variance_one_minus_alpha_squared() {
    let alpha = 0.95f32;
    let previous = Tensor::from_slice(&[0.4f32, -1.2]).unsqueeze(0);
    let prior = gaussian(&[alpha * 0.4, alpha * -1.2], &[(1.0 - alpha * alpha).sqrt(); 2]);
    let inside = Tensor::from_slice(&[0f32]);
    assert!(number(&prior.kl_to_ar1(0.95, &previous, &inside)).abs() < 1e-5);
    let other = gaussian(&[0.1, 0.2], &[0.3, 0.9]);
    let expected = number(&other.kl(&prior));
    assert!(close(number(&other.kl_to_ar1(0.95, &previous, &inside)), expected));
}

#[test]
fn ar1_prior_is_the_standard_normal_at_an_episodes_first_step() {
    let previous = Tensor::from_slice(&[3f32, -3.0]).unsqueeze(0);
    let first = Tensor::from_slice(&[1f32]);
    let posterior = gaussian(&[0.1, 0.2], &[0.3, 0.9]);
    let kl = posterior.kl_to_ar1(0.95, &previous, &first);
    assert!(close(number(&kl), number(&posterior.kl_to_standard_normal())));
}

fn parameters() -> impl Strategy<Value = (Vec<f32>, Vec<f32>, Vec<f32>, Vec<f32>)> {
    let mean = || prop::collection::vec(-3f32..3.0, 4);
    let std = || prop::collection::vec(0.01f32..3.0, 4);
    (mean(), std(), mean(), std())
}

proptest! {
    #[test]
    fn the_kl_to_itself_is_zero_and_exactly_zero_for_mean_and_std((mean, std, _, _) in parameters()) {
        let policy = gaussian(&mean, &std);
        prop_assert_eq!(number(&policy.kl_mean(&policy)), 0.0);
        prop_assert_eq!(number(&policy.kl_std(&policy)), 0.0);
        prop_assert!(number(&policy.kl(&policy)).abs() < 1e-6);
    }

    #[test]
    fn no_kl_is_negative((mean, std, other_mean, other_std) in parameters()) {
        let (policy, other) = (gaussian(&mean, &std), gaussian(&other_mean, &other_std));
        for kl in [policy.kl(&other), policy.kl_mean(&other), policy.kl_std(&other), policy.kl_to_standard_normal()] {
            prop_assert!(number(&kl) >= -1e-5);
        }
    }

    #[test]
    fn kl_to_the_standard_normal_equals_the_general_formula((mean, std, _, _) in parameters()) {
        let policy = gaussian(&mean, &std);
        let standard = gaussian(&[0.0; 4], &[1.0; 4]);
        prop_assert!(close(number(&policy.kl_to_standard_normal()), number(&policy.kl(&standard))));
    }

    #[test]
    fn entropy_is_minus_the_expected_log_prob((mean, std, _, _) in parameters()) {
        // ln p is quadratic, so E[ln p] is the mean of its values at one standard deviation to each side.
        let policy = gaussian(&mean, &std);
        let at = |side: f64| number(&policy.log_prob(&(&policy.mean + &policy.std * side)));
        let expected = -(at(1.0) + at(-1.0)) / 2.0;
        prop_assert!(close(number(&policy.entropy()), expected));
    }

    #[test]
    fn kl_mean_or_kl_std_is_the_whole_kl_if_only_one_parameter_differs((mean, std, other_mean, other_std) in parameters()) {
        let policy = gaussian(&mean, &std);
        let moved = gaussian(&other_mean, &std);
        prop_assert!(close(number(&moved.kl_mean(&policy)), number(&policy.kl(&moved))));
        let widened = gaussian(&mean, &other_std);
        prop_assert!(close(number(&widened.kl_std(&policy)), number(&policy.kl(&widened))));
    }
}
