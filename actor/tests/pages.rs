//! Pages, as a user asks for them: `comic-actor render --out FILE.html` and `evaluate --html FILE`. OpenGL is hidden from the
//! program. `python/tests/test_pages.py` looks at pages in a browser.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use std::path::Path;
use std::process::{Command, Output};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use comic_clips::Catalogue;
use comic_experiment::ClipSource;
use serde_json::Value;

fn actor(arguments: &[&str], out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_comic-actor"));
    // Nothing of a page is drawn: EGL finds no library to draw with.
    command.env("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent");
    command.args(arguments).arg(out).env_remove("RUST_LOG").output().unwrap()
}

/// The data in the page that the program writes.
fn page(arguments: &[&str]) -> Value {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("page.html");
    let output = actor(arguments, &out);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let html = std::fs::read_to_string(out).unwrap();
    assert!(html.len() < 2_000_000, "{} bytes", html.len());
    let (_, data) = html.split_once("id=\"data\">").unwrap();
    serde_json::from_str(data.split_once("</script>").unwrap().0).unwrap()
}

fn texts(value: &Value, key: &str) -> Vec<String> {
    value.as_array().unwrap().iter().map(|entry| entry[key].as_str().unwrap().to_owned()).collect()
}

/// The bytes of poses, of which 14 are one pose.
fn bytes(poses: &Value) -> Vec<u8> {
    BASE64_STANDARD.decode(poses["data"].as_str().unwrap()).unwrap()
}

/// The positions of the bodies, frame by frame, m.
fn places(poses: &Value) -> Vec<[f64; 3]> {
    let end = |name: &str, axis: usize| poses[name][axis].as_f64().unwrap();
    let place = |pose: &[u8], axis: usize| {
        let level = f64::from(u16::from_le_bytes([pose[2 * axis], pose[2 * axis + 1]])) / f64::from(u16::MAX);
        end("low", axis) + level * (end("high", axis) - end("low", axis))
    };
    bytes(poses).chunks_exact(14).map(|pose| [0, 1, 2].map(|axis| place(pose, axis))).collect()
}

#[test]
fn a_page_of_tracking_has_the_poses_the_reference_and_each_term_of_every_step() {
    let page = page(&["render", "--task", "tracking", "--clip", "builtin:walk", "--ghost", "--out"]);
    assert_eq!((page["ghost"].as_str(), page["step"].as_f64()), (Some("on"), Some(0.03)));
    let episode = &page["episodes"][0];
    let terms = page["terms"].as_array().unwrap().len();
    let rewards = episode["rewards"].as_array().unwrap();
    assert_eq!((terms, rewards.len()), (5, 5));
    let steps = rewards[0].as_array().unwrap().len();
    assert!(steps > 5, "the servos follow the clip for some steps");
    let bodies = episode["poses"]["bodies"].as_u64().unwrap() as usize;
    assert_eq!(bytes(&episode["poses"]).len(), 14 * bodies * (steps + 1));
    assert_eq!(episode["reference"]["bodies"], episode["poses"]["bodies"], "nothing but the humanoid moves");

    // The first body is the root, and the reference's is the clip's.
    let clip = Catalogue::open(&[ClipSource::parse("builtin:walk")]).unwrap().load(0).unwrap();
    let start: usize = episode["name"].as_str().unwrap().rsplit(' ').next().unwrap().parse().unwrap();
    let reference = &episode["reference"];
    let frames = places(reference);
    for frame in [0, steps / 2, steps] {
        let found = frames[frame * bodies];
        for (axis, wanted) in clip.motion.position[start + frame].into_iter().enumerate() {
            assert!(
                (found[axis] - wanted).abs() < 1e-3,
                "frame {frame}, axis {axis}: {} m, not {wanted} m",
                found[axis]
            );
        }
    }
}

#[test]
fn a_page_has_as_many_episodes_as_asked_from_starts_that_are_spread_evenly() {
    let page = page(&["render", "--task", "tracking", "--clip", "builtin:walk", "--episodes", "3", "--out"]);
    let names = texts(&page["episodes"], "name");
    let starts: Vec<usize> = names.iter().map(|name| name.rsplit(' ').next().unwrap().parse().unwrap()).collect();
    assert_eq!(starts.len(), 3);
    let (first, second) = (starts[1] - starts[0], starts[2] - starts[1]);
    assert!(first > 10 && first == second, "{starts:?}");
}

#[test]
fn more_episodes_than_starts_are_each_start_once_from_the_given_one_on() {
    let arguments = ["render", "--task", "tracking", "--clip", "builtin:walk", "--start", "70", "--episodes", "500"];
    let page = page(&[&arguments[..], &["--fps", "1", "--out"]].concat());
    let names = texts(&page["episodes"], "name");
    let starts: Vec<usize> = names.iter().map(|name| name.rsplit(' ').next().unwrap().parse().unwrap()).collect();
    assert_eq!(starts, (70..72).chain(0..70).collect::<Vec<_>>());
}

/// With a pose every tenth of a second, the last pose is still that of the last step.
#[test]
fn a_page_of_fewer_poses_has_the_end_of_the_episode() {
    let arguments = ["render", "--task", "tracking", "--clip", "builtin:walk"];
    let every_step = &page(&[&arguments[..], &["--out"]].concat())["episodes"][0];
    let fewer = &page(&[&arguments[..], &["--fps", "7", "--out"]].concat())["episodes"][0];
    assert_eq!((fewer["every"].as_u64(), &fewer["steps"]), (Some(5), &every_step["steps"]));
    let (all, some) = (places(&every_step["poses"]), places(&fewer["poses"]));
    let bodies = every_step["poses"]["bodies"].as_u64().unwrap() as usize;
    let steps = every_step["steps"].as_u64().unwrap() as usize;
    assert!(!steps.is_multiple_of(5), "the last step would have a pose anyway");
    assert_eq!(some.len() / bodies, steps.div_ceil(5) + 1);
    for (one, other) in all[all.len() - bodies..].iter().zip(&some[some.len() - bodies..]) {
        for axis in 0..3 {
            assert!((one[axis] - other[axis]).abs() < 1e-3, "{one:?} {other:?}");
        }
    }
    assert_eq!(fewer["rewards"], every_step["rewards"], "the reward of each step is there");
}

#[test]
fn every_task_has_a_page_with_its_shapes() {
    for (task, wanted) in
        [("go-to-target", "plane"), ("gaps", "box"), ("walls", "box"), ("get-up", "plane"), ("ball-catch", "sphere")]
    {
        let page = page(&["render", "--task", task, "--seconds", "0.3", "--out"]);
        let shapes = page["scenes"][0]["shapes"].as_array().unwrap();
        let humanoid = shapes.iter().filter(|shape| shape["form"] == "capsule").count();
        assert!(humanoid > 20, "{task}: {humanoid} capsules");
        assert!(shapes.iter().any(|shape| shape["form"] == wanted), "{task}");
        let targets = page["episodes"][0]["targets"].as_array().unwrap().len();
        assert_eq!(targets > 0, ["go-to-target", "ball-catch"].contains(&task), "{task}");
        assert!(page["episodes"][0]["reference"].is_null(), "{task} has no reference");
    }
}

#[test]
fn an_evaluation_has_a_page_of_its_worst_its_median_and_its_best_start_with_its_own_numbers() {
    // Every episode's noise is its own, so what is played is what was evaluated, also with noise.
    for policy in [&["--servo"][..], &["--untrained", "--deterministic"], &["--untrained"]] {
        compare(&page(&[&["evaluate", "--preset", "quickstart"], policy, &["--html"]].concat()));
    }
}

fn compare(page: &Value) {
    let names = texts(&page["episodes"], "name");
    let first: Vec<&str> = names.iter().filter_map(|name| name.split(' ').next()).collect();
    assert_eq!(first, ["worst", "median", "best"]);
    let number = |text: &str| text.split(['(', ')']).nth(1).unwrap().parse::<f64>().unwrap();
    let said: Vec<f64> = names.iter().map(|name| number(name)).collect();
    assert!(said.is_sorted() && said[0] < said[2], "{said:?}");
    for (name, note) in names.iter().zip(texts(&page["episodes"], "note")) {
        assert!(note.ends_with(&format!("normalised reward {:.3}", number(name))), "{name}: {note}");
    }
}

#[test]
fn what_a_page_cannot_have_is_refused_before_anything_is_built() {
    let directory = tempfile::tempdir().unwrap();
    for (arguments, name, message) in [
        (&["render", "--task", "gaps", "--size", "64x48", "--out"][..], "page.html", "--size: a page has none"),
        (&["render", "--task", "gaps", "--camera", "side", "--out"], "page.html", "--camera: a page has none"),
        (&["render", "--task", "gaps", "--seconds", "601", "--out"], "page.html", "a page holds 600 s at most"),
        (&["render", "--task", "gaps", "--ghost", "--out"], "page.html", "gaps has no reference"),
        (&["evaluate", "--preset", "quickstart", "--servo", "--html"], "page.gif", "name it .html"),
    ] {
        let output = actor(arguments, &directory.path().join(name));
        let log = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{log}");
        assert!(log.contains(message), "{log}");
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0, "a file is left");
    }
}
