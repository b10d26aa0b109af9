//! A forward pass for each environment alone.

use comic_proto::UnrollShape;

use super::{ActingBatch, Actuated, ForwardPass, LowLevelShape};
use crate::Error;

/// A forward pass for each environment alone. The order of a library's sums depends on the size of the batch. With a batch
/// of one, an environment's numbers do not depend on the number of environments.
#[derive(Debug)]
pub struct OneByOne<F> {
    forward: F,
    single: ActingBatch,
}

impl<F: ForwardPass> OneByOne<F> {
    /// Uses this forward pass for environments whose unrolls have this shape.
    pub fn new(forward: F, shape: &UnrollShape) -> Self {
        let single = ActingBatch::new(1, shape, forward.low_level());
        Self { forward, single }
    }

    /// Runs `pass` on each environment alone.
    fn each(
        &mut self,
        batch: &mut ActingBatch,
        pass: impl Fn(&mut F, &mut ActingBatch) -> Result<(), Error>,
    ) -> Result<(), Error> {
        for environment in 0..batch.environments() {
            self.single.row(0).copy_from(&batch.row(environment));
            pass(&mut self.forward, &mut self.single)?;
            batch.row(environment).copy_from(&self.single.row(0));
        }
        Ok(())
    }
}

impl<F: ForwardPass> ForwardPass for OneByOne<F> {
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error> {
        self.forward.load(parameters)
    }

    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        self.each(batch, F::forward)
    }

    fn low_level(&self) -> Option<LowLevelShape> {
        self.forward.low_level()
    }

    fn actuate(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        if self.forward.low_level().is_none() {
            return self.forward.actuate(batch);
        }
        self.each(batch, F::actuate)
    }

    /// The steps are those of one environment already.
    fn action_derivatives(&mut self, actuated: Actuated) -> Result<Vec<f32>, Error> {
        self.forward.action_derivatives(actuated)
    }
}

#[cfg(test)]
mod tests {
    use comic_proto::Field;

    use super::*;

    /// Adds the batch's size to the recurrent state.
    struct AddsBatchSize;

    impl ForwardPass for AddsBatchSize {
        fn load(&mut self, _: &[u8]) -> Result<(), Error> {
            Ok(())
        }

        fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
            let environments = batch.environments() as f32;
            batch[Field::State].iter_mut().for_each(|value| *value += environments);
            Ok(())
        }
    }

    #[test]
    fn one_by_one_every_environment_is_a_batch_of_its_own() {
        let mut batch = ActingBatch::new(3, &SHAPE, None);
        let state: Vec<f32> = (0..12).map(|value| value as f32).collect();
        batch[Field::State].copy_from_slice(&state);
        OneByOne::new(AddsBatchSize, &SHAPE).forward(&mut batch).unwrap();
        assert_eq!(batch[Field::State], (1..13).map(|value| value as f32).collect::<Vec<_>>());
    }

    const SHAPE: UnrollShape = UnrollShape {
        length: 1,
        proprioception: 0,
        task: 0,
        latent: 0,
        action: 2,
        reward_terms: 1,
        image: 0,
        components: 1,
        state: 4,
        action_gradient: 0,
    };
}
