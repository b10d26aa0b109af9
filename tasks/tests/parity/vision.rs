//! What the humanoid sees, against dm_control's own pictures. Without OpenGL there is nothing to compare, and the tests
//! say so.

use std::path::{Path, PathBuf};

use comic_tasks::Error;
use comic_tasks::comparison::{Replay, replay_corridor};
use comic_tasks::vision::IMAGE_BYTES;

use crate::npz;
use crate::recording::workspace;
use crate::rules::RecordedArena;

/// The corridor that was recorded, in the pose in which dm_control took its picture.
fn replay(folder: &Path, kind: &str) -> Replay {
    let RecordedArena { length, width, platforms, walls } =
        RecordedArena::read(&folder.join(format!("{kind}_arena.json"))).unwrap();
    replay_corridor(length, width, &platforms, &walls).unwrap()
}

fn golden() -> Option<PathBuf> {
    let folder = workspace().join("../shared/golden");
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("skipped: {} is not there", folder.display());
    None
}

/// The picture, or nothing where there is no OpenGL.
fn drawn(replay: &mut Replay, full: bool) -> Option<Vec<u8>> {
    let mut image = vec![0; IMAGE_BYTES];
    match replay.draw(full, &mut image) {
        Ok(()) => Some(image),
        Err(error @ Error::Graphics { .. }) => {
            eprintln!("skipped: {error}");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

/// Mean and largest difference in grey levels.
fn difference(one: &[u8], other: &[f64]) -> (f64, f64) {
    let differences: Vec<f64> = one.iter().zip(other).map(|(a, b)| (f64::from(*a) - b).abs()).collect();
    let mean = differences.iter().sum::<f64>() / differences.len() as f64;
    (mean, differences.into_iter().fold(0.0, f64::max))
}

#[test]
fn parity_of_pictures_with_dm_controls_within_a_few_grey_levels() {
    let Some(folder) = golden() else { return };
    for kind in ["gaps", "walls"] {
        let mut replay = replay(&folder, kind);
        let recorded = npz::read(&folder.join(format!("{kind}_camera.npz"))).unwrap();
        let Some(image) = drawn(&mut replay, true) else { return };
        let (mean, largest) = difference(&image, recorded["rgb"].numbers().unwrap());
        eprintln!("{kind}: {mean:.3} grey levels on average, {largest} at most");
        assert!(mean < 1.0 && largest <= 8.0, "{kind}: {mean:.3} on average, {largest} at most");
    }
}

#[test]
fn the_fast_picture_shows_the_same_without_shadows() {
    let folder = workspace().join("tests/fixtures/golden");
    for kind in ["gaps", "walls"] {
        let mut replay = replay(&folder, kind);
        let (Some(fast), Some(full)) = (drawn(&mut replay, false), drawn(&mut replay, true)) else { return };
        let full: Vec<f64> = full.into_iter().map(f64::from).collect();
        let (mean, _) = difference(&fast, &full);
        assert!(mean < 25.0, "{kind}: {mean}");
        let (first, rest) = fast.split_at(3);
        assert!(rest.chunks(3).any(|pixel| pixel != first), "{kind}: one colour everywhere");
    }
}
