//! Products of a matrix with few rows.
//!
//! A matrix product of 16 rows reads each weight once and uses it 16 times: half of its time is the memory's. MKL
//! copies all weights into another order first, in each call, which takes as long as the product; oneDNN keeps that copy but is
//! slower than the weights arrive. Here the copy is made when parameters change, in the order in which one loop reads it.
//! `cargo xtask bench actor` measures the difference.

#![allow(unsafe_code, reason = "a function for some processors only is unsafe to call")]

/// Rows that are multiplied together: two registers of AVX2.
const ROWS: usize = 16;
/// Outputs that are computed together. With 2 registers each, these are 12 of AVX2's 16 registers; one more holds the weight.
const OUTPUTS: usize = 6;

/// A matrix `[outputs, inputs]` in the order in which a product of few rows reads it.
#[derive(Debug)]
pub(crate) struct Packed {
    inputs: usize,
    outputs: usize,
    /// For every [`OUTPUTS`] outputs, and for each input, the weights of these outputs. Outputs that do not exist have zeros.
    panels: Vec<[f32; OUTPUTS]>,
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

    /// Adds the product to `sums`, `[N, outputs]`: for each row of `input`, `[N, inputs]`, the matrix times the row. A row's result
    /// does not depend on the other rows, or on their number.
    pub(crate) fn add_product(&self, input: &[f32], sums: &mut [f32]) {
        let Self { inputs, outputs, .. } = *self;
        if inputs == 0 || outputs == 0 {
            return;
        }
        let mut columns = vec![[0.0; ROWS]; inputs];
        let mut products = vec![[0.0; ROWS]; outputs.next_multiple_of(OUTPUTS)];
        for (input, sums) in input.chunks(ROWS * inputs).zip(sums.chunks_mut(ROWS * outputs)) {
            // Rows that are missing at the end keep the numbers before; what becomes of them is not read.
            transposed(&mut columns, inputs, |row, start, columns| {
                let Some(values) = input.get(row * inputs + start..(row + 1) * inputs) else { return };
                columns.iter_mut().zip(values).for_each(|(column, value)| column[row] = *value);
            });
            for (panel, products) in self.panels.chunks_exact(inputs).zip(products.as_chunks_mut().0) {
                *products = product_of(panel, &columns);
            }
            transposed(&mut products, outputs, |row, start, products| {
                let Some(sums) = sums.get_mut(row * outputs + start..(row + 1) * outputs) else { return };
                sums.iter_mut().zip(products).for_each(|(sum, products)| *sum += products[row]);
            });
        }
    }
}

/// Calls `exchange` for each row and for each block of so many columns that they stay in the fastest cache, with the block's first
/// column.
fn transposed(columns: &mut [[f32; ROWS]], count: usize, mut exchange: impl FnMut(usize, usize, &mut [[f32; ROWS]])) {
    const BLOCK: usize = 64;
    for (block, columns) in columns[..count].chunks_mut(BLOCK).enumerate() {
        (0..ROWS).for_each(|row| exchange(row, block * BLOCK, columns));
    }
}

/// The products of a panel's outputs with all rows.
fn product_of(panel: &[[f32; OUTPUTS]], columns: &[[f32; ROWS]]) -> [[f32; ROWS]; OUTPUTS] {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: the processor has both.
        return unsafe { x86_64::product_of(panel, columns) };
    }
    accumulate(panel, columns, |weight, value, sum| weight * value + sum)
}

#[cfg(target_arch = "x86_64")]
mod x86_64 {
    use super::{OUTPUTS, ROWS, accumulate};

    #[target_feature(enable = "avx2,fma")]
    pub(super) fn product_of(panel: &[[f32; OUTPUTS]], columns: &[[f32; ROWS]]) -> [[f32; ROWS]; OUTPUTS] {
        accumulate(panel, columns, f32::mul_add)
    }
}

/// The loop over the inputs. It is compiled for each processor, with its way to multiply and add.
#[inline(always)]
fn accumulate(
    panel: &[[f32; OUTPUTS]],
    columns: &[[f32; ROWS]],
    multiply_add: impl Fn(f32, f32, f32) -> f32,
) -> [[f32; ROWS]; OUTPUTS] {
    let mut sums = [[0.0; ROWS]; OUTPUTS];
    for (weights, column) in panel.iter().zip(columns) {
        for (sums, weight) in sums.iter_mut().zip(weights) {
            for (sum, value) in sums.iter_mut().zip(column) {
                *sum = multiply_add(*weight, *value, *sum);
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Numbers in [−1, 1), the same for the same seed.
    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|index| ((index * 7919 + seed * 104_729) % 2003) as f32 / 1001.5 - 1.0).collect()
    }

    fn product(packed: &Packed, input: &[f32], rows: usize) -> Vec<f32> {
        let mut sums = vec![0.5; rows * packed.outputs];
        packed.add_product(input, &mut sums);
        sums
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
    fn processors_without_the_special_instructions_give_the_same_to_rounding() {
        let packed = Packed::new(&numbers(6 * 300, 3), 300);
        let columns: Vec<[f32; ROWS]> = numbers(300 * ROWS, 4).as_chunks().0.to_vec();
        let plain = accumulate(&packed.panels, &columns, |weight, value, sum| weight * value + sum);
        for (plain, found) in plain.iter().flatten().zip(product_of(&packed.panels, &columns).iter().flatten()) {
            assert!((plain - found).abs() < 1e-4, "{plain} {found}");
        }
    }
}
