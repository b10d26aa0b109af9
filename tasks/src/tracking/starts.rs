//! The start frames of the clips (`tracking.py`: `_get_possible_starts`, `_get_clip_to_track`).

use comic_clips::Entry;
use rand::Rng;

use crate::environment::ClipStarts;

/// All start frames. Each has the weight of its clip.
#[derive(Debug)]
pub(super) struct Starts {
    clips: Vec<ClipStarts>,
    /// Sums of probabilities up to and including each clip.
    cumulative: Vec<f64>,
}

impl Starts {
    /// `None` when no frame has a weight above 0.
    pub(super) fn new(
        entries: &[Entry],
        look_ahead: usize,
        min_steps: usize,
        always_at_clip_start: bool,
    ) -> Option<Self> {
        let frames = |entry: &Entry| {
            if always_at_clip_start {
                entry.start_step..entry.start_step + 1
            } else {
                entry.starts(look_ahead, min_steps)
            }
        };
        let mass = |entry: &Entry| entry.weight * frames(entry).len() as f64;
        let total: f64 = entries.iter().map(mass).sum();
        if !(total > 0.0 && total.is_finite()) {
            return None;
        }
        let clips: Vec<ClipStarts> = entries
            .iter()
            .enumerate()
            .map(|(clip, entry)| ClipStarts { clip, frames: frames(entry), probability: mass(entry) / total })
            .collect();
        let mut sum = 0.0;
        let cumulative = clips
            .iter()
            .map(|clip| {
                sum += clip.probability;
                sum
            })
            .collect();
        Some(Self { clips, cumulative })
    }

    pub(super) fn clips(&self) -> &[ClipStarts] {
        &self.clips
    }

    /// Draws a clip and one of its start frames.
    pub(super) fn draw(&self, random: &mut impl Rng) -> (usize, usize) {
        let total = self.cumulative.last().copied().unwrap_or(1.0);
        let point = random.random::<f64>() * total;
        let index = self.cumulative.partition_point(|sum| *sum <= point);
        // By rounding the point can be at the end. Then the last clip with a weight is drawn.
        let clip = self.clips.get(index).or_else(|| self.clips.iter().rev().find(|clip| clip.probability > 0.0));
        match clip {
            Some(clip) if !clip.frames.is_empty() => (clip.clip, random.random_range(clip.frames.clone())),
            _ => (0, 0),
        }
    }
}

#[cfg(test)]
mod tests {
    use comic_clips::WalkerModel;
    use rand::SeedableRng;
    use rand_pcg::Pcg64;

    use super::*;

    fn entry(start_step: usize, end_step: usize, weight: f64) -> Entry {
        let name = format!("{start_step}..{end_step}");
        let (steps, dt, model) = (120, 0.03, WalkerModel::Cmu2020);
        Entry { name, made_from: None, steps, dt, model, start_step, end_step: Some(end_step), weight }
    }

    fn four_clips() -> Vec<Entry> {
        vec![entry(0, 120, 1.0), entry(10, 110, 2.0), entry(0, 60, 0.5), entry(5, 120, 0.0)]
    }

    #[test]
    fn every_start_frame_has_its_clips_weight() {
        // The same sub-ranges and weights as in dm_control's draws in the parity data.
        let starts = Starts::new(&four_clips(), 5, 10, false).unwrap();
        let frames: Vec<_> = starts.clips().iter().map(|clip| clip.frames.clone()).collect();
        assert_eq!(frames, [0..105, 10..95, 0..45, 5..105]);
        let expected = [0.3529411764705875, 0.5714285714285704, 0.07563025210084032, 0.0];
        for (clip, expected) in starts.clips().iter().zip(expected) {
            assert!((clip.probability - expected).abs() < 1e-12, "{clip:?}");
        }
    }

    #[test]
    fn the_starts_are_dm_controls() {
        let fixtures = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures/golden");
        let text = std::fs::read_to_string(fixtures.join("start_sampling.json")).unwrap();
        let golden: serde_json::Value = serde_json::from_str(&text).unwrap();
        let starts = Starts::new(&four_clips(), 5, 10, false).unwrap();
        for (index, clip) in starts.clips().iter().enumerate() {
            assert_eq!(golden["starts_per_clip"][index], clip.frames.len());
            assert_eq!(golden["first_last_per_clip"][index][0], clip.frames.start);
            assert_eq!(golden["first_last_per_clip"][index][1], clip.frames.end - 1);
            assert!((golden["p_per_clip"][index].as_f64().unwrap() - clip.probability).abs() < 1e-12);
        }
        for draw in golden["draws"].as_array().unwrap() {
            let number = |index: usize| draw[index].as_u64().unwrap() as usize;
            let entry = &four_clips()[number(0)];
            assert!(starts.clips()[number(0)].frames.contains(&(entry.start_step + number(1))));
            assert_eq!(entry.frames().len(), number(3));
            assert_eq!(entry.frames().len() - 6, number(2));
        }
    }

    #[test]
    fn draws_have_the_probabilities_of_their_clips() {
        let starts = Starts::new(&four_clips(), 5, 10, false).unwrap();
        let mut random = Pcg64::seed_from_u64(7);
        let draws = 200_000;
        let mut counts = [0usize; 4];
        let mut first_half = [0usize; 4];
        for _ in 0..draws {
            let (clip, frame) = starts.draw(&mut random);
            let frames = &starts.clips()[clip].frames;
            assert!(frames.contains(&frame));
            counts[clip] += 1;
            first_half[clip] += usize::from(2 * (frame - frames.start) < frames.len());
        }
        for (clip, count) in starts.clips().iter().zip(counts) {
            // Five standard deviations of a binomial count.
            let slack = 5.0 * (draws as f64 * clip.probability * (1.0 - clip.probability)).sqrt();
            assert!((count as f64 - draws as f64 * clip.probability).abs() <= slack, "{clip:?}: {count}");
        }
        assert!((first_half[0] as f64 / counts[0] as f64 - 53.0 / 105.0).abs() < 0.01);
    }

    #[test]
    fn with_starts_at_first_frames_only_the_weight_counts() {
        let starts = Starts::new(&four_clips(), 5, 10, true).unwrap();
        let frames: Vec<_> = starts.clips().iter().map(|clip| clip.frames.clone()).collect();
        assert_eq!(frames, [0..1, 10..11, 0..1, 5..6]);
        assert!((starts.clips()[1].probability - 2.0 / 3.5).abs() < 1e-12);
    }

    #[test]
    fn without_weight_there_are_no_starts() {
        assert!(Starts::new(&[entry(0, 120, 0.0)], 5, 10, false).is_none());
        assert!(Starts::new(&[], 5, 10, false).is_none());
    }
}
