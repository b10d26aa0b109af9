//! The corridor with walls, each across a part of its width.

use std::sync::Arc;

use comic_experiment::{WallSide, Walls};
use rand::Rng as _;
use rand_pcg::Pcg64;

use super::corridor::{CorridorRules, Obstacles};
use super::environment::RuledTask;
use super::poses::Poses;
use super::stage::Arena;
use crate::arenas::corridor::{self, Block, Extent, X_PADDING};
use crate::build_task::{BuildTask, Context};
use crate::environment::Task;
use crate::error::Error;
use crate::humanoid;

impl BuildTask for Walls {
    fn build(&self, context: &Context<'_>) -> Result<Arc<dyn Task>, Error> {
        let poses = Poses::new(self.corridor.start_pose, context.catalogue)?;
        Ok(Arc::new(RuledTask::new(CorridorRules::new(&self.corridor, poses, self.clone()), context.spec()?)))
    }
}

impl Obstacles for Walls {
    fn draw(&self, extent: Extent, random: &mut Pcg64) -> Result<Arena, Error> {
        let walls = walls(self, extent, random);
        let model = humanoid::build_in(corridor::with_walls(extent, &walls)?)?;
        Ok(Arena::new(model)?.with_obstacles(corridor::wall_ends(&walls)))
    }
}

/// `WallsCorridor.regenerate`: a wall every `spacing` metres. The first one is `spacing` after the corridor's start,
/// which is 2 m before the origin.
fn walls(config: &Walls, extent: Extent, random: &mut Pcg64) -> Vec<Block> {
    let mut x = config.spacing - X_PADDING;
    if config.initial_padding {
        x += 2.0 * X_PADDING;
    }
    let mut left = false;
    let mut walls = Vec::new();
    while x < extent.length {
        let mut draw = |[low, high]: [f64; 2]| random.random_range(low..=high);
        let size = [draw(config.wall_width), draw(config.wall_height)];
        let mut channel = || random.random_range(0.0..1.0_f32);
        let colour = if config.random_colours { [channel(), channel(), channel(), 1.0] } else { [1.0; 4] };
        // dm_control changes the side before it places a wall.
        left = match config.side {
            WallSide::Alternate => !left,
            WallSide::Random => random.random(),
        };
        walls.push(Block { colour, ..corridor::wall(walls.len(), x, size, left, extent) });
        x += config.spacing;
    }
    walls
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;

    use super::*;

    const EXTENT: Extent = Extent { length: 100.0, width: 10.0 };

    #[test]
    fn there_are_twenty_walls_five_metres_apart_from_the_third_metre_on() {
        let mut random = Pcg64::seed_from_u64(1);
        let places = |config: &Walls, random: &mut Pcg64| {
            walls(config, EXTENT, random).iter().map(|wall| wall.position[0]).collect::<Vec<_>>()
        };
        let found = places(&Walls::default(), &mut random);
        assert_eq!(found, (0..20).map(|wall| 3.0 + 5.0 * f64::from(wall)).collect::<Vec<_>>());
        let padded = Walls { initial_padding: true, ..Walls::default() };
        assert_eq!(places(&padded, &mut random), (0..19).map(|wall| 7.0 + 5.0 * f64::from(wall)).collect::<Vec<_>>());
    }

    #[test]
    fn widths_and_heights_are_uniform_and_both_sides_equally_likely() {
        let (config, mut random) = (Walls::default(), Pcg64::seed_from_u64(2));
        let all: Vec<Block> = (0..200).flat_map(|_| walls(&config, EXTENT, &mut random)).collect();
        let count = all.len() as f64;
        let mean = |value: fn(&Block) -> f64| all.iter().map(value).sum::<f64>() / count;
        // A mean of n uniform draws strays by more than 4 standard errors once in 16,000 times.
        let near = |found: f64, [low, high]: [f64; 2]| {
            (found - (low + high) / 2.0).abs() < 4.0 * (high - low) / (12.0 * count).sqrt()
        };
        let (width, height) = (|wall: &Block| 2.0 * wall.half_size[1], |wall: &Block| 2.0 * wall.half_size[2]);
        assert!(near(mean(width), config.wall_width));
        assert!(near(mean(height), config.wall_height));
        // A coin's standard deviation is 1/2, that of this range too.
        assert!(near(mean(|wall| f64::from(u8::from(wall.position[1] > 0.0))), [-0.366, 1.366]));
        let within = |value: f64, [low, high]: [f64; 2]| (low - 1e-9..=high + 1e-9).contains(&value);
        assert!(all.iter().all(|wall| within(width(wall), [1.0, 7.0]) && within(height(wall), [2.5, 4.0])));
        assert!(all.iter().all(|wall| wall.colour.iter().all(|channel| (0.0..=1.0).contains(channel))));
        // Every wall stands against its side.
        let reach = |wall: &Block| wall.position[1].abs() + wall.half_size[1];
        assert!(all.iter().all(|wall| (reach(wall) - 5.0).abs() < 1e-9));
    }

    #[test]
    fn dm_controls_default_has_white_walls_on_alternating_sides_from_the_left() {
        let config = Walls { side: WallSide::Alternate, random_colours: false, ..Walls::default() };
        let all = walls(&config, EXTENT, &mut Pcg64::seed_from_u64(3));
        assert!(all.iter().enumerate().all(|(index, wall)| (wall.position[1] > 0.0) == (index % 2 == 0)));
        assert!(all.iter().all(|wall| wall.colour == [1.0; 4]));
    }
}
