//! Mean and standard deviation of the observations, for the normaliser.

use tch::{Kind, Tensor};

/// Running sums over rows, in float64.
#[derive(Debug)]
pub struct Statistics {
    count: f64,
    sum: Tensor,
    squares: Tensor,
}

impl Statistics {
    /// Nothing seen yet, for rows `width` wide.
    pub fn new(width: i64) -> Self {
        let zeros = || Tensor::zeros([width], (Kind::Double, tch::Device::Cpu));
        Self { count: 0.0, sum: zeros(), squares: zeros() }
    }

    /// Adds rows `[…, width]`.
    pub fn absorb(&mut self, rows: &Tensor) {
        let width = self.sum.size()[0];
        let rows = rows.reshape([-1, width]).to_device(tch::Device::Cpu).to_kind(Kind::Double);
        self.count += rows.size()[0] as f64;
        self.sum += rows.sum_dim_intlist([0i64].as_slice(), false, Kind::Double);
        self.squares += rows.square().sum_dim_intlist([0i64].as_slice(), false, Kind::Double);
    }

    /// Rows seen.
    pub fn count(&self) -> f64 {
        self.count
    }

    /// Mean and standard deviation `[width]`, float32. A component that never moves gets 1, so that it stays harmless.
    pub fn mean_and_std(&self) -> (Tensor, Tensor) {
        let count = self.count.max(1.0);
        let mean = &self.sum / count;
        let variance = (&self.squares / count - mean.square()).clamp_min(0.0);
        let std = variance.sqrt();
        let moving = std.gt(1e-4);
        let std = std.where_self(&moving, &Tensor::ones_like(&std));
        (mean.to_kind(Kind::Float), std.to_kind(Kind::Float))
    }

    /// As tensors, for a checkpoint.
    pub fn state(&self, name: &str) -> Vec<(String, Tensor)> {
        vec![
            (format!("{name}.count"), Tensor::from(self.count)),
            (format!("{name}.sum"), self.sum.copy()),
            (format!("{name}.squares"), self.squares.copy()),
        ]
    }

    /// Restores what [`state`](Self::state) gave; `None` when a tensor is missing or of another shape.
    pub fn restore(&mut self, name: &str, find: impl Fn(&str) -> Option<Tensor>) -> Option<()> {
        let sum = find(&format!("{name}.sum"))?;
        let squares = find(&format!("{name}.squares"))?;
        let count = f64::try_from(find(&format!("{name}.count"))?).ok()?;
        if sum.size() != self.sum.size() || squares.size() != self.squares.size() {
            return None;
        }
        *self = Self { count, sum, squares };
        Some(())
    }
}
