//! Compares the camera image with dm_control's. The tests need OpenGL: their names begin with `opengl_`, and
//! `cargo xtask test` leaves them out where there is none.

use comic_tasks::comparison::{Replay, replay_corridor};
use comic_tasks::vision::IMAGE_BYTES;

use crate::npz;
use crate::recording::models;
use crate::rules::RecordedArena;

/// The corridor that was recorded, in the pose in which dm_control took its picture.
fn replay(kind: &str) -> Replay {
    let RecordedArena { length, width, platforms, walls } =
        RecordedArena::read(&models().join(format!("{kind}_arena.json"))).unwrap();
    replay_corridor(length, width, &platforms, &walls).unwrap()
}

fn drawn(replay: &mut Replay, full: bool) -> Vec<u8> {
    let mut image = vec![0; IMAGE_BYTES];
    replay.draw(full, &mut image).unwrap_or_else(|error| panic!("{error}"));
    image
}

/// Mean and largest difference in grey levels.
fn difference(one: &[u8], other: &[f64]) -> (f64, f64) {
    let differences: Vec<f64> = one.iter().zip(other).map(|(a, b)| (f64::from(*a) - b).abs()).collect();
    let mean = differences.iter().sum::<f64>() / differences.len() as f64;
    (mean, differences.into_iter().fold(0.0, f64::max))
}

#[test]
fn opengl_parity_of_images_with_dm_control_within_a_few_grey_levels() {
    for kind in ["gaps", "walls"] {
        let recorded = npz::read(&models().join(format!("{kind}_camera.npz"))).unwrap();
        let image = drawn(&mut replay(kind), true);
        let (mean, largest) = difference(&image, recorded["rgb"].numbers().unwrap());
        eprintln!("{kind}: {mean:.3} grey levels on average, {largest} at most");
        assert!(mean < 1.0 && largest <= 8.0, "{kind}: {mean:.3} on average, {largest} at most");
    }
}

#[test]
fn opengl_the_fast_image_is_the_full_image_without_shadows() {
    for kind in ["gaps", "walls"] {
        let mut replay = replay(kind);
        let (fast, full) = (drawn(&mut replay, false), drawn(&mut replay, true));
        let full: Vec<f64> = full.into_iter().map(f64::from).collect();
        let (mean, _) = difference(&fast, &full);
        assert!(mean < 25.0, "{kind}: {mean}");
        let (first, rest) = fast.split_at(3);
        assert!(rest.chunks(3).any(|pixel| pixel != first), "{kind}: one colour everywhere");
    }
}
