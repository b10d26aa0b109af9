//! Films show the simulation. The tests that draw need OpenGL: their names begin with `opengl_`, and `cargo xtask test`
//! leaves them out where there is none.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use std::sync::Arc;

use comic_clips::Catalogue;
use comic_experiment::Experiment;
use comic_tasks::film::{Camera, Film, Shot, Size};
use comic_tasks::vision::IMAGE_BYTES;
use comic_tasks::{Ghost, Simulated};

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

fn drawn(film: &mut Film, environment: &mut dyn Simulated) -> Vec<u8> {
    let picture = film.draw(environment).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(picture.len(), 80 * 60 * 3);
    picture.to_vec()
}

/// Fraction of the pixels that differ by more than 16 levels in a colour.
fn difference(one: &[u8], other: &[u8]) -> f64 {
    let differs = |(a, b): (&[u8], &[u8])| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 16);
    let pixels = one.len() / 3;
    one.chunks(3).zip(other.chunks(3)).filter(|pair| differs(*pair)).count() as f64 / pixels as f64
}

#[test]
fn opengl_every_camera_films_every_task() {
    for task in ["tracking", "go-to-target", "gaps", "walls", "get-up", "ball-catch"] {
        let mut environment = environment(task, &["ball_catch.balls=1"]);
        let mut seen: Vec<Vec<u8>> = Vec::new();
        for camera in [Camera::Tracking, Camera::Side, Camera::Egocentric] {
            let picture = drawn(&mut film(camera, None), environment.as_mut());
            let new = seen.iter().all(|other| difference(other, &picture) > 0.05);
            assert!(new, "{task}, {camera:?}: the same picture as another camera's");
            let (first, rest) = picture.split_at(3);
            assert!(rest.chunks(3).any(|pixel| pixel != first), "{task}, {camera:?}: one colour everywhere");
            seen.push(picture);
        }
    }
}

#[test]
fn opengl_a_picture_shows_the_pose_and_the_same_pose_gives_the_same_picture() {
    let (mut environment, mut film) = (environment("get-up", &[]), film(Camera::Side, None));
    let before = drawn(&mut film, environment.as_mut());
    assert_eq!(drawn(&mut film, environment.as_mut()), before);
    for _ in 0..10 {
        environment.step(&[0.0; 56]);
    }
    let after = drawn(&mut film, environment.as_mut());
    assert!(difference(&before, &after) > 0.02, "{}", difference(&before, &after));
}

#[test]
fn opengl_a_ghost_stands_on_the_humanoid_or_beside_it_in_a_task_with_a_reference() {
    let pictures = |task| {
        let mut environment = environment(task, &[]);
        [None, Some(Ghost::On), Some(Ghost::Beside)]
            .map(|ghost| drawn(&mut film(Camera::Side, ghost), environment.as_mut()))
    };
    let [without, on, beside] = pictures("tracking");
    for (one, other) in [(&without, &on), (&without, &beside), (&on, &beside)] {
        assert!(difference(one, other) > 0.01, "{}", difference(one, other));
    }
    // At the start of an episode a ghost on the humanoid changes few pixels.
    assert!(difference(&without, &on) < 0.1);
    let [without, on, beside] = pictures("get-up");
    assert_eq!((&without, &without), (&on, &beside));
}

#[test]
fn opengl_a_target_is_marked_at_its_place_and_the_physics_does_not_change() {
    let mut watched = environment("ball-catch", &["ball_catch.balls=1"]);
    let mut alone = environment("ball-catch", &["ball_catch.balls=1"]);
    let mut film = film(Camera::Egocentric, None);
    for _ in 0..5 {
        drawn(&mut film, watched.as_mut());
        let marks: Vec<[f64; 3]> = watched.simulation().site_xpos().to_vec();
        assert!(marks.contains(&[3.0, 0.0, 0.0]));
        watched.step(&[0.1; 56]);
        alone.step(&[0.1; 56]);
        assert_eq!(watched.simulation().qpos(), alone.simulation().qpos());
        assert_eq!(watched.simulation().sensordata(), alone.simulation().sensordata());
    }
}

#[test]
fn opengl_a_film_in_the_same_thread_does_not_change_the_camera_image_and_arenas_may_change() {
    let mut environment = environment("walls", &["walls.corridor.arena_steps=0"]);
    let (mut film, mut alone, mut beside) = (film(Camera::Tracking, None), vec![0; IMAGE_BYTES], vec![0; IMAGE_BYTES]);
    let mut last = None;
    for start in 0..3 {
        environment.reset_to(0, start).unwrap();
        environment.draw(&mut alone).unwrap_or_else(|error| panic!("{error}"));
        let picture = drawn(&mut film, environment.as_mut());
        environment.draw(&mut beside).unwrap();
        assert_eq!(alone, beside, "{start}");
        assert_eq!(drawn(&mut film, environment.as_mut()), picture, "{start}");
        assert!(last.replace(picture.clone()).is_none_or(|last| difference(&last, &picture) > 0.02), "{start}");
    }
}

/// A context has the textures of one task's arenas.
#[test]
fn opengl_two_tasks_in_one_thread_have_the_images_that_each_has_alone() {
    let image = |task: &str| {
        let mut image = vec![0; IMAGE_BYTES];
        environment(task, &[]).draw(&mut image).unwrap_or_else(|error| panic!("{error}"));
        image
    };
    let alone = |task: &'static str| std::thread::scope(|scope| scope.spawn(|| image(task)).join().unwrap());
    for task in ["walls", "gaps", "walls"] {
        assert_eq!(image(task), alone(task), "{task}");
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
