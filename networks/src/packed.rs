//! Layers of a network for a few rows at a time.
//!
//! A matrix product of 16 rows reads each weight once and uses it 16 times: half of its time is the memory's. MKL
//! copies all weights into another order first, in each call, which takes as long as the product; oneDNN keeps that copy but is
//! slower than the weights arrive. Here the copy is made when parameters change, in the order in which one loop reads it. Between
//! the layers the numbers stay in the order of that loop, so the activations are loops over registers, too.
//! `cargo xtask bench actor` measures the difference.

#![allow(unsafe_code, reason = "a function for some processors only is unsafe to call")]

/// Rows that go through the layers together: two registers of AVX2.
const ROWS: usize = 16;
/// Outputs that are computed together. With 2 registers each, these are 12 of AVX2's 16 registers; one more holds the weight.
const OUTPUTS: usize = 6;
/// The default of PyTorch.
pub(crate) const LAYER_NORM_EPSILON: f64 = 1e-5;

/// One number in each of [`ROWS`] rows.
type Column = [f32; ROWS];

/// A matrix `[outputs, inputs]` in the order in which a product of few rows reads it.
#[derive(Debug, Default)]
pub(crate) struct Packed {
    inputs: usize,
    outputs: usize,
    /// For every [`OUTPUTS`] outputs, and for each input, the weights of these outputs. Outputs that do not exist have zeros.
    panels: Vec<[f32; OUTPUTS]>,
}

/// A layer: the matrix times its input, plus the bias if there is one, through the activation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layer<'a> {
    pub(crate) weights: &'a Packed,
    /// One number an output, or none.
    pub(crate) bias: &'a [f32],
    pub(crate) activation: Function<'a>,
}

/// What follows a linear layer.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Function<'a> {
    /// Nothing.
    Linear,
    /// tanh of the layer norm, with its scale and its shift, one number an output each.
    NormTanh { scale: &'a [f32], shift: &'a [f32] },
    /// x for positive x, eˣ − 1 otherwise.
    Elu,
}

impl Packed {
    /// Packs `weights`, `[outputs, inputs]`, row-major. Without inputs there is nothing to pack.
    pub(crate) fn new(weights: &[f32], inputs: usize) -> Self {
        let outputs = weights.len() / inputs.max(1);
        let mut panels = vec![[0.0; OUTPUTS]; outputs.div_ceil(OUTPUTS) * inputs];
        let of_panels = weights.chunks(OUTPUTS * inputs.max(1)).zip(panels.chunks_exact_mut(inputs.max(1)));
        for (weights, panel) in of_panels {
            for (output, weights) in weights.chunks_exact(inputs.max(1)).enumerate() {
                for (place, weight) in panel.iter_mut().zip(weights) {
                    place[output] = *weight;
                }
            }
        }
        Self { inputs, outputs, panels }
    }
}

/// Adds to `output`, `[N, outputs]`, what the layers make of `input`, `[N, inputs]`. Every layer has as many inputs as the one before
/// it has outputs. A row's result does not depend on the other rows, or on their number.
pub(crate) fn add_layers(layers: &[Layer<'_>], input: &[f32], output: &mut [f32]) {
    let (Some(first), Some(last)) = (layers.first(), layers.last()) else { return };
    let (inputs, outputs) = (first.weights.inputs, last.weights.outputs);
    if inputs == 0 || outputs == 0 {
        return;
    }
    let mut columns = vec![[0.0; ROWS]; inputs];
    for (input, output) in input.chunks(ROWS * inputs).zip(output.chunks_mut(ROWS * outputs)) {
        // Rows that are missing at the end keep the numbers before; what becomes of them is not read.
        transposed(&mut columns, |row, start, columns| {
            let Some(values) = input.get(row * inputs + start..(row + 1) * inputs) else { return };
            columns.iter_mut().zip(values).for_each(|(column, value)| column[row] = *value);
        });
        transposed(&mut through(layers, &columns), |row, start, columns| {
            let Some(values) = output.get_mut(row * outputs + start..(row + 1) * outputs) else { return };
            values.iter_mut().zip(columns).for_each(|(value, column)| *value += column[row]);
        });
    }
}

/// Calls `exchange` for each row and for each block of so many columns that they stay in the fastest cache, with the block's first
/// column.
fn transposed(columns: &mut [Column], mut exchange: impl FnMut(usize, usize, &mut [Column])) {
    const BLOCK: usize = 64;
    for (block, columns) in columns.chunks_mut(BLOCK).enumerate() {
        (0..ROWS).for_each(|row| exchange(row, block * BLOCK, columns));
    }
}

/// The layers' output, one column an output, for their input, one column an input.
fn through(layers: &[Layer<'_>], columns: &[Column]) -> Vec<Column> {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: the processor has both.
        return unsafe { x86_64::through(layers, columns) };
    }
    on_any_processor(layers, columns, |weight, value, sum| weight * value + sum)
}

#[cfg(target_arch = "x86_64")]
mod x86_64 {
    use super::{Column, Layer, on_any_processor};

    #[target_feature(enable = "avx2,fma")]
    pub(super) fn through(layers: &[Layer<'_>], columns: &[Column]) -> Vec<Column> {
        on_any_processor(layers, columns, f32::mul_add)
    }
}

/// A way to multiply and add. The functions below are compiled for each processor with its own.
trait MultiplyAdd: Fn(f32, f32, f32) -> f32 + Copy {}
impl<F: Fn(f32, f32, f32) -> f32 + Copy> MultiplyAdd for F {}

#[inline(always)]
fn on_any_processor(layers: &[Layer<'_>], columns: &[Column], multiply_add: impl MultiplyAdd) -> Vec<Column> {
    let mut hidden = Vec::new();
    for (index, layer) in layers.iter().enumerate() {
        let input = if index == 0 { columns } else { &hidden };
        let mut output = product(layer.weights, input, multiply_add);
        for (column, bias) in output.iter_mut().zip(layer.bias) {
            column.iter_mut().for_each(|value| *value += bias);
        }
        match layer.activation {
            Function::Linear => {}
            Function::NormTanh { scale, shift } => {
                normalise(&mut output, scale, shift);
                output.as_flattened_mut().iter_mut().for_each(|value| *value = tanh(*value, multiply_add));
            }
            Function::Elu => {
                output.as_flattened_mut().iter_mut().for_each(|value| *value = elu(*value, multiply_add));
            }
        }
        hidden = output;
    }
    hidden
}

#[inline(always)]
fn product(weights: &Packed, columns: &[Column], multiply_add: impl MultiplyAdd) -> Vec<Column> {
    let mut products = Vec::with_capacity(weights.outputs.next_multiple_of(OUTPUTS));
    for panel in weights.panels.chunks_exact(weights.inputs.max(1)) {
        let mut sums = [[0.0; ROWS]; OUTPUTS];
        for (weights, column) in panel.iter().zip(columns) {
            for (sums, weight) in sums.iter_mut().zip(weights) {
                for (sum, value) in sums.iter_mut().zip(column) {
                    *sum = multiply_add(*weight, *value, *sum);
                }
            }
        }
        products.extend(sums);
    }
    products.truncate(weights.outputs);
    products
}

/// Layer norm of every row.
#[inline(always)]
fn normalise(columns: &mut [Column], scale: &[f32], shift: &[f32]) {
    let share = 1.0 / columns.len() as f32;
    let mut mean = [0.0; ROWS];
    for column in &*columns {
        mean.iter_mut().zip(column).for_each(|(mean, value)| *mean += value * share);
    }
    let mut variance = [0.0; ROWS];
    for column in &*columns {
        for ((variance, value), mean) in variance.iter_mut().zip(column).zip(&mean) {
            *variance += (value - mean) * (value - mean) * share;
        }
    }
    let factor = variance.map(|variance| 1.0 / (variance + LAYER_NORM_EPSILON as f32).sqrt());
    for ((column, scale), shift) in columns.iter_mut().zip(scale).zip(shift) {
        for ((value, mean), factor) in column.iter_mut().zip(&mean).zip(&factor) {
            *value = (*value - mean) * factor * scale + shift;
        }
    }
}

/// tanh, to an absolute 2e-7. What is not a number stays that.
#[inline(always)]
fn tanh(value: f32, multiply_add: impl MultiplyAdd) -> f32 {
    // Beyond it, tanh is ±1 in single precision.
    const LIMIT: f32 = 9.1;
    let inner = 1.0 - 2.0 / (exp(2.0 * value, multiply_add) + 1.0);
    let limited = if value >= LIMIT { 1.0 } else { inner };
    let limited = if value <= -LIMIT { -1.0 } else { limited };
    if value.is_nan() { value } else { limited }
}

/// ELU, to an absolute 2e-7. What is not a number stays that.
#[inline(always)]
fn elu(value: f32, multiply_add: impl MultiplyAdd) -> f32 {
    // Below it, eˣ − 1 is −1 in single precision.
    const LIMIT: f32 = -20.0;
    if value <= 0.0 { exp(value.max(LIMIT), multiply_add) - 1.0 } else { value }
}

/// eˣ for x from −20 to 20, to 3e-7 of itself: 2ⁿ, n the nearest integer to x/ln 2, times the Taylor series for what is left.
#[inline(always)]
fn exp(value: f32, multiply_add: impl MultiplyAdd) -> f32 {
    /// 1.5 · 2²³: a number of this size has no bits after the point, so adding it rounds, and its last bits are the integer.
    const ROUND: f32 = 12_582_912.0;
    /// ln 2 in two parts. The first has few bits, so n times it is exact (Cody and Waite).
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    const SERIES: [f32; 6] = [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0];
    let shifted = multiply_add(value, std::f32::consts::LOG2_E, ROUND);
    let power = shifted - ROUND;
    let rest = multiply_add(-power, LN_2[1], multiply_add(-power, LN_2[0], value));
    let series = SERIES.iter().fold(1.0 / 5040.0, |sum, term| multiply_add(sum, rest, *term));
    let series = multiply_add(series, rest, 1.0);
    f32::from_bits(series.to_bits().wrapping_add(shifted.to_bits() << 23))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Numbers in [−1, 1), the same for the same seed.
    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|index| ((index * 7919 + seed * 104_729) % 2003) as f32 / 1001.5 - 1.0).collect()
    }

    fn linear(weights: &Packed) -> Layer<'_> {
        Layer { weights, bias: &[], activation: Function::Linear }
    }

    fn product(packed: &Packed, input: &[f32], rows: usize) -> Vec<f32> {
        let mut sums = vec![0.5; rows * packed.outputs];
        add_layers(&[linear(packed)], input, &mut sums);
        sums
    }

    /// Four outputs of six inputs through layer norm and tanh, and three of these through ELU.
    fn network(input: &[f32], rows: usize) -> Vec<f32> {
        let [first, second] = [Packed::new(&numbers(24, 1), 6), Packed::new(&numbers(12, 2), 4)];
        let (scale, shift, bias) = (numbers(4, 3), numbers(4, 4), numbers(4, 5));
        let activation = Function::NormTanh { scale: &scale, shift: &shift };
        let layers = [
            Layer { weights: &first, bias: &bias, activation },
            Layer { weights: &second, bias: &bias[1..], activation: Function::Elu },
        ];
        let mut output = vec![0.0; rows * 3];
        add_layers(&layers, input, &mut output);
        output
    }

    proptest! {
        #[test]
        fn a_product_is_the_sum_over_the_inputs_in_double_precision(
            rows in 1_usize..40, inputs in 1_usize..70, outputs in 1_usize..20, seed in 0_usize..1000,
        ) {
            let (weights, input) = (numbers(outputs * inputs, seed), numbers(rows * inputs, seed + 1));
            let found = product(&Packed::new(&weights, inputs), &input, rows);
            for (row, input) in input.chunks_exact(inputs).enumerate() {
                for (output, weights) in weights.chunks_exact(inputs).enumerate() {
                    let terms = input.iter().zip(weights).map(|(input, weight)| f64::from(*input) * f64::from(*weight));
                    let (expected, found) = (0.5 + terms.sum::<f64>(), f64::from(found[row * outputs + output]));
                    prop_assert!((expected - found).abs() < 1e-6 * (1.0 + inputs as f64), "{expected} {found}");
                }
            }
        }

        #[test]
        fn a_row_has_the_same_product_beside_other_rows_as_alone(
            rows in 1_usize..40, inputs in 1_usize..70, outputs in 1_usize..20, seed in 0_usize..1000,
        ) {
            let (weights, input) = (numbers(outputs * inputs, seed), numbers(rows * inputs, seed + 1));
            let packed = Packed::new(&weights, inputs);
            let alone: Vec<f32> = input.chunks_exact(inputs).flat_map(|row| product(&packed, row, 1)).collect();
            prop_assert_eq!(product(&packed, &input, rows), alone);
            let alone: Vec<f32> = numbers(rows * 6, seed).chunks_exact(6).flat_map(|row| network(row, 1)).collect();
            prop_assert_eq!(network(&numbers(rows * 6, seed), rows), alone);
        }

        #[test]
        fn the_activations_are_those_of_double_precision(value in -40f32..40.0) {
            let exact = f64::from(value);
            for plain in [true, false] {
                let multiply_add = |a: f32, b: f32, c: f32| if plain { a * b + c } else { a.mul_add(b, c) };
                prop_assert!((f64::from(tanh(value, multiply_add)) - exact.tanh()).abs() < 2e-7);
                let expected = if value > 0.0 { exact } else { exact.exp_m1() };
                prop_assert!((f64::from(elu(value, multiply_add)) - expected).abs() < 2e-7);
                if value.abs() < 20.0 {
                    prop_assert!((f64::from(exp(value, multiply_add)) / exact.exp() - 1.0).abs() < 3e-7);
                }
            }
        }
    }

    #[test]
    fn what_is_not_a_number_stays_in_its_row() {
        let packed = Packed::new(&numbers(6, 1), 2);
        let found = product(&packed, &[1.0, 2.0, f32::NAN, 1.0, 3.0, 4.0], 3);
        assert!(found[..3].iter().chain(&found[6..]).all(|value| value.is_finite()), "{found:?}");
        assert!(found[3..6].iter().all(|value| value.is_nan()), "{found:?}");
    }

    #[test]
    fn activations_keep_what_is_not_a_number_and_end_at_their_limits() {
        let multiply_add = |a: f32, b: f32, c: f32| a * b + c;
        for hostile in [f32::NAN, -f32::NAN, f32::from_bits(0x7f80_0001), f32::from_bits(0xffff_ffff)] {
            assert!(tanh(hostile, multiply_add).is_nan() && elu(hostile, multiply_add).is_nan());
        }
        for large in [100.0, 1e30, f32::INFINITY] {
            assert_eq!([tanh(large, multiply_add), tanh(-large, multiply_add)], [1.0, -1.0]);
            assert_eq!([elu(large, multiply_add), elu(-large, multiply_add)], [large, -1.0]);
        }
    }

    #[test]
    fn processors_without_the_special_instructions_give_the_same_to_rounding() {
        let packed = Packed::new(&numbers(6 * 300, 3), 300);
        let columns: Vec<Column> = numbers(300 * ROWS, 4).as_chunks().0.to_vec();
        let (scale, shift) = (numbers(6, 5), numbers(6, 6));
        let activation = Function::NormTanh { scale: &scale, shift: &shift };
        let last = Packed::new(&numbers(6 * 70, 7), 6);
        let layers = [Layer { activation, ..linear(&packed) }, Layer { activation: Function::Elu, ..linear(&last) }];
        let plain = on_any_processor(&layers, &columns, |weight, value, sum| weight * value + sum);
        for (plain, found) in plain.iter().flatten().zip(through(&layers, &columns).iter().flatten()) {
            assert!((plain - found).abs() < 1e-4, "{plain} {found}");
        }
    }
}
