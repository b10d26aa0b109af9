//! Evaluates a policy, per clip and reward term.
//!
//! An episode's normalised reward is its return / (largest reward of a step × steps left at its start), so an early fall
//! lowers it; for tracking the divisor is 1.45 × the steps left in the clip. Two more figures separate its parts: the
//! reward per survived step / the largest reward, and the fraction of steps survived.

pub mod command;
mod delivery;
mod page;
mod report;
mod rewards;
mod rollout;
mod settings;
mod table;
mod tracking_errors;
mod watch;

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
pub use settings::{RolloutSettings, Starts};
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

/// The starts to roll out, clip by clip.
fn chosen(clips: &[ClipStarts], options: &RolloutSettings) -> Vec<Start> {
    let clips: Vec<&ClipStarts> = clips.iter().filter(|clip| !clip.frames.is_empty()).collect();
    let mut rng = Pcg64::seed_from_u64(derive(options.seed, u64::MAX));
    let mut chosen = Vec::new();
    let mut add = |clip: &ClipStarts, starts: &mut dyn Iterator<Item = usize>| {
        chosen.extend(starts.map(|start| (clip.clip, start)));
    };
    match options.starts {
        Starts::Every => clips.iter().for_each(|clip| add(clip, &mut clip.frames.clone())),
        Starts::Random(episodes) => {
            clips.iter().for_each(|clip| add(clip, &mut (0..episodes).map(|_| rng.random_range(clip.frames.clone()))))
        }
        Starts::Spread(limit) => {
            let count = clips.len().min(limit);
            for (number, range) in parts(limit, count).enumerate() {
                let clip = clips[number * clips.len() / count];
                let starts = range.len().min(clip.frames.len());
                let middles =
                    parts(clip.frames.len(), starts).map(|part| clip.frames.start + part.start.midpoint(part.end));
                add(clip, &mut { middles });
            }
        }
    }
    Start::numbered(chosen)
}

/// `0..whole` in `count` parts whose lengths differ by at most 1.
fn parts(whole: usize, count: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
    (0..count).map(move |part| whole * part / count..whole * (part + 1) / count)
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
        let random = RolloutSettings { starts: Starts::Random(4), ..RolloutSettings::default() };
        let some = chosen(&clips, &random);
        assert_eq!(some.len(), 8);
        assert!(some.iter().all(|s| clips[s.clip].frames.contains(&s.start)));
        assert_eq!(some, chosen(&clips, &random));
    }

    #[test]
    fn a_spread_of_starts_has_every_clip_that_fits_and_is_even_within_each() {
        let clips = |lengths: &[usize]| -> Vec<_> {
            let clips = lengths.iter().enumerate();
            clips.map(|(clip, length)| ClipStarts { clip, frames: 0..*length, probability: 0.0 }).collect()
        };
        let spread = |limit, lengths: &[usize]| -> Vec<_> {
            let options = RolloutSettings { starts: Starts::Spread(limit), ..RolloutSettings::default() };
            chosen(&clips(lengths), &options).iter().map(|start| (start.clip, start.start)).collect()
        };
        assert_eq!(spread(4, &[80]), [(0, 10), (0, 30), (0, 50), (0, 70)]);
        assert_eq!(spread(5, &[10, 0, 90]), [(0, 2), (0, 7), (2, 15), (2, 45), (2, 75)]);
        assert_eq!(spread(2, &[8, 8, 8, 8]), [(0, 4), (2, 4)], "more clips than starts");
        assert_eq!(spread(64, &[3]), [(0, 0), (0, 1), (0, 2)], "fewer starts than wanted");
        assert_eq!(spread(64, &[]), []);
    }
}
