//! Starts of training where the policy fails: each environment remembers where its own episodes failed, and starts more
//! often shortly before such places.
//!
//! The idea is from "BeyondMimic" (arXiv 2508.08241, adaptive sampling). A clip is cut into bins. Each bin has an estimate of
//! the failures per passage through it. A start in a bin counts by the failures of that bin and of the next ones, because a
//! failure begins before the body falls. Every environment has a table of its own, so the starts depend on its own episodes
//! alone: in lockstep the same seed gives the same starts, whatever actors there are.

use std::ops::Range;
use std::sync::Arc;

use comic_clips::Entry;
use rand::Rng;

use super::starts::Starts;
use crate::environment::ClipStarts;

/// Length of a bin, s.
const BIN_SECONDS: f64 = 0.5;
/// The estimate of a bin that no episode has reached. It is higher than most measured ones, so all bins are tried.
const UNKNOWN: f32 = 0.5;
/// How far one passage moves the estimate.
const RATE: f32 = 0.125;
/// What the estimates of a bin, of the next one and of the one after that count for a start. A clip's last bins have fewer
/// bins ahead: the estimates are averaged with these weights.
const AHEAD: [f32; 3] = [1.0, 0.8, 0.64];

/// The failures of one environment.
#[derive(Clone, Debug)]
pub(super) struct Failures {
    bins: Arc<Bins>,
    /// Of each bin: estimated failures per passage, 0 to 1.
    estimates: Vec<f32>,
}

/// What all environments share.
#[derive(Debug)]
struct Bins {
    /// The share of starts that are drawn by failures. The others are drawn as without failures.
    share: f64,
    bins: Vec<Bin>,
    /// For each clip its bins, in the order of their frames.
    clips: Vec<Range<usize>>,
}

#[derive(Debug)]
struct Bin {
    clip: usize,
    /// Frames of the clip. An episode may start in all of them except the clip's last ones.
    frames: Range<usize>,
    starts: Range<usize>,
    /// Probability of a start in this bin without failures.
    probability: f64,
}

impl Failures {
    /// No failures yet. `share` is 0 to 1; `dt` is the time between two frames, s. No episode reaches a clip's last `look_ahead`
    /// frames.
    pub(super) fn new(share: f64, dt: f64, look_ahead: usize, entries: &[Entry], starts: &[ClipStarts]) -> Self {
        let width = ((BIN_SECONDS / dt).round() as usize).max(1);
        let (mut bins, mut clips) = (Vec::new(), Vec::with_capacity(starts.len()));
        for (entry, ClipStarts { clip, frames, probability }) in entries.iter().zip(starts) {
            let first = bins.len();
            let end = entry.frames().end.saturating_sub(look_ahead).max(frames.end);
            bins.extend((frames.start..end).step_by(width).map(|from| {
                let starts = from..(from + width).min(frames.end).max(from);
                let probability = probability * starts.len() as f64 / frames.len().max(1) as f64;
                Bin { clip: *clip, frames: from..(from + width).min(end), starts, probability }
            }));
            clips.push(first..bins.len());
        }
        let estimates = vec![UNKNOWN; bins.len()];
        Self { bins: Arc::new(Bins { share, bins, clips }), estimates }
    }

    /// An episode went through `frames` of a clip. If it failed, it failed in the last of them.
    ///
    /// Each passage moves an estimate p by RATE × (failures − p × the share of the bin that was passed). So p tends to the number
    /// of failures divided by that of passages, also where episodes start within the bin.
    pub(super) fn record(&mut self, clip: usize, frames: Range<usize>, failed: bool) {
        let places = self.bins.clips.get(clip).cloned().unwrap_or_default();
        for (bin, estimate) in self.bins.bins.iter().zip(&mut self.estimates).take(places.end).skip(places.start) {
            let passed = frames.start.max(bin.frames.start)..frames.end.min(bin.frames.end);
            if passed.is_empty() {
                continue;
            }
            let failures = if failed && frames.end <= bin.frames.end { 1.0 } else { 0.0 };
            let share = passed.len() as f32 / bin.frames.len() as f32;
            *estimate = (*estimate + RATE * (failures - *estimate * share)).min(1.0);
        }
    }

    /// Draws a clip and one of its start frames.
    pub(super) fn draw(&self, starts: &Starts, random: &mut impl Rng) -> (usize, usize) {
        if random.random::<f64>() >= self.bins.share {
            return starts.draw(random);
        }
        let total: f64 = self.weights().map(|(_, weight)| weight).sum();
        let mut left = random.random::<f64>() * total;
        let drawn = self.weights().find(|(_, weight)| {
            left -= weight;
            left < 0.0
        });
        match drawn {
            Some((bin, _)) if !bin.starts.is_empty() => (bin.clip, random.random_range(bin.starts.clone())),
            // No failure anywhere, or a point at the end by rounding.
            _ => starts.draw(random),
        }
    }

    /// The bins, each with its weight among the starts that are drawn by failures.
    fn weights(&self) -> impl Iterator<Item = (&Bin, f64)> {
        let Bins { bins, clips, .. } = self.bins.as_ref();
        clips.iter().flat_map(move |places| {
            let estimates = self.estimates.get(places.clone()).unwrap_or_default();
            bins.iter().skip(places.start).zip(0..estimates.len()).map(move |(bin, index)| {
                let ahead = estimates.iter().skip(index).zip(AHEAD);
                let (sum, counts) =
                    ahead.fold((0.0, 0.0), |(sum, all), (estimate, counts)| (sum + counts * estimate, all + counts));
                (bin, bin.probability * f64::from(sum / counts))
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
    /// Of the paper's reference steps.
    const LOOK_AHEAD: usize = 5;
    /// 0.5 s.
    const WIDTH: usize = 17;

    fn entry(start_step: usize, end_step: usize, weight: f64) -> Entry {
        let (steps, model) = (200, WalkerModel::Cmu2020);
        let (name, end_step) = ("clip".into(), Some(end_step));
        Entry { name, made_from: None, steps, dt: DT, model, start_step, end_step, weight }
    }

    fn tables(share: f64, entries: &[Entry]) -> (Starts, Failures) {
        let starts = Starts::new(entries, LOOK_AHEAD, 10, false).unwrap();
        let failures = Failures::new(share, DT, LOOK_AHEAD, entries, starts.clips());
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
            failures.record(0, 100..195, false);
            failures.record(1, 0..195, false);
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
            failures.record(0, 0..195, false);
            failures.record(1, 0..5, true);
            failures.record(1, 5..195, false);
        }
        let (clips, _) = shares(&starts, &failures, 10_000, 0..1);
        assert!(clips[0] < 0.01, "{clips:?}");
    }

    #[test]
    fn an_estimate_tends_to_the_failures_per_passage_wherever_episodes_start() {
        let (_, mut failures) = tables(1.0, &[entry(0, 200, 1.0)]);
        // Of five episodes one fails in the first bin, and each of the others passes half of it, on average.
        let mut sum = 0.0;
        for round in 0..4000 {
            let start = if round % 2 == 0 { 4 } else { 13 };
            let end = if round % 5 == 0 { start + 1 } else { WIDTH };
            failures.record(0, start..end, round % 5 == 0);
            sum += failures.estimates[0] / 4000.0;
        }
        let passages = 0.2 / WIDTH as f32 + 0.8 * 0.5 * (13.0 + 4.0) / WIDTH as f32;
        assert!((sum - 0.2 / passages).abs() < 0.05, "{sum}, {}", 0.2 / passages);
    }

    #[test]
    fn when_no_episode_fails_any_more_all_starts_are_drawn_as_without_failures() {
        // Every length has another last bin. 87 frames are those of a real walk.
        for length in [80, 85, 86, 87, 88, 89, 90, 200] {
            let (starts, mut failures) = tables(1.0, &[entry(0, length, 1.0), entry(0, 200, 3.0)]);
            for _ in 0..2000 {
                failures.record(0, 0..(length + 1).min(200) - LOOK_AHEAD, false);
                failures.record(1, 0..195, false);
            }
            assert!(failures.estimates.iter().all(|estimate| *estimate < 1e-3), "{length}: {:?}", failures.estimates);
            let (clips, inside) = shares(&starts, &failures, 20_000, 0..30);
            assert!((clips[1] - starts.clips()[1].probability).abs() < 0.02, "{length}: {clips:?}");
            let uniform = starts.clips()[0].probability * 30.0 / starts.clips()[0].frames.len() as f64;
            assert!((inside - uniform).abs() < 0.02, "{length}: {inside}, {uniform}");
        }
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
            prop_assert!(failures.estimates.iter().all(|estimate| (0.0..=1.0).contains(estimate)));
            let covered: usize = failures.bins.bins.iter().map(|bin| bin.starts.len()).sum();
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
