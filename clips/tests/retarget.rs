//! Recordings of other skeletons become clips of the humanoid.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::f64::consts::FRAC_PI_2;

use comic_clips::retarget::{Options, Recorded, RecordedPose, Report, Role, Roles, find_roles, read_bvh, retarget};
use comic_clips::spatial::{IDENTITY, about, add, multiply, norm, normalize, rotated, scale, subtract};
use comic_clips::{Clip, JOINT_RANGES, JOINTS};
use proptest::prelude::*;
use support::humanoid::{BODIES, BONES, Style, bodies, load, record};
use support::law;

fn run(recorded: &Recorded, roles: &Roles) -> Result<(Clip, Report), String> {
    let options = Options { name: "copy".into(), ..Options::default() };
    retarget(recorded, roles, &options).map_err(|error| error.to_string())
}

/// Mean differences between a clip and its copy, without thumbs and fingers.
#[derive(Debug)]
struct Difference {
    /// Bodies in the world, mm.
    places: f64,
    /// Bodies seen from the root, mm.
    seen: f64,
    /// Joints, degrees.
    joints: f64,
}

impl Difference {
    fn between(clip: &Clip, copy: &Clip) -> Self {
        let follows = |name: &str| !name.contains("thumb") && !name.contains("fingers");
        let (mut places, mut seen, mut angles) = (Vec::new(), Vec::new(), Vec::new());
        for (a, b) in bodies(&clip.motion).iter().zip(bodies(&copy.motion)) {
            let roots = subtract(a[0].0, b[0].0);
            for (name, ((a, _), (b, _))) in BODIES.iter().zip(a.iter().zip(b).skip(1)) {
                if follows(name) {
                    places.push(1000.0 * norm(&subtract(*a, b)));
                    seen.push(1000.0 * norm(&subtract(subtract(*a, b), roots)));
                }
            }
        }
        for (a, b) in clip.motion.joints.iter().zip(&copy.motion.joints) {
            let pairs = JOINTS.iter().zip(a.iter().zip(b)).filter(|(name, _)| follows(name));
            angles.extend(pairs.map(|(_, (a, b))| (a - b).abs().to_degrees()));
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        Self { places: mean(&places), seen: mean(&seen), joints: mean(&angles) }
    }
}

fn within_ranges(clip: &Clip) -> bool {
    let fits =
        |joints: &[f64; 56]| joints.iter().zip(JOINT_RANGES).all(|(angle, [low, high])| (low..=high).contains(angle));
    clip.motion.joints.iter().all(fits)
}

fn upside(units: f64, rate: f64) -> Style {
    Style { units, axes: Style::y_up(), rate, random: false }
}

/// The floor and the feet that stand move the whole body, so its place in the world differs more than its pose.
#[test]
fn a_recording_on_the_humanoids_own_skeleton_gives_its_poses_back() {
    for (name, style) in [
        ("walk", Style::PLAIN),
        ("walk", upside(100.0, 120.0)),
        ("squat", upside(1.0 / 0.0254, 60.0)),
        ("run", upside(1000.0, 120.0)),
        ("turn", upside(100.0, 30.0)),
        ("jump", upside(100.0, 50.0)),
    ] {
        let clip = load(name);
        let (recorded, roles) = record(&clip, style);
        let (copy, report) = run(&recorded, &roles).unwrap();
        let difference = Difference::between(&clip, &copy);
        assert!(within_ranges(&copy));
        assert!(
            difference.joints < 1.0 && difference.seen < 5.0 && difference.places < 20.0,
            "{name}: {difference:?}: {report}"
        );
    }
}

/// Without a rest pose, the pose that counts as neutral is a guess, so hands, neck and toes differ by a constant turn.
#[test]
fn a_skeleton_without_a_rest_pose_of_a_person_is_aligned_by_the_motion() {
    let clip = load("walk");
    let (recorded, roles) = record(&clip, Style { random: true, ..upside(1.0 / 0.0254, 60.0) });
    let (copy, report) = run(&recorded, &roles).unwrap();
    let difference = Difference::between(&clip, &copy);
    assert!(report.notes.iter().any(|note| note.contains("rest pose")), "{report}");
    assert!(difference.joints < 10.0 && difference.seen < 30.0, "{difference:?}: {report}");
}

#[test]
fn a_recorded_walk_of_a_bvh_file_is_followed() {
    let path: std::path::PathBuf = [env!("CARGO_MANIFEST_DIR"), "tests", "data", "bvh", "walk.bvh"].iter().collect();
    let (recorded, _) = read_bvh(&path).unwrap();
    let (clip, report) = run(&recorded, &find_roles(&recorded)).unwrap();
    assert!(within_ranges(&clip));
    assert_eq!((report.up.to_string(), report.unit_meters), ("y".into(), 0.0254));
    assert!(report.lowest_mm > -5.0 && report.largest_slide_mm < 5.0, "{report}");
    let arm = report.bones.iter().find(|bone| bone.role == "left_forearm").unwrap();
    assert!(arm.mean_degrees < 2.0, "{report}");
    assert_eq!(report.notes[0], "no bone for neck; if the skeleton has it, say which bone it is with --bones FILE");
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!((json["up"].as_str(), json["steps"].as_u64()), (Some("y"), Some(clip.steps() as u64)));
    assert_eq!(json["bones"][0]["role"], "pelvis");
    assert!(json["places"][0]["mean_mm"].is_number() && json["limits"].is_array(), "{json}");
}

/// Only place, heading and unit change, so the poses stay.
#[test]
fn place_heading_and_unit_do_not_matter() {
    let clip = load("walk");
    let (recorded, roles) = record(&clip, upside(100.0, 60.0));
    let (plain, _) = run(&recorded, &roles).unwrap();
    for (angle, units, place) in
        [(1.3, 1.0, [250.0, 90.0, -400.0]), (-2.9, 0.01, [0.0; 3]), (0.4, 10.0, [1e4, 0.0, 1e4])]
    {
        let mut other = recorded.clone();
        let turn = about(1, angle);
        for bone in &mut other.bones {
            bone.offset = scale(units, bone.offset);
        }
        for pose in &mut other.frames {
            pose.position = scale(units, add(rotated(turn, pose.position), place));
            pose.rotations[0] = multiply(turn, pose.rotations[0]);
        }
        let (moved, report) = run(&other, &roles).unwrap();
        for (a, b) in plain.motion.joints.iter().zip(&moved.motion.joints) {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3), "{report}");
        }
        for (a, b) in plain.motion.position.iter().zip(&moved.motion.position) {
            let turned = rotated(about(2, angle), *a);
            assert!(norm(&subtract(turned, *b)) < 1e-3, "{turned:?}, {b:?}");
        }
    }
}

#[test]
fn a_part_of_the_frames_can_be_used() {
    let (recorded, roles) = record(&load("walk"), upside(100.0, 120.0));
    let options = |frames| Options { name: "part".into(), frames: Some(frames), ..Options::default() };
    let (clip, report) = retarget(&recorded, &roles, &options(36..109)).unwrap();
    assert_eq!((clip.steps(), report.frames, clip.name.as_str()), (20, 73, "part"));
    let error = retarget(&recorded, &roles, &options(5..8)).unwrap_err().to_string();
    assert!(error.contains("walk.bvh") && error.contains("5..8"), "{error}");
}

#[test]
fn what_is_no_recording_of_a_person_is_refused_with_the_remedy() {
    let (good, roles) = record(&load("walk"), upside(100.0, 60.0));
    let refused = |change: &dyn Fn(&mut Recorded, &mut Roles), expected: &str| {
        let (mut recorded, mut roles) = (good.clone(), roles.clone());
        change(&mut recorded, &mut roles);
        let error = run(&recorded, &roles).unwrap_err();
        assert!(error.contains("walk.bvh") && error.contains(expected), "{error}");
    };
    refused(&|recorded, _| recorded.frames.truncate(1), "too few");
    refused(&|recorded, _| recorded.frames.clear(), "frames 0..0 of 0 are too few");
    refused(&|recorded, _| recorded.bones.clear(), "rotations for 0 bones");
    refused(&|recorded, _| recorded.frame_seconds = 0.1, "frames per second");
    refused(&|recorded, _| recorded.frame_seconds = f64::NAN, "frames per second");
    refused(&|recorded, _| recorded.frames[7].position[1] = f64::NAN, "frame 7");
    refused(&|recorded, _| recorded.frames[7].position[1] = 1e300, "frame 7");
    refused(&|recorded, _| recorded.frames[7].rotations[3] = [f64::INFINITY; 4], "frame 7");
    refused(&|recorded, _| recorded.frames[7].rotations[3] = [0.0; 4], "frame 7");
    refused(&|recorded, _| recorded.frames[7].rotations.truncate(5), "frame 7");
    refused(&|recorded, _| recorded.bones[2].offset = [0.0; 3], "`lfemur`");
    refused(&|recorded, _| recorded.bones[2].offset[0] = f64::NAN, "`ltibia`");
    refused(&|recorded, _| recorded.bones.iter_mut().for_each(|bone| bone.offset = [0.0; 3]), "`lfemur`");
    refused(&|recorded, _| recorded.bones[2].parent = Some(20), "`ltibia`");
    refused(&|_, roles| roles.set(Role::LeftShin, 1), "both");
    refused(&|_, roles| roles.set(Role::LeftShin, 6), "both");
    refused(&|_, roles| roles.set(Role::LeftShin, 99), "bone 99");
    refused(&|_, roles| *roles = Roles::new(), "--bones FILE");
    let options = Options { unit_meters: Some(f64::NAN), ..Options::default() };
    assert!(retarget(&good, &roles, &options).unwrap_err().to_string().contains("unit"));
}

/// Files of CMU in BVH begin with a T-pose at another place.
#[test]
fn a_frame_outside_of_the_window_changes_nothing() {
    let (recorded, roles) = record(&load("walk"), upside(100.0, 120.0));
    let (expected, report) = run(&recorded, &roles).unwrap();
    assert_eq!(report.notes, Vec::<String>::new());
    let mut wild = recorded.clone();
    let pose = RecordedPose { position: [900.0, -50.0, 70.0], rotations: vec![about(0, 2.0); BONES.len()] };
    wild.frames.insert(0, pose);
    let (_, report) = run(&wild, &roles).unwrap();
    let end = wild.frames.len();
    assert!(report.notes[0].starts_with("the first frame is far from the second one"), "{report}");
    assert!(report.notes[0].ends_with(&format!("--frames 1..{end}")), "{report}");
    wild.frames.push(RecordedPose { position: [1e4; 3], ..wild.frames[0].clone() });
    let options = Options { name: "copy".into(), frames: Some(1..end), ..Options::default() };
    let (part, report) = retarget(&wild, &roles, &options).unwrap();
    assert_eq!((part.motion == expected.motion, report.notes), (true, vec![]));
}

/// The classic skeletons of Biovision end the foot straight below the ankle.
#[test]
fn a_foot_whose_end_is_below_the_ankle_points_forward() {
    let clip = load("walk");
    let (mut recorded, all) = record(&clip, upside(100.0, 60.0));
    let mut roles = Roles::new();
    for role in Role::all().filter(|role| !matches!(role, Role::LeftToes | Role::RightToes)) {
        all.get(role).into_iter().for_each(|bone| roles.set(role, bone));
    }
    for role in [Role::LeftFoot, Role::RightFoot] {
        recorded.bones[roles.get(role).unwrap()].end = Some([0.0, -7.0, 0.0]);
    }
    let (copy, report) = run(&recorded, &roles).unwrap();
    let difference = Difference::between(&clip, &copy);
    assert!(difference.joints < 2.0 && difference.seen < 10.0, "{difference:?}: {report}");
    assert!(report.notes.iter().any(|note| note.starts_with("no bone for left_toes, right_toes;")), "{report}");
}

/// Turns each frame about the file's x axis at the root.
fn tumbling(recorded: &Recorded, angle: impl Fn(usize) -> f64) -> Recorded {
    let mut turned = recorded.clone();
    for (frame, pose) in turned.frames.iter_mut().enumerate() {
        pose.rotations[0] = multiply(about(0, angle(frame)), pose.rotations[0]);
    }
    turned
}

#[test]
fn a_direction_up_that_is_not_certain_is_mentioned() {
    let (recorded, roles) = record(&load("walk"), upside(100.0, 60.0));
    let handstand = tumbling(&recorded, |_| std::f64::consts::PI);
    let (_, report) = run(&handstand, &roles).unwrap();
    assert_eq!(report.up.to_string(), "-y");
    assert!(
        report.notes[0].starts_with("up is -y, as the motion shows, but the rest pose stands along y;"),
        "{report}"
    );
    let options = Options { up: Some("y".parse().unwrap()), ..Options::default() };
    let (_, report) = retarget(&handstand, &roles, &options).unwrap();
    assert!(!report.notes.iter().any(|note| note.contains("--up")), "{report}");
    // In SMPL the rest pose is not in the axes of the world.
    let (_, report) = run(&Recorded { rest_in_world: false, ..handstand }, &roles).unwrap();
    assert!(!report.notes.iter().any(|note| note.contains("--up")), "{report}");
    let whole = std::f64::consts::TAU / recorded.frames.len() as f64;
    let (_, report) = run(&tumbling(&recorded, |frame| whole * frame as f64), &roles).unwrap();
    assert_eq!(report.up.to_string(), "y");
    // On the head in most frames, but never for long.
    let (_, report) = run(&tumbling(&recorded, |frame| 1.2 + 0.6 * whole * frame as f64), &roles).unwrap();
    assert_eq!(report.up.to_string(), "y");
    assert!(report.notes[0].starts_with("up is y, as the rest pose shows,"), "{report}");
}

#[test]
fn any_axis_can_be_up() {
    let clip = load("walk");
    let (recorded, roles) = record(&clip, upside(1.0, 60.0));
    let (expected, _) = run(&recorded, &roles).unwrap();
    for (axis, axes) in [("z", IDENTITY), ("-y", about(0, FRAC_PI_2)), ("x", about(1, FRAC_PI_2))] {
        let (recorded, roles) = record(&clip, Style { axes, ..upside(1.0, 60.0) });
        let (copy, report) = run(&recorded, &roles).unwrap();
        assert_eq!((report.up.to_string().as_str(), report.notes.len()), (axis, 0), "{report}");
        for (a, b) in expected.motion.joints.iter().zip(&copy.motion.joints) {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3), "{axis}: {report}");
        }
    }
}

#[test]
fn two_poses_are_enough() {
    let (mut recorded, roles) = record(&load("walk"), upside(100.0, 100.0));
    recorded.frames.truncate(4);
    let (clip, report) = run(&recorded, &roles).unwrap();
    // The last pose is only there for the velocity of the one before.
    assert_eq!((clip.steps(), report.steps), (1, 1));
    assert!(within_ranges(&clip));
    recorded.frames.truncate(3);
    assert!(run(&recorded, &roles).unwrap_err().contains("frames 0..3 of 3 are too few"));
}

#[test]
fn left_and_right_exchanged_are_mentioned() {
    let (recorded, roles) = record(&load("walk"), upside(100.0, 60.0));
    let mut exchanged = Roles::new();
    for role in Role::all().filter(|role| *role != Role::RightFingers) {
        let name = role.name();
        let other = name.strip_prefix("left_").map(|part| format!("right_{part}"));
        let other = other.or_else(|| name.strip_prefix("right_").map(|part| format!("left_{part}")));
        let other = other.map_or(role, |other| Role::from_name(&other).unwrap());
        roles.get(other).into_iter().for_each(|bone| exchanged.set(role, bone));
    }
    let (_, report) = run(&recorded, &exchanged).unwrap();
    assert!(report.notes.iter().any(|note| note.ends_with("are left and right exchanged?")), "{report}");
}

/// Lengths and turns that are noise, always the same for a seed.
fn noise(recorded: &Recorded, seed: f64, size: f64, rate: f64) -> Recorded {
    let mut noisy = Recorded { frame_seconds: 1.0 / rate, ..recorded.clone() };
    noisy.frames.truncate(24);
    let noise = |k: usize| (seed + 12.9898 * k as f64).sin();
    for (index, bone) in noisy.bones.iter_mut().enumerate() {
        bone.offset = std::array::from_fn(|part| size * noise(3 * index + part));
    }
    for (frame, pose) in noisy.frames.iter_mut().enumerate() {
        pose.position = pose.position.map(|part| part * size * noise(frame));
        for (index, rotation) in pose.rotations.iter_mut().enumerate() {
            *rotation = normalize(std::array::from_fn(|part| noise(7 * frame + 31 * index + part)));
        }
    }
    noisy
}

/// Else the property below would say nothing.
#[test]
fn some_noise_gives_a_clip() {
    let (recorded, roles) = record(&load("walk"), upside(1.0, 60.0));
    let clips = (0..4).filter(|seed| run(&noise(&recorded, f64::from(*seed), 1.0, 60.0), &roles).is_ok()).count();
    assert!(clips > 0);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..law() })]

    /// Any finite skeleton and motion gives a clip of finite numbers within the ranges, or an error.
    #[test]
    fn no_motion_makes_it_panic(
        seed in 0.0..1000.0f64, size in prop::sample::select(vec![1e-9, 1e-3, 1.0, 1e6]), rate in 20.0..300.0f64,
    ) {
        let (recorded, roles) = record(&load("walk"), upside(1.0, 60.0));
        if let Ok((clip, report)) = run(&noise(&recorded, seed, size, rate), &roles) {
            prop_assert!(within_ranges(&clip));
            prop_assert!(clip.motion.position.iter().flatten().all(|part| part.is_finite()), "{report}");
            prop_assert!(clip.motion.joints_velocity.iter().flatten().all(|part| part.is_finite()), "{report}");
        }
    }
}
