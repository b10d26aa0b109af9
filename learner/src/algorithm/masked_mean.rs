//! The mean over the rows that hold a transition.

use tch::{Kind, Tensor};

/// The mean of `values` over the steps where `valid` is 1; 0 where there is none.
pub fn masked_mean(values: &Tensor, valid: &Tensor) -> Tensor {
    ValidSteps::alone(valid).mean(values)
}

/// The steps that hold a transition, of this rank and of all ranks.
#[derive(Debug)]
pub struct ValidSteps {
    own: Tensor,
    all: Tensor,
    /// At least 1.
    count: Tensor,
}

impl ValidSteps {
    /// The steps where `valid` is 1, of a learner alone.
    pub fn alone(valid: &Tensor) -> Self {
        let mask = valid.gt(0.5);
        Self::of_ranks(mask.shallow_clone(), mask)
    }

    /// The steps where a mask of this rank's steps is true, and one of those of all ranks, in the order of the ranks.
    pub fn of_ranks(own: Tensor, all: Tensor) -> Self {
        let count = all.sum(Kind::Float).clamp_min(1.0);
        Self { own, all, count }
    }

    /// True where a step of all ranks holds a transition.
    pub fn all(&self) -> &Tensor {
        &self.all
    }

    /// How many they are on all ranks, at least 1.
    pub fn count(&self) -> &Tensor {
        &self.count
    }

    /// This rank's share of the mean over all of them: those of all ranks add up to it. 0 where there is none.
    pub fn mean(&self, values: &Tensor) -> Tensor {
        values.where_scalarother(&self.own, 0.0).sum(Kind::Float) / &self.count
    }

    /// The whole mean, of the values of all ranks.
    pub fn mean_of_all(&self, values: &Tensor) -> Tensor {
        values.where_scalarother(&self.all, 0.0).sum(Kind::Float) / &self.count
    }
}
