//! The mean over the rows that hold a transition.

use tch::{Kind, Tensor};

use crate::world::{self, World};

/// The mean of `values` over the steps where `valid` is 1; 0 where there is none.
pub fn masked_mean(values: &Tensor, valid: &Tensor) -> Tensor {
    ValidSteps::alone(valid).mean(values)
}

/// The steps that hold a transition, and their number over all ranks.
#[derive(Debug)]
pub struct ValidSteps {
    mask: Tensor,
    /// At least 1.
    count: Tensor,
}

impl ValidSteps {
    /// The steps where `valid` is 1, of a learner alone.
    pub fn alone(valid: &Tensor) -> Self {
        Self { mask: valid.gt(0.5), count: valid.sum(Kind::Float).clamp_min(1.0) }
    }

    /// The same for a rank of this world.
    ///
    /// # Errors
    /// When another rank is lost.
    pub fn new(valid: &Tensor, world: &World) -> Result<Self, world::Error> {
        let count = world.sum(&valid.sum(Kind::Float))?;
        Ok(Self { mask: valid.gt(0.5), count: count.clamp_min(1.0) })
    }

    /// True where the step holds a transition.
    pub fn mask(&self) -> &Tensor {
        &self.mask
    }

    /// How many they are on all ranks, at least 1.
    pub fn count(&self) -> &Tensor {
        &self.count
    }

    /// This rank's share of the mean over all of them: those of all ranks add up to it. 0 where there is none.
    pub fn mean(&self, values: &Tensor) -> Tensor {
        values.where_scalarother(&self.mask, 0.0).sum(Kind::Float) / &self.count
    }
}
