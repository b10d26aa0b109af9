//! The page of an evaluation: its worst, its median and its best start.

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

use comic_experiment::TaskSpec;
use comic_proto::UnrollShape;
use comic_tasks::{Simulated, Step, Task};

use super::report::Finished;
use super::settings::RolloutSettings;
use super::{Audience, Start, roll_out};
use crate::Error;
use crate::acting_loop::Controller;
use crate::forward_pass::ForwardPass;
use crate::page::document::GhostPlace;
use crate::page::recorder::PageRecorder;

/// Plays the three starts again and writes their page. `finished` is what the evaluation found; their poses were not kept,
/// because an evaluation may have any number of episodes.
pub(super) fn write<F: ForwardPass>(
    out: &Path,
    title: String,
    controller: &mut Controller<'_, F>,
    task: &Arc<dyn Task>,
    shape: &UnrollShape,
    finished: &[Finished],
    options: &RolloutSettings,
) -> Result<(), Error> {
    let spec = task.spec();
    let chosen = worst_median_best(spec, finished);
    let start = |episode: &Finished| Start { clip: episode.clip, start: episode.start };
    let own = chosen.iter().map(|(_, episode)| start(episode));
    // As many environments as in the evaluation: the same batched forward pass, and without noise the same episodes.
    let environments = finished.len().min(options.environments);
    let starts: Vec<Start> = own.chain(finished.iter().map(start)).take(environments.max(chosen.len())).collect();
    let mut recording = Recording { recorder: PageRecorder::new(spec, 1), episodes: chosen.len() };
    roll_out(controller, task, shape, &starts, options, &mut recording)?;
    let remark = |(name, episode): &(&str, &Finished)| format!("{name} ({:.3})", episode.normalised_reward(spec));
    let remarks: Vec<String> = chosen.iter().map(remark).collect();
    recording.recorder.document(title, task.control_timestep(), GhostPlace::On, &remarks).write(out)
}

/// The episodes with the lowest, the median and the highest normalised reward; of two the lowest and the highest.
fn worst_median_best<'a>(spec: &TaskSpec, finished: &'a [Finished]) -> Vec<(&'static str, &'a Finished)> {
    let mut all: Vec<&Finished> = finished.iter().collect();
    all.sort_by(|one, other| one.normalised_reward(spec).total_cmp(&other.normalised_reward(spec)));
    let last = all.len().saturating_sub(1);
    let mut places = vec![("worst", 0), ("median", last / 2), ("best", last)];
    places.dedup_by_key(|(_, place)| *place);
    places.into_iter().filter_map(|(name, place)| Some((name, *all.get(place)?))).collect()
}

/// Records the first episodes.
struct Recording<'a> {
    recorder: PageRecorder<'a>,
    episodes: usize,
}

impl Audience<Box<dyn Simulated>> for Recording<'_> {
    fn watch(
        &mut self,
        number: usize,
        environment: &mut Box<dyn Simulated>,
        step: Option<&Step>,
    ) -> Result<ControlFlow<()>, Error> {
        if number < self.episodes {
            self.recorder.record(number, environment.as_ref(), step)?;
        }
        Ok(ControlFlow::Continue(()))
    }

    fn count(&mut self, _: usize, _: usize) {}
}
