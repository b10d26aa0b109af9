//! Films show what is there. Without OpenGL there is nothing to look at, and the tests say so.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use std::sync::Arc;

use comic_clips::Catalogue;
use comic_experiment::Experiment;
use comic_tasks::film::{Camera, Film, Shot, Size};
use comic_tasks::vision::IMAGE_BYTES;
use comic_tasks::{Error, Ghost, Simulated};

fn environment(task: &str, overrides: &[&str]) -> Box<dyn Simulated> {
    let preset = if task == "tracking" { "quickstart" } else { task };
    let overrides: Vec<String> = overrides.iter().map(ToString::to_string).collect();
    let experiment: Experiment = comic_experiment::resolve(preset, &overrides).unwrap();
    let catalogue = Catalogue::open(&experiment.clips).unwrap();
    let task = comic_tasks::build(&experiment, &catalogue).unwrap();
    let first = task.starts()[0].frames.start;
    let mut environment = Arc::clone(&task).environment(1).unwrap();
    environment.reset_to(0, first).unwrap();
    environment
}

fn film(camera: Camera, ghost: Option<Ghost>) -> Film {
    Film::new(Shot { size: Size::new(80, 60).unwrap(), camera, ghost })
}

/// The picture, or nothing where there is no OpenGL.
fn drawn(film: &mut Film, environment: &mut dyn Simulated) -> Option<Vec<u8>> {
    match film.draw(environment) {
        Ok(picture) => {
            assert_eq!(picture.len(), 80 * 60 * 3);
            Some(picture.to_vec())
        }
        Err(error @ Error::Graphics { .. }) => {
            eprintln!("skipped: {error}");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

/// Share of the pixels that differ by more than a shade.
fn difference(one: &[u8], other: &[u8]) -> f64 {
    let differs = |(a, b): (&[u8], &[u8])| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 16);
    let pixels = one.len() / 3;
    one.chunks(3).zip(other.chunks(3)).filter(|pair| differs(*pair)).count() as f64 / pixels as f64
}

#[test]
fn every_task_is_seen_from_every_camera() {
    for task in ["tracking", "go-to-target", "gaps", "walls", "get-up", "ball-catch"] {
        let mut environment = environment(task, &["ball_catch.balls=1"]);
        let mut seen: Vec<Vec<u8>> = Vec::new();
        for camera in [Camera::Tracking, Camera::Side, Camera::Egocentric] {
            let Some(picture) = drawn(&mut film(camera, None), environment.as_mut()) else { return };
            assert!(seen.iter().all(|other| difference(other, &picture) > 0.05), "{task}, {camera:?}: seen before");
            let (first, rest) = picture.split_at(3);
            assert!(rest.chunks(3).any(|pixel| pixel != first), "{task}, {camera:?}: one colour everywhere");
            seen.push(picture);
        }
    }
}

#[test]
fn a_picture_shows_the_pose_and_the_same_pose_gives_the_same_picture() {
    let (mut environment, mut film) = (environment("get-up", &[]), film(Camera::Side, None));
    let Some(before) = drawn(&mut film, environment.as_mut()) else { return };
    assert_eq!(drawn(&mut film, environment.as_mut()).unwrap(), before);
    for _ in 0..10 {
        environment.step(&[0.0; 56]);
    }
    let after = drawn(&mut film, environment.as_mut()).unwrap();
    assert!(difference(&before, &after) > 0.02, "{}", difference(&before, &after));
}

#[test]
fn a_ghost_stands_on_the_humanoid_or_beside_it_where_there_is_a_reference() {
    let pictures = |task| -> Option<[Vec<u8>; 3]> {
        let mut environment = environment(task, &[]);
        let mut with = |ghost| drawn(&mut film(Camera::Side, ghost), environment.as_mut());
        Some([with(None)?, with(Some(Ghost::On))?, with(Some(Ghost::Beside))?])
    };
    let Some([without, on, beside]) = pictures("tracking") else { return };
    for (one, other) in [(&without, &on), (&without, &beside), (&on, &beside)] {
        assert!(difference(one, other) > 0.01, "{}", difference(one, other));
    }
    // On the humanoid at the episode's begin nothing else changes; beside it the humanoid stays as it was.
    assert!(difference(&without, &on) < 0.1);
    let [without, on, beside] = pictures("get-up").unwrap();
    assert_eq!((&without, &without), (&on, &beside));
}

#[test]
fn a_target_is_marked_where_it_is_and_the_physics_does_not_notice() {
    let mut watched = environment("ball-catch", &["ball_catch.balls=1"]);
    let mut alone = environment("ball-catch", &["ball_catch.balls=1"]);
    let mut film = film(Camera::Egocentric, None);
    for _ in 0..5 {
        if drawn(&mut film, watched.as_mut()).is_none() {
            return;
        }
        let marks: Vec<[f64; 3]> = watched.simulation().site_xpos().to_vec();
        assert!(marks.contains(&[3.0, 0.0, 0.0]));
        watched.step(&[0.1; 56]);
        alone.step(&[0.1; 56]);
        assert_eq!(watched.simulation().qpos(), alone.simulation().qpos());
        assert_eq!(watched.simulation().sensordata(), alone.simulation().sensordata());
    }
}

#[test]
fn what_the_humanoid_sees_is_the_same_with_a_film_in_the_same_thread_and_arenas_may_change() {
    let mut environment = environment("walls", &["walls.corridor.arena_steps=0"]);
    let (mut film, mut alone, mut beside) = (film(Camera::Tracking, None), vec![0; IMAGE_BYTES], vec![0; IMAGE_BYTES]);
    let mut last = None;
    for start in 0..3 {
        environment.reset_to(0, start).unwrap();
        match environment.draw(&mut alone) {
            Ok(()) => {}
            Err(error @ Error::Graphics { .. }) => return eprintln!("skipped: {error}"),
            Err(error) => panic!("{error}"),
        }
        let picture = drawn(&mut film, environment.as_mut()).unwrap();
        environment.draw(&mut beside).unwrap();
        assert_eq!(alone, beside, "{start}");
        assert_eq!(drawn(&mut film, environment.as_mut()).unwrap(), picture, "{start}");
        assert!(last.replace(picture.clone()).is_none_or(|last| difference(&last, &picture) > 0.02), "{start}");
    }
}

#[test]
fn sizes_are_read_and_bounded() {
    let size: Size = "640x480".parse().unwrap();
    assert_eq!((size.width(), size.height(), size.bytes()), (640, 480, 921_600));
    for wrong in ["", "640", "640x", "x480", "15x480", "640x2049", "640x480x3", "-640x480", "6e2x480"] {
        assert!(wrong.parse::<Size>().unwrap_err().contains("640x480"), "{wrong}");
    }
}
