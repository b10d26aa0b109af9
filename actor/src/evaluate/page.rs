//! The page of an evaluation: its worst, its median and its best start.

use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::sync::Arc;

use comic_experiment::TaskSpec;
use comic_proto::UnrollShape;
use comic_tasks::{Ghost, Outcome, Simulated, Step, Task};

use super::report::Finished;
use super::settings::RolloutSettings;
use super::{Audience, Start, roll_out};
use crate::Error;
use crate::acting_loop::Controller;
use crate::forward_pass::ForwardPass;
use crate::page::document::Document;
use crate::page::recorder::PageRecorder;

/// How the page looks.
pub(super) struct Look {
    pub(super) title: String,
    /// Where the reference is at first.
    pub(super) ghost: Option<Ghost>,
    /// Control steps from one pose to the next.
    pub(super) every: usize,
}

/// Plays the three starts again and makes their page. `finished` is what the evaluation found. Their poses were not kept,
/// because an evaluation may have any number of episodes.
pub(super) fn make<F: ForwardPass>(
    look: Look,
    controller: &mut Controller<'_, F>,
    task: &Arc<dyn Task>,
    shape: &UnrollShape,
    finished: &[Finished],
    options: &RolloutSettings,
) -> Result<Document, Error> {
    let spec = task.spec();
    let chosen = worst_median_best(spec, finished);
    let start = |episode: &Finished| Start { clip: episode.clip, start: episode.start, number: episode.number };
    let own = chosen.iter().map(|(_, episode)| start(episode));
    let others = finished.iter().map(start).filter(|start| chosen.iter().all(|(_, own)| own.number != start.number));
    // As many environments as in the evaluation: another size of the batch would round differently.
    let environments = finished.len().min(options.environments).max(chosen.len());
    let starts: Vec<Start> = own.chain(others).take(environments).collect();
    let left = chosen.iter().map(|(_, episode)| episode.number).collect();
    let mut recording = Recording { recorder: PageRecorder::new(spec, look.every), left };
    roll_out(controller, task, shape, &starts, options, &mut recording)?;
    let ending = |(name, episode): &(&str, &Finished)| {
        episode.ending(spec, format!("{name} ({:.3})", episode.normalised_reward(spec)))
    };
    let endings: Vec<_> = chosen.iter().map(ending).collect();
    Ok(recording.recorder.document(look.title, task.control_timestep(), look.ghost, &endings))
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

/// Records the chosen episodes until they are over.
struct Recording<'a> {
    recorder: PageRecorder<'a>,
    /// The numbers of those that are not over.
    left: BTreeSet<usize>,
}

impl Audience<Box<dyn Simulated>> for Recording<'_> {
    fn watch(
        &mut self,
        number: usize,
        environment: &mut Box<dyn Simulated>,
        step: Option<&Step>,
    ) -> Result<ControlFlow<()>, Error> {
        if self.left.contains(&number) {
            self.recorder.record(number, environment.as_ref(), step)?;
        }
        if step.is_some_and(|step| step.outcome != Outcome::Running) {
            self.left.remove(&number);
        }
        Ok(if self.left.is_empty() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }

    fn count(&mut self, _: usize, _: usize) {}
}

#[cfg(test)]
mod tests {
    use comic_tasks::{Achievement, MAX_REWARD_TERMS};

    use super::*;
    use crate::evaluate::TrackingSums;

    fn episode(number: usize, sum: f64) -> Finished {
        let mut returns = [0.0; MAX_REWARD_TERMS];
        returns[0] = sum;
        Finished {
            number,
            clip: 0,
            start: 0,
            steps_left: 10,
            rewards: vec![0.0; 10],
            returns,
            head_heights: 0.0,
            tracking: TrackingSums::default(),
            achievement: Achievement::new(true),
            outcome: Outcome::Truncated,
        }
    }

    /// The names of the chosen episodes and their numbers, of episodes with these returns.
    fn chosen(returns: &[f64]) -> Vec<(&'static str, usize)> {
        let finished: Vec<Finished> = returns.iter().enumerate().map(|(number, sum)| episode(number, *sum)).collect();
        let spec = TaskSpec::default();
        worst_median_best(&spec, &finished).into_iter().map(|(name, episode)| (name, episode.number)).collect()
    }

    #[test]
    fn the_worst_the_median_and_the_best_are_by_normalised_reward() {
        assert_eq!(chosen(&[5.0, 1.0, 9.0, 2.0, 7.0]), [("worst", 1), ("median", 0), ("best", 2)]);
        assert_eq!(chosen(&[4.0, 1.0, 3.0, 2.0]), [("worst", 1), ("median", 3), ("best", 0)]);
        assert_eq!(chosen(&[4.0, 1.0]), [("worst", 1), ("best", 0)]);
        assert_eq!(chosen(&[4.0]), [("worst", 0)]);
        assert_eq!(chosen(&[]), []);
    }
}
