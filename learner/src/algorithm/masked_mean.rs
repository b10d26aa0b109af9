//! The mean over the rows that hold a transition.

use tch::{Kind, Tensor};

/// The mean of `values` over the steps where `valid` is 1; 0 where there is none.
pub fn masked_mean(values: &Tensor, valid: &Tensor) -> Tensor {
    values.where_scalarother(&valid.gt(0.5), 0.0).sum(Kind::Float) / valid.sum(Kind::Float).clamp_min(1.0)
}
