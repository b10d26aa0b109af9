//! Images of the humanoid's camera.

use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use comic_experiment::seed::derive;
use comic_experiment::{Experiment, TaskName, Vision};
use comic_tasks::vision::IMAGE_BYTES;
use comic_tasks::{Environment as _, Simulated};

use super::{ENVIRONMENTS, Subject};
use crate::figure::{Figure, Medians, interleave};

/// Images of a segment with the fast settings, and with dm_control's.
const FAST: usize = 64;
const FULL: usize = 4;

/// Milliseconds of an image with the settings of training, against dm_control's. Sixteen environments share the thread's
/// OpenGL context.
pub(super) fn vision(subject: &Subject) -> Result<Figure> {
    let mut fast = environments(subject, Vision::Fast)?;
    let Medians { value, .. } =
        interleave(subject.budget.div_f64(2.0), || Ok::<_, anyhow::Error>((draw(&mut fast, FAST)?, 0.0)))?;
    // The settings do not take turns: a thread keeps one context, and making another costs more than many images.
    let mut full = environments(subject, Vision::Full)?;
    let medians = interleave(subject.budget.div_f64(2.0), || Ok::<_, anyhow::Error>((draw(&mut full, FULL)?, 0.0)))?;
    let note = "a 64 x 64 image without shadows and multisampling, with fewer faces; floor: with dm_control's settings";
    Ok(Figure::new("actor.vision", "ms", Medians { value, floor: medians.value }, note))
}

/// Environments of the subject's task, or of gaps if that task has no images.
fn environments(subject: &Subject, vision: Vision) -> Result<Vec<Box<dyn Simulated>>> {
    let mut experiment = Experiment { task: subject.experiment.task, ..Experiment::default() };
    if subject.task.spec().image == 0 {
        experiment.task = TaskName::Gaps;
    }
    experiment.gaps.corridor.vision = vision;
    experiment.walls.corridor.vision = vision;
    let catalogue = comic_clips::Catalogue::open(&experiment.clips)?;
    let task = comic_tasks::build(&experiment, &catalogue)?;
    (0..ENVIRONMENTS as u64).map(|index| Ok(Arc::clone(&task).environment(derive(1, index))?)).collect()
}

/// Milliseconds of an image, the mean of `count` images. Between images the humanoids step, which is not counted.
fn draw(environments: &mut [Box<dyn Simulated>], count: usize) -> Result<f64> {
    let mut image = vec![0; IMAGE_BYTES];
    let mut seconds = 0.0;
    for index in 0..count {
        let environment = &mut environments[index % ENVIRONMENTS];
        environment.step(&[0.0; 56]);
        let begin = Instant::now();
        environment.draw(&mut image)?;
        seconds += begin.elapsed().as_secs_f64();
    }
    Ok(seconds * 1e3 / count as f64)
}
