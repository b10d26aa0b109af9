//! The observations of all environments after a step.

use comic_experiment::TaskSpec;
use comic_tasks::{Error, Simulated};
use numpy::{IntoPyArray as _, PyArrayMethods as _};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Observations and images, one row for each environment.
pub(super) struct Buffers {
    proprioception: usize,
    width: usize,
    image_size: usize,
    observations: Vec<f32>,
    images: Vec<u8>,
    /// Those of episodes that ended, where the same step begins new ones; else empty.
    last_observations: Vec<f32>,
    last_images: Vec<u8>,
}

/// The rows of one environment. A row that is not wanted is empty.
pub(super) struct Slot<'a> {
    proprioception: usize,
    observation: &'a mut [f32],
    image: &'a mut [u8],
    last_observation: &'a mut [f32],
    last_image: &'a mut [u8],
}

impl Buffers {
    pub(super) fn new(count: usize, spec: &TaskSpec, with_last: bool) -> Self {
        let (width, image_size) = (spec.proprioception + spec.task, spec.image);
        let last = if with_last { count } else { 0 };
        Self {
            proprioception: spec.proprioception,
            width,
            image_size,
            observations: vec![0.0; count * width],
            images: vec![0; count * image_size],
            last_observations: vec![0.0; last * width],
            last_images: vec![0; last * image_size],
        }
    }

    /// The rows, one slot for each environment.
    pub(super) fn slots(&mut self) -> Vec<Slot<'_>> {
        let Self { proprioception, width, image_size, observations, images, last_observations, last_images } = self;
        let mut rests = (images.as_mut_slice(), last_observations.as_mut_slice(), last_images.as_mut_slice());
        let slot = |observation| Slot {
            proprioception: *proprioception,
            observation,
            image: take(&mut rests.0, *image_size),
            last_observation: take(&mut rests.1, *width),
            last_image: take(&mut rests.2, *image_size),
        };
        observations.chunks_exact_mut(*width).map(slot).collect()
    }

    /// Gives the arrays to `answer`.
    pub(super) fn add_to(self, answer: &Bound<'_, PyDict>, images: [usize; 4]) -> PyResult<()> {
        let (python, shape) = (answer.py(), [images[0], self.width]);
        let vectors = [("observation", self.observations), ("final_observation", self.last_observations)];
        for (name, rows) in vectors.into_iter().filter(|(_, rows)| !rows.is_empty()) {
            answer.set_item(name, rows.into_pyarray(python).reshape(shape)?)?;
        }
        let pictures = [("image", self.images), ("final_image", self.last_images)];
        for (name, rows) in pictures.into_iter().filter(|(_, rows)| !rows.is_empty()) {
            answer.set_item(name, rows.into_pyarray(python).reshape(images)?)?;
        }
        Ok(())
    }
}

impl Slot<'_> {
    /// Writes what the environment observes.
    pub(super) fn observe(&mut self, environment: &mut dyn Simulated) -> Result<(), Error> {
        write(environment, self.proprioception, self.observation, self.image)
    }

    /// Writes it as the last observation of an episode.
    pub(super) fn observe_last(&mut self, environment: &mut dyn Simulated) -> Result<(), Error> {
        write(environment, self.proprioception, self.last_observation, self.last_image)
    }
}

fn write(
    environment: &mut dyn Simulated,
    proprioception: usize,
    row: &mut [f32],
    image: &mut [u8],
) -> Result<(), Error> {
    let (own, task) = row.split_at_mut(proprioception.min(row.len()));
    environment.observe(own, task);
    if image.is_empty() { Ok(()) } else { environment.draw(image) }
}

/// The next `size` elements, or none where there are no more.
fn take<'a, T>(rest: &mut &'a mut [T], size: usize) -> &'a mut [T] {
    let size = size.min(rest.len());
    rest.split_off_mut(..size).unwrap_or_default()
}
