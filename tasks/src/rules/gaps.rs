//! The corridor with gaps: platforms of random length, and random gaps between them.

use std::sync::Arc;

use comic_experiment::Gaps;
use rand::Rng as _;
use rand_pcg::Pcg64;

use super::corridor::{CorridorRules, Obstacles};
use super::environment::RuledTask;
use super::poses::Poses;
use super::stage::Arena;
use crate::arenas::corridor::{self, Block, Extent};
use crate::build_task::{BuildTask, Context};
use crate::environment::Task;
use crate::error::Error;
use crate::humanoid;

impl BuildTask for Gaps {
    fn build(&self, context: &Context<'_>) -> Result<Arc<dyn Task>, Error> {
        let poses = Poses::new(self.corridor.start_pose, context.catalogue)?;
        Ok(Arc::new(RuledTask::new(CorridorRules::new(&self.corridor, poses, self.clone()), context.spec()?)))
    }
}

impl Obstacles for Gaps {
    fn draw(&self, extent: Extent, random: &mut Pcg64) -> Result<Arena, Error> {
        let platforms = platforms(self, extent, random);
        let most = most_platforms(self, extent);
        let spare = most.saturating_sub(platforms.len());
        let model = humanoid::build_in(corridor::with_gaps(extent, &platforms, spare)?)?;
        Ok(Arena::new(model)?.with_obstacles(corridor::gap_ends(&platforms)))
    }
}

/// `GapsCorridor.regenerate`: platforms and gaps to the corridor's end. There is no gap between the first platform,
/// where the humanoid starts, and the second.
fn platforms(config: &Gaps, extent: Extent, random: &mut Pcg64) -> Vec<Block> {
    let mut draw = |[low, high]: [f64; 2]| random.random_range(low..=high);
    let mut platforms = vec![corridor::first_platform(extent)];
    let mut start = corridor::first_platform_length();
    while start < extent.length {
        let length = draw(config.platform);
        platforms.push(corridor::platform(platforms.len() - 1, start, length, extent));
        start += length + draw(config.gap);
    }
    platforms
}

/// A number of boxes that is enough for nearly every arena: the mean and six standard deviations. A rare arena needs more
/// and has another memory layout, which only costs time.
fn most_platforms(config: &Gaps, extent: Extent) -> usize {
    let ([a, b], [c, d]) = (config.platform, config.gap);
    let step = (a + b + c + d) / 2.0;
    let deviation = (((b - a).powi(2) + (d - c).powi(2)) / 12.0).sqrt();
    let mean = ((extent.length - corridor::first_platform_length()) / step).max(0.0);
    (mean + 6.0 * deviation / step * mean.sqrt()).ceil() as usize + 3
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;

    use super::*;

    const EXTENT: Extent = Extent { length: 100.0, width: 10.0 };

    /// Largest distance between the values' distribution and the uniform one over `range` (Kolmogorov-Smirnov).
    fn distance_to_uniform(mut values: Vec<f64>, [low, high]: [f64; 2]) -> f64 {
        values.sort_by(f64::total_cmp);
        let count = values.len() as f64;
        let gap = |(index, value): (usize, &f64)| {
            let expected = (value - low) / (high - low);
            (expected - index as f64 / count).abs().max((expected - (index + 1) as f64 / count).abs())
        };
        values.iter().enumerate().map(gap).fold(0.0, f64::max)
    }

    #[test]
    fn platforms_and_gaps_are_uniform_and_fill_the_corridor() {
        let (config, mut random) = (Gaps::default(), Pcg64::seed_from_u64(1));
        let (mut lengths, mut gaps, mut counts) = (Vec::new(), Vec::new(), Vec::new());
        let start = |block: &Block| block.position[0] - block.half_size[0];
        let end = |block: &Block| block.position[0] + block.half_size[0];
        for _ in 0..200 {
            let platforms = platforms(&config, EXTENT, &mut random);
            assert_eq!((start(&platforms[0]), end(&platforms[0])), (0.0, 6.0));
            assert!((start(&platforms[1]) - 6.0).abs() < 1e-9, "no gap after the first platform");
            let last = platforms.last().map(start).unwrap_or_default();
            assert!((100.0 - 3.75..100.0).contains(&last), "{last}");
            gaps.extend(platforms[1..].windows(2).map(|pair| start(&pair[1]) - end(&pair[0])));
            lengths.extend(platforms[1..].iter().map(|block| 2.0 * block.half_size[0]));
            counts.push(platforms.len());
        }
        // Some 7,900 draws: beyond 1.95 / sqrt(n) the hypothesis fails at 0.1 %.
        let limit = 1.95 / (lengths.len() as f64).sqrt();
        assert!(distance_to_uniform(lengths, config.platform) < limit);
        assert!(distance_to_uniform(gaps, config.gap) < limit);
        // dm_control: 36 to 46 boxes with the first, 41 on average over 200 arenas.
        let mean = counts.iter().sum::<usize>() as f64 / counts.len() as f64;
        assert!((40.0..42.0).contains(&mean), "{mean}");
        assert!(counts.iter().all(|count| *count <= most_platforms(&config, EXTENT)));
    }

    #[test]
    fn a_gap_ends_where_the_next_platform_begins_and_platforms_that_meet_have_none() {
        let platform = |start, length| corridor::platform(0, start, length, EXTENT);
        let platforms = [corridor::first_platform(EXTENT), platform(6.0, 1.0), platform(8.0, 0.5), platform(9.25, 1.0)];
        let ends = corridor::gap_ends(&platforms);
        assert!(ends.len() == 2 && (ends[0] - 8.0).abs() < 1e-9 && (ends[1] - 9.25).abs() < 1e-9, "{ends:?}");
    }

    #[test]
    fn a_corridor_of_the_smallest_platforms_and_gaps_has_an_end() {
        let config = Gaps { platform: [0.3, 0.3], gap: [0.75, 0.75], ..Gaps::default() };
        assert_eq!(platforms(&config, EXTENT, &mut Pcg64::seed_from_u64(1)).len(), 91);
    }
}
