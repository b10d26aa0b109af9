//! Retrace against its definition as a sum, and its laws.

use comic_learner::svg0::{Trace, retrace};
use proptest::prelude::*;
use tch::Tensor;

/// A sequence: for each row reward, discount (γ d), Q′, coefficient, valid; and V′ with one number more.
#[derive(Clone, Debug)]
struct Sequence {
    rows: Vec<[f32; 5]>,
    value: Vec<f32>,
}

impl Sequence {
    fn column(&self, index: usize) -> Vec<f32> {
        self.rows.iter().map(|row| row[index]).collect()
    }

    fn retrace(&self) -> Vec<f32> {
        let tensor = |values: Vec<f32>| Tensor::from_slice(&values).unsqueeze(0);
        let [reward, discount, action_value, coefficient, valid] =
            [0, 1, 2, 3, 4].map(|index| tensor(self.column(index)));
        let value = tensor(self.value.clone());
        let trace = Trace {
            reward: &reward,
            discount: &discount,
            action_value: &action_value,
            value: &value,
            coefficient: &coefficient,
            valid: &valid,
        };
        Vec::try_from(retrace(&trace).squeeze_dim(0)).unwrap_or_default()
    }

    /// Q′_t + Σ_{s ≥ t} (Π_{t < i ≤ s} γ d_{i−1} c_i) δ_s, which ends before the first row without a transition.
    fn by_definition(&self) -> Vec<f64> {
        let number = |t: usize, index: usize| f64::from(self.rows[t][index]);
        let delta = |t: usize| number(t, 0) + number(t, 1) * f64::from(self.value[t + 1]) - number(t, 2);
        let target = |t: usize| {
            let (mut sum, mut weight) = (number(t, 2), 1.0);
            for s in t..self.rows.len() {
                if number(s, 4) == 0.0 {
                    break;
                }
                if s > t {
                    weight *= number(s - 1, 1) * number(s, 3);
                }
                sum += weight * delta(s);
            }
            if number(t, 4) == 0.0 { 0.0 } else { sum }
        };
        (0..self.rows.len()).map(target).collect()
    }
}

fn sequences() -> impl Strategy<Value = Sequence> {
    let number = || -2.0_f32..2.0;
    let row = (number(), prop_oneof![Just(0.0_f32), 0.5_f32..1.0], number(), 0.0_f32..1.0, prop::bool::weighted(0.8))
        .prop_map(|(reward, discount, q, c, valid)| [reward, discount, q, c, f32::from(u8::from(valid))]);
    prop::collection::vec(row, 1..12).prop_flat_map(move |rows| {
        let length = rows.len() + 1;
        (Just(rows), prop::collection::vec(number(), length)).prop_map(|(rows, value)| Sequence { rows, value })
    })
}

proptest! {
    #[test]
    fn the_recursion_is_the_sum_of_the_definition(sequence in sequences()) {
        for (found, expected) in sequence.retrace().into_iter().zip(sequence.by_definition()) {
            prop_assert!((f64::from(found) - expected).abs() < 1e-4 * (1.0 + expected.abs()), "{found} and {expected}");
        }
    }

    #[test]
    fn without_traces_it_is_the_one_step_target(sequence in sequences()) {
        let mut sequence = sequence;
        sequence.rows.iter_mut().for_each(|row| row[3] = 0.0);
        for (t, found) in sequence.retrace().into_iter().enumerate() {
            let [reward, discount, _, _, valid] = sequence.rows[t];
            let expected = if valid == 1.0 { reward + discount * sequence.value[t + 1] } else { 0.0 };
            prop_assert!((found - expected).abs() < 1e-5, "row {t}");
        }
    }

    /// A row without a transition is an episode's last observation: rows after it belong to another episode.
    #[test]
    fn nothing_passes_a_row_without_a_transition(sequence in sequences(), at in 0_usize..12, change in -5.0_f32..5.0) {
        let at = at.min(sequence.rows.len() - 1);
        let mut one = sequence.clone();
        one.rows[at][4] = 0.0;
        let mut other = one.clone();
        for row in &mut other.rows[at..] {
            row[0] += change;
            row[2] -= change;
        }
        other.value[at + 1..].iter_mut().for_each(|value| *value += change);
        prop_assert_eq!(&one.retrace()[..at], &other.retrace()[..at]);
    }

    /// With every coefficient 1 and no differences between values, it is the discounted sum of the rewards.
    #[test]
    fn with_full_traces_and_no_bootstrap_it_is_the_return(rewards in prop::collection::vec(-1.0_f32..1.0, 1..10)) {
        let rows = rewards.iter().map(|reward| [*reward, 0.9, 0.0, 1.0, 1.0]).collect();
        let sequence = Sequence { rows, value: vec![0.0; rewards.len() + 1] };
        let expected = rewards.iter().rev().fold(0.0, |sum, reward| reward + 0.9 * sum);
        prop_assert!((sequence.retrace()[0] - expected).abs() < 1e-4);
    }
}
