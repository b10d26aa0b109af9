//! Evaluates a policy, per clip and reward term.
//!
//! An episode's normalised reward is its return / (largest reward of a step × steps left at its start), so an early fall
//! lowers it; for tracking the divisor is 1.45 × the steps left in the clip. Two more figures separate its parts: the
//! reward per survived step / the largest reward, and the fraction of steps survived.

pub mod command;
mod delivery;
mod report;
mod rewards;
mod rollout;
mod settings;
mod table;
mod tracking_errors;

use std::sync::Arc;

use comic_experiment::seed::derive;
use comic_proto::UnrollShape;
use comic_tasks::{ClipStarts, Simulated, Task};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;

use crate::Error;
use crate::acting_loop::Controller;
use crate::forward_pass::ForwardPass;

pub use report::{ClipReport, Finished, Report, TrackingError};
pub use rollout::{Audience, Start};
pub use settings::RolloutSettings;
pub use tracking_errors::TrackingSums;

/// Rolls out the starts of the clips of `task` that the options choose; `shape` is the shape of its experiment's
/// unrolls.
///
/// # Errors
/// A failing forward pass, a start that the task does not have, or what the audience returns.
pub fn evaluate<F: ForwardPass>(
    controller: &mut Controller<'_, F>,
    task: &Arc<dyn Task>,
    shape: &UnrollShape,
    options: &RolloutSettings,
    audience: &mut dyn Audience<Box<dyn Simulated>>,
) -> Result<Vec<Finished>, Error> {
    let starts = chosen(task.starts(), options);
    roll_out(controller, task, shape, &starts, options, audience)
}

/// Rolls out these starts until all are done or the audience breaks.
///
/// # Errors
/// As for [`evaluate`].
pub fn roll_out<F: ForwardPass>(
    controller: &mut Controller<'_, F>,
    task: &Arc<dyn Task>,
    shape: &UnrollShape,
    starts: &[Start],
    options: &RolloutSettings,
    audience: &mut dyn Audience<Box<dyn Simulated>>,
) -> Result<Vec<Finished>, Error> {
    let environments = (0..options.environments.min(starts.len()).max(1) as u64)
        .map(|index| Arc::clone(task).environment(derive(options.seed, index)))
        .collect::<Result<Vec<Box<dyn Simulated>>, _>>()?;
    rollout::run(controller, environments, shape, starts, options, audience)
}

/// The starts to roll out: all of them, or random ones.
fn chosen(clips: &[ClipStarts], options: &RolloutSettings) -> Vec<Start> {
    let mut rng = Pcg64::seed_from_u64(derive(options.seed, u64::MAX));
    let mut chosen = Vec::new();
    for ClipStarts { clip, frames, .. } in clips.iter().filter(|clip| !clip.frames.is_empty()) {
        let start = |start| Start { clip: *clip, start };
        match options.episodes {
            None => chosen.extend(frames.clone().map(start)),
            Some(episodes) => chosen.extend((0..episodes).map(|_| start(rng.random_range(frames.clone())))),
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_start_is_chosen_once_or_random_ones_by_the_seed() {
        let clips = [0..3, 0..0, 5..6].into_iter().enumerate();
        let clips: Vec<_> = clips.map(|(clip, frames)| ClipStarts { clip, frames, probability: 0.0 }).collect();
        let all = chosen(&clips, &RolloutSettings::default());
        assert_eq!(all.iter().map(|s| (s.clip, s.start)).collect::<Vec<_>>(), [(0, 0), (0, 1), (0, 2), (2, 5)]);
        let random = RolloutSettings { episodes: Some(4), ..RolloutSettings::default() };
        let some = chosen(&clips, &random);
        assert_eq!(some.len(), 8);
        assert!(some.iter().all(|s| clips[s.clip].frames.contains(&s.start)));
        assert_eq!(some, chosen(&clips, &random));
    }
}
