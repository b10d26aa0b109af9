//! `comic-actor render` and `evaluate --video`, as a user types them. The tests that film need OpenGL: their names begin
//! with `opengl_`, and `cargo xtask test` leaves them out where there is none.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use std::fs::File;
use std::path::Path;
use std::process::{Command, Output};

fn actor(arguments: &[&str], out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_comic-actor"));
    command.args(arguments).arg(out).env_remove("RUST_LOG").output().unwrap()
}

fn film(arguments: &[&str], out: &Path) {
    let output = actor(arguments, out);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Number of frames and hundredths of a second of a GIF.
fn length(path: &Path) -> (usize, u32) {
    let mut decoder = gif::DecodeOptions::new().read_info(File::open(path).unwrap()).unwrap();
    let (mut frames, mut hundredths) = (0, 0);
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        frames += 1;
        hundredths += u32::from(frame.delay);
    }
    (frames, hundredths)
}

#[test]
fn opengl_a_film_is_as_long_as_asked_at_any_frame_rate() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("walls.gif");
    // The humanoid falls within this time. The next episode begins in another arena.
    let base = ["render", "--task", "walls", "--set", "walls.corridor.arena_steps=0", "--size", "64x48"];
    for (rate, frames) in [(&[][..], 25), (&["--fps", "10"][..], 7)] {
        let arguments = [&base[..], rate, &["--seconds", "0.75", "--out"]].concat();
        film(&arguments, &out);
        let (found, hundredths) = length(&out);
        assert_eq!(found, frames);
        assert!((75..=84).contains(&hundredths), "{hundredths}");
    }
}

#[test]
fn opengl_tracking_is_filmed_with_a_ghost_and_an_evaluation_films_its_first_episode() {
    let directory = tempfile::tempdir().unwrap();
    let (one, other) = (directory.path().join("render.gif"), directory.path().join("evaluate.gif"));
    let ghost = ["--size", "64x48", "--ghost=beside", "--camera", "side"];
    // Episodes of a few steps.
    let brief = ["--set", "tracking.termination_threshold=0.03"];
    let render = [&["render", "--task", "tracking"], &brief[..], &ghost[..], &["--out"]].concat();
    film(&render, &one);
    let evaluate = [&["evaluate", "--preset", "quickstart", "--servo"], &brief[..], &ghost[..], &["--video"]].concat();
    film(&evaluate, &other);
    // The servo action has no noise, so both films show the same.
    assert_eq!(std::fs::read(one).unwrap(), std::fs::read(other).unwrap());
}

#[test]
fn wrong_arguments_are_refused_before_anything_is_built() {
    let directory = tempfile::tempdir().unwrap();
    for (arguments, name, message) in [
        (&["--task", "gaps"][..], "film.avi", "known are .html (a page), .gif"),
        (&["--task", "gaps", "--preset", "walls"], "film.gif", "its task is walls, not gaps"),
        (&["--task", "gaps", "--start", "64"], "film.gif", "only at 0 to 63"),
        (&["--task", "gaps", "--checkpoint", "/nowhere"], "film.gif", "checkpoint /nowhere"),
        (&["--task", "gap"], "film.gif", "tasks are tracking, go-to-target, gaps"),
        (&["--task", "gaps", "--seconds", "0"], "film.gif", "not within 0 and 3600"),
    ] {
        let output = actor(&[&["render"], arguments, &["--out"]].concat(), &directory.path().join(name));
        let log = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{log}");
        assert!(log.contains(message), "{log}");
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0, "a file is left");
    }
}
