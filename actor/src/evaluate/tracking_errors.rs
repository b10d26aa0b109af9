//! How far a body is from its reference, as papers on motion tracking measure it.

/// Sums over the steps of an episode. Each step counts with the mean over the root and the bodies that tracking compares.
/// The sums are 0 in a task without a reference.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrackingSums {
    /// Distances in the world, m: PHC's E_g-mpjpe.
    pub position: f64,
    /// Distances when both roots are at the same place, m: PHC's E_mpjpe.
    pub local_position: f64,
    /// Differences of the distances moved in the step, m: PHC's E_vel.
    pub velocity: f64,
    /// Steps with a reference.
    pub steps: usize,
}

/// The sums of an episode that still runs, and the errors before its next step.
#[derive(Clone, Debug, Default)]
pub(super) struct TrackingErrors {
    sums: TrackingSums,
    previous: Vec<[f64; 3]>,
}

impl TrackingErrors {
    /// At the start of an episode with these position errors.
    pub(super) fn at_start(errors: &[[f64; 3]]) -> Self {
        Self { sums: TrackingSums::default(), previous: errors.to_vec() }
    }

    /// Adds a step after which the bodies have these position errors, m, the root's first.
    ///
    /// The difference of two velocities is the change of the position error.
    pub(super) fn add(&mut self, errors: &[[f64; 3]]) {
        let Some(root) = errors.first() else { return };
        let mean = |distance: &dyn Fn(usize, &[f64; 3]) -> f64| {
            errors.iter().enumerate().map(|(body, error)| distance(body, error)).sum::<f64>() / errors.len() as f64
        };
        self.sums.position += mean(&|_, error| distance(error, &[0.0; 3]));
        self.sums.local_position += mean(&|_, error| distance(error, root));
        self.sums.velocity +=
            mean(&|body, error| self.previous.get(body).map_or(0.0, |before| distance(error, before)));
        self.sums.steps += 1;
        self.previous.clear();
        self.previous.extend_from_slice(errors);
    }

    /// The sums over all steps so far.
    pub(super) fn sums(&self) -> TrackingSums {
        self.sums
    }
}

fn distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_formulas_by_hand() {
        let mut errors = TrackingErrors::at_start(&[[0.0; 3]; 2]);
        // The root is 3 m off and the body 3 m and 4 m: 5 m in the world, 4 m from the root's error.
        errors.add(&[[3.0, 0.0, 0.0], [3.0, 4.0, 0.0]]);
        assert_eq!(errors.sums(), TrackingSums { position: 4.0, local_position: 2.0, velocity: 4.0, steps: 1 });
        // Nothing changes in the second step: equal velocities.
        errors.add(&[[3.0, 0.0, 0.0], [3.0, 4.0, 0.0]]);
        assert_eq!(errors.sums(), TrackingSums { position: 8.0, local_position: 4.0, velocity: 4.0, steps: 2 });
    }

    #[test]
    fn without_a_reference_the_sums_stay_0() {
        let mut errors = TrackingErrors::at_start(&[]);
        errors.add(&[]);
        assert_eq!(errors.sums(), TrackingSums::default());
    }
}
