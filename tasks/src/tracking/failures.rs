//! Starts of training where the policy fails: each environment remembers where its own episodes failed, and starts more
//! often shortly before such places.
//!
//! The idea is from "BeyondMimic" (arXiv 2508.08241, adaptive sampling). A clip is cut into bins. Each bin has an estimate
//! of the probability that an episode that reaches it fails in it. A start in a bin counts by the failures of that bin and
//! of the next ones, because a failure begins before the body falls. Every environment has a table of its own, so the starts
//! depend on its own episodes alone: in lockstep the same seed gives the same starts, whatever actors there are.

use std::ops::Range;

use comic_clips::Entry;
use rand::Rng;

use super::starts::Starts;
use crate::environment::ClipStarts;

/// Length of a bin, s.
const BIN_SECONDS: f64 = 0.5;
/// The estimate of a bin that no episode has reached. It is higher than most measured ones, so all bins are tried.
const UNKNOWN: f32 = 0.5;
/// How far an episode that passes a bin, or fails in it, moves the bin's estimate.
const RATE: f32 = 0.125;
/// What the estimates of a bin, of the next one and of the one after that count for a start. A clip's last bins have fewer
/// bins ahead: the estimates are averaged with these weights.
const AHEAD: [f32; 3] = [1.0, 0.8, 0.64];

/// The failures of one environment.
#[derive(Clone, Debug)]
pub(super) struct Failures {
    /// The share of starts that are drawn by failures. The others are drawn as without failures.
    share: f64,
    bins: Vec<Bin>,
    /// For each clip its bins, in the order of their frames.
    clips: Vec<Range<usize>>,
}

#[derive(Clone, Debug)]
struct Bin {
    clip: usize,
    /// Frames of the clip. An episode may start in all of them except the clip's last ones.
    frames: Range<usize>,
    starts: Range<usize>,
    /// The clip's weight × the number of starts.
    mass: f32,
    /// Estimated probability of a failure in this bin.
    failure: f32,
}

impl Failures {
    /// No failures yet. `share` is 0 to 1; `dt` is the time between two frames, s.
    pub(super) fn new(share: f64, dt: f64, entries: &[Entry], starts: &[ClipStarts]) -> Self {
        let width = ((BIN_SECONDS / dt).round() as usize).max(1);
        let (mut bins, mut clips) = (Vec::new(), Vec::with_capacity(starts.len()));
        for (entry, ClipStarts { clip, frames, .. }) in entries.iter().zip(starts) {
            let first = bins.len();
            let end = entry.frames().end.max(frames.end);
            bins.extend((frames.start..end).step_by(width).map(|from| {
                let starts = from..(from + width).min(frames.end).max(from);
                let mass = (entry.weight * starts.len() as f64) as f32;
                Bin { clip: *clip, frames: from..(from + width).min(end), starts, mass, failure: UNKNOWN }
            }));
            clips.push(first..bins.len());
        }
        Self { share, bins, clips }
    }

    /// An episode went through `frames` of a clip. If it failed, it failed in the last of them.
    pub(super) fn record(&mut self, clip: usize, frames: Range<usize>, failed: bool) {
        let bins = self.clips.get(clip).cloned().and_then(|bins| self.bins.get_mut(bins)).unwrap_or_default();
        for bin in bins {
            let passed = frames.start.max(bin.frames.start)..frames.end.min(bin.frames.end);
            if passed.is_empty() {
                continue;
            }
            if failed && frames.end <= bin.frames.end {
                bin.failure += RATE * (1.0 - bin.failure);
            } else {
                bin.failure -= RATE * bin.failure * passed.len() as f32 / bin.frames.len() as f32;
            }
        }
    }

    /// Draws a clip and one of its start frames.
    pub(super) fn draw(&self, starts: &Starts, random: &mut impl Rng) -> (usize, usize) {
        if random.random::<f64>() >= self.share {
            return starts.draw(random);
        }
        let total: f64 = self.weights().map(f64::from).sum();
        let mut left = random.random::<f64>() * total;
        let drawn = self.bins.iter().zip(self.weights()).find(|(_, weight)| {
            left -= f64::from(*weight);
            left < 0.0
        });
        match drawn {
            Some((bin, _)) if !bin.starts.is_empty() => (bin.clip, random.random_range(bin.starts.clone())),
            // No failure anywhere, or a point at the end by rounding.
            _ => starts.draw(random),
        }
    }

    /// For each bin, in order: its weight among the starts that are drawn by failures.
    fn weights(&self) -> impl Iterator<Item = f32> {
        self.clips.iter().filter_map(|bins| self.bins.get(bins.clone())).flat_map(|bins| {
            bins.iter().enumerate().map(move |(index, bin)| {
                let ahead = bins.iter().skip(index).zip(AHEAD);
                let (sum, counts) =
                    ahead.fold((0.0, 0.0), |(sum, all), (bin, counts)| (sum + counts * bin.failure, all + counts));
                bin.mass * sum / counts
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use comic_clips::WalkerModel;
    use proptest::prelude::*;
    use rand::SeedableRng as _;
    use rand_pcg::Pcg64;

    use super::*;

    const DT: f64 = 0.03;
    /// 0.5 s.
    const WIDTH: usize = 17;

    fn entry(start_step: usize, end_step: usize, weight: f64) -> Entry {
        let (steps, model) = (200, WalkerModel::Cmu2020);
        Entry { name: "clip".into(), steps, dt: DT, model, start_step, end_step: Some(end_step), weight }
    }

    fn tables(share: f64, entries: &[Entry]) -> (Starts, Failures) {
        let starts = Starts::new(entries, 5, 10, false).unwrap();
        let failures = Failures::new(share, DT, entries, starts.clips());
        (starts, failures)
    }

    /// Of `draws` draws, the share in each clip, and those with a start in `within` of clip 0.
    fn shares(starts: &Starts, failures: &Failures, draws: usize, within: Range<usize>) -> (Vec<f64>, f64) {
        let mut random = Pcg64::seed_from_u64(5);
        let mut clips = vec![0.0; starts.clips().len()];
        let mut inside = 0.0;
        for _ in 0..draws {
            let (clip, start) = failures.draw(starts, &mut random);
            assert!(starts.clips()[clip].frames.contains(&start), "clip {clip} has no start at {start}");
            clips[clip] += 1.0 / draws as f64;
            inside += f64::from(u8::from(clip == 0 && within.contains(&start))) / draws as f64;
        }
        (clips, inside)
    }

    #[test]
    fn before_any_episode_every_start_counts_as_without_failures() {
        let entries = [entry(0, 200, 1.0), entry(20, 120, 2.0)];
        let (starts, failures) = tables(1.0, &entries);
        let (clips, _) = shares(&starts, &failures, 100_000, 0..1);
        for (share, clip) in clips.iter().zip(starts.clips()) {
            assert!((share - clip.probability).abs() < 0.01, "{share}, {clip:?}");
        }
    }

    #[test]
    fn starts_move_to_where_episodes_fail_and_shortly_before() {
        let entries = [entry(0, 200, 1.0), entry(0, 200, 1.0)];
        let (starts, mut failures) = tables(0.5, &entries);
        for _ in 0..100 {
            failures.record(0, 0..100, true);
            failures.record(0, 100..200, false);
            failures.record(1, 0..200, false);
        }
        // Frame 99 is in the bin 85..102. Starts in it and in the two bins before it count.
        let (clips, inside) = shares(&starts, &failures, 20_000, 51..102);
        let uniform = 0.5 * 51.0 / 185.0 * 0.5;
        assert!((inside - (0.5 + uniform)).abs() < 0.02, "{inside}");
        // The floor: half of the starts are drawn as without failures.
        assert!((clips[1] - 0.25).abs() < 0.02, "{clips:?}");
    }

    #[test]
    fn a_failure_at_a_clips_begin_says_nothing_of_the_clip_before_it() {
        let entries = [entry(0, 200, 1.0), entry(0, 200, 1.0)];
        let (starts, mut failures) = tables(1.0, &entries);
        for _ in 0..200 {
            failures.record(0, 0..200, false);
            failures.record(1, 0..5, true);
            failures.record(1, 5..200, false);
        }
        let (clips, _) = shares(&starts, &failures, 10_000, 0..1);
        assert!(clips[0] < 0.01, "{clips:?}");
    }

    #[test]
    fn a_part_of_a_bin_counts_for_as_much_as_was_passed_of_it() {
        let (_, mut failures) = tables(1.0, &[entry(0, 200, 1.0)]);
        failures.record(0, 0..WIDTH, false);
        failures.record(0, WIDTH..WIDTH + 1, false);
        let passed = |bin: usize| UNKNOWN - failures.bins[bin].failure;
        assert!((passed(0) / passed(1) - WIDTH as f32).abs() < 1e-3);
    }

    #[test]
    fn when_no_episode_fails_any_more_all_starts_are_drawn_as_without_failures() {
        let (starts, mut failures) = tables(1.0, &[entry(0, 200, 1.0), entry(0, 200, 3.0)]);
        for bin in &mut failures.bins {
            bin.failure = 0.0;
        }
        let (clips, _) = shares(&starts, &failures, 20_000, 0..1);
        assert!((clips[1] - 0.75).abs() < 0.02, "{clips:?}");
    }

    proptest! {
        #[test]
        fn every_draw_is_a_start_and_every_estimate_a_probability(
            ends in prop::collection::vec((0usize..60, 80usize..200, 0.0f64..2.0), 1..6),
            episodes in prop::collection::vec((0usize..7, 0usize..220, 0usize..220, any::<bool>()), 0..60),
            seed in any::<u64>(),
        ) {
            let mut entries: Vec<Entry> = ends.iter().map(|(start, end, weight)| entry(*start, *end, *weight)).collect();
            entries.push(entry(0, 200, 1.0));
            let (starts, mut failures) = tables(0.9, &entries);
            for (clip, start, end, failed) in episodes {
                failures.record(clip, start..end, failed);
            }
            prop_assert!(failures.bins.iter().all(|bin| (0.0..=1.0).contains(&bin.failure)));
            let covered: usize = failures.bins.iter().map(|bin| bin.starts.len()).sum();
            prop_assert_eq!(covered, starts.clips().iter().map(|clip| clip.frames.len()).sum::<usize>());
            let mut random = Pcg64::seed_from_u64(seed);
            for _ in 0..50 {
                let (clip, start) = failures.draw(&starts, &mut random);
                prop_assert!(starts.clips()[clip].frames.contains(&start));
                prop_assert!(entries[clip].weight > 0.0);
            }
        }
    }
}
