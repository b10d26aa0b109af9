//! The check finds every defect of a file, and none in a sound one.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::f64::consts::FRAC_PI_2;
use std::path::{Path, PathBuf};

use comic_clips::check::{Checked, Kind, check};
use comic_clips::import::import;
use comic_clips::spatial::{about, multiply, rotated};
use comic_clips::{Catalogue, Clip, ClipWriter, JOINTS, builtin_names, merge};
use comic_experiment::ClipSource;
use support::{defects, recordings, run_take};

fn kinds(checked: &Checked) -> Vec<Kind> {
    let mut kinds: Vec<Kind> = checked.defects.iter().map(|defect| defect.kind).collect();
    kinds.dedup();
    kinds
}

fn written(directory: &Path, clip: &Clip) -> PathBuf {
    let path = directory.join("clip.h5");
    let mut writer = ClipWriter::create(&path, true).unwrap();
    writer.add(clip).unwrap();
    writer.finish().unwrap();
    path
}

fn builtin(name: &str) -> Clip {
    Catalogue::open(&[ClipSource::whole(format!("builtin:{name}"))]).unwrap().load(0).unwrap()
}

fn walk() -> Clip {
    builtin("walk")
}

fn checked(clip: &Clip) -> Checked {
    let directory = tempfile::tempdir().unwrap();
    let [checked] = check(&written(directory.path(), clip), &[]).unwrap().try_into().unwrap();
    checked
}

/// `builtin:stand`, with a root that is so much higher, m, in each frame.
fn lifted(height: impl Fn(usize) -> f64) -> Clip {
    let mut clip = builtin("stand");
    clip.motion.position.iter_mut().enumerate().for_each(|(frame, position)| position[2] += height(frame));
    clip
}

/// A static pose made from `builtin:stand`: its root is turned forwards by so many degrees, and the joints of both sides have
/// these angles, rad. The lowest point is on the floor.
fn posed(degrees: f64, angles: &[(&str, f64)]) -> Clip {
    let mut clip = builtin("stand");
    let lean = about(1, degrees.to_radians());
    for (position, quaternion) in clip.motion.position.iter_mut().zip(&mut clip.motion.quaternion) {
        (*position, *quaternion) = (rotated(lean, *position), multiply(lean, *quaternion));
    }
    for joints in &mut clip.motion.joints {
        for (name, angle) in angles {
            // The sides mirror each other: turns about y and z change their sign.
            let mirrored = if name.ends_with("rx") { *angle } else { -angle };
            joints[joint(&format!("l{name}"))] = *angle;
            joints[joint(&format!("r{name}"))] = mirrored;
        }
    }
    let [low, _] = checked(&clip).lowest_point.unwrap();
    clip.motion.position.iter_mut().for_each(|position| position[2] -= low);
    clip
}

fn handstand() -> Clip {
    posed(176.0, &[("humerusrx", 1.5), ("humerusry", 1.0), ("humerusrz", 0.0)])
}

/// Height of a jump at frame 30 that reaches `height`, m, under a gravity of `fall`, m/s².
fn parabola(height: f64, fall: f64) -> impl Fn(usize) -> f64 {
    move |frame| {
        let time = 0.03 * (frame as f64 - 30.0);
        if time < 0.0 { 0.0 } else { ((2.0 * fall * height).sqrt() * time - fall * time * time / 2.0).max(0.0) }
    }
}

/// The clip's one defect, whose description gives these frames.
fn impossible(clip: &Clip, kind: Kind, frames: std::ops::RangeInclusive<usize>) -> f64 {
    let checked = checked(clip);
    let [defect] = checked.defects.as_slice() else { panic!("{kind:?}: {:#?}", checked.defects) };
    println!("{:?}: {}", defect.kind, defect.detail);
    let (first, last) = (*frames.start(), *frames.end());
    assert_eq!((defect.kind, defect.first_frame, defect.frames), (kind, first, last + 1 - first));
    assert!(defect.detail.starts_with("cannot be followed: "), "{}", defect.detail);
    assert!(defect.detail.contains(&format!("frames {first} to {last}")), "{}", defect.detail);
    defect.worst
}

fn joint(name: &str) -> usize {
    JOINTS.iter().position(|joint| *joint == name).unwrap()
}

#[test]
fn built_in_and_imported_clips_have_no_defect() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("builtin.h5");
    let builtin: Vec<ClipSource> = ["walk", "run", "jump", "vertical-jump", "squat", "turn", "jog", "stand"]
        .map(|name| ClipSource::whole(format!("builtin:{name}")))
        .into();
    merge(&builtin, &path, false, |_, _| ()).unwrap();
    for checked in check(&path, &[]).unwrap() {
        assert_eq!(checked.defects, [], "{}", checked.clip);
        let [low, _] = checked.lowest_point.unwrap();
        assert!((-0.005..0.01).contains(&low), "{}: {low}", checked.clip);
    }
    let (run, _) = import(&run_take()).unwrap();
    assert_eq!(check(&written(directory.path(), &run), &[]).unwrap()[0].defects, []);
}

#[test]
fn no_built_in_clip_is_impossible() {
    for name in builtin_names() {
        assert_eq!(checked(&builtin(name)).defects, [], "{name}");
    }
}

#[test]
fn a_body_in_the_air_falls() {
    let height =
        impossible(&lifted(|frame| if (40..60).contains(&frame) { 0.2 } else { 0.0 }), Kind::Floating, 40..=59);
    assert!((0.2..0.21).contains(&height), "{height}");
    // It rises slowly.
    impossible(&lifted(|frame| 0.015 * frame.saturating_sub(10) as f64), Kind::Floating, 14..=119);
    // The Moon's gravity.
    impossible(&lifted(parabola(0.2, 1.62)), Kind::Floating, 33..=60);
    let fall = impossible(&lifted(parabola(0.5, 30.0)), Kind::Fall, 31..=41);
    assert!((29.0..31.0).contains(&fall), "{fall}");
    // A jump of a person who is smaller than the body, and shows more than g.
    assert_eq!(checked(&lifted(parabola(0.5, 1.33 * 9.81))).defects, []);
    // Four frames are too few to tell.
    assert_eq!(checked(&lifted(|frame| if (40..44).contains(&frame) { 0.06 } else { 0.0 })).defects, []);
}

#[test]
fn nobody_jumps_three_metres() {
    let rise = impossible(&lifted(parabola(3.0, 9.81)), Kind::JumpHeight, 31..=81);
    assert!((2.98..=3.0).contains(&rise), "{rise}");
}

#[test]
fn a_body_far_in_the_floor_is_impossible_and_one_on_a_soft_floor_is_not() {
    let sunk = |depth: f64| {
        let mut clip = walk();
        clip.motion.position.iter_mut().for_each(|position| position[2] -= depth);
        clip
    };
    let depth = impossible(&sunk(0.3), Kind::Penetration, 0..=86);
    assert!((0.29..0.31).contains(&depth), "{depth}");
    let [defect] = checked(&sunk(0.05)).defects.try_into().unwrap();
    assert_eq!((defect.kind, defect.detail.contains("cannot be followed")), (Kind::Penetration, false), "{defect:?}");
}

#[test]
fn a_body_that_stands_still_and_leans_falls_over() {
    let leaning = |degrees: f64| posed(degrees, &[]);
    for degrees in [60.0, -60.0] {
        let overhang = impossible(&leaning(degrees), Kind::Unbalanced, 1..=119);
        assert!((0.5..1.0).contains(&overhang), "{overhang}");
    }
    assert_eq!(checked(&leaning(10.0)).defects, []);
    // Who falls over does not keep still.
    let mut falling = leaning(60.0);
    falling.motion.position.iter_mut().enumerate().for_each(|(frame, position)| position[0] += 0.012 * frame as f64);
    assert_eq!(checked(&falling).defects, []);
}

#[test]
fn who_sits_on_a_missing_chair_falls_over() {
    // `stand` leans forwards by 4°. The shins are vertical, the thighs horizontal.
    let sitting = |lean: f64| posed(lean.to_degrees() - 4.0, &[("femurrx", -FRAC_PI_2 - lean), ("tibiarx", FRAC_PI_2)]);
    for (lean, expected) in [(0.0, 0.378), (0.2, 0.325)] {
        let overhang = impossible(&sitting(lean), Kind::Unbalanced, 1..=119);
        assert!((overhang - expected).abs() < 0.005, "{overhang} instead of {expected}");
    }
}

#[test]
fn hard_poses_are_sound() {
    for (pose, clip) in [
        ("supine", posed(-94.0, &[])),
        ("sitting on the floor", posed(-4.0, &[("femurrx", -FRAC_PI_2), ("tibiarx", 0.01)])),
        ("kneeling", posed(-4.0, &[("tibiarx", 1.9)])),
        ("squatting on the toes", posed(25.0, &[("femurrx", -1.9), ("tibiarx", 2.2), ("footrx", 0.3)])),
        (
            "plank on hands and toes",
            posed(66.0, &[("humerusrx", 1.5), ("humerusry", -0.5), ("humerusrz", 0.25), ("footrx", 0.0)]),
        ),
        ("handstand", handstand()),
    ] {
        assert_eq!(checked(&clip).defects, [], "{pose}");
    }
}

#[test]
fn hands_in_the_floor_can_be_followed_and_arms_cannot() {
    let sunk = |depth: f64| {
        let mut clip = handstand();
        clip.motion.position.iter_mut().for_each(|position| position[2] -= depth);
        let [defect] = checked(&clip).defects.try_into().unwrap();
        defect
    };
    let hands = sunk(0.15);
    assert_eq!(
        (hands.kind, hands.frames, hands.detail.as_str()),
        (Kind::Penetration, 120, "0.150 m deep in the floor")
    );
    assert!(hands.item.contains("finger"), "{hands:?}");
    let arms = sunk(0.4);
    assert!(arms.detail.starts_with("cannot be followed: the body goes through the floor"), "{arms:?}");
    assert!((arms.worst - 0.4).abs() < 1e-9 && arms.item.contains("finger"), "{arms:?}");
}

#[test]
fn a_clip_that_never_touches_the_floor_is_told_to_be_lowered() {
    let mut clip = walk();
    let [low, _] = checked(&clip).lowest_point.unwrap();
    clip.motion.position.iter_mut().for_each(|position| position[2] += 0.06 - low);
    let [defect] = checked(&clip).defects.try_into().unwrap();
    assert_eq!((defect.kind, defect.first_frame, defect.frames), (Kind::Floating, 0, clip.steps()));
    let text = "cannot be followed: the clip never touches the floor; lower the clip by 0.060 m, or import it with another \
                --floor";
    assert_eq!(defect.detail, text);
    // Only its end is in the air: the floor is right.
    let detail = &checked(&lifted(|frame| if frame < 60 { 0.0 } else { 0.2 })).defects[0].detail;
    assert!(detail.contains("no force holds the body up"), "{detail}");
    // A fall from a height touches no floor either, and needs no other one.
    let mut fall = lifted(|frame| 2.0 - 9.81 * (0.03 * frame as f64).powi(2) / 2.0);
    let motion = &mut fall.motion;
    for vectors in [&mut motion.position, &mut motion.velocity, &mut motion.angular_velocity] {
        vectors.truncate(20);
    }
    for angles in [&mut motion.joints, &mut motion.joints_velocity] {
        angles.truncate(20);
    }
    motion.quaternion.truncate(20);
    assert_eq!(checked(&fall).defects, []);
}

#[test]
fn a_joint_that_jumps_in_one_frame_can_be_followed() {
    let elbow = |jumps: &[usize]| {
        let mut clip = builtin("stand");
        jumps.iter().for_each(|frame| clip.motion.joints[*frame][joint("lradiusrx")] += 1.5);
        let [defect] = checked(&clip).defects.try_into().unwrap();
        assert_eq!((defect.kind, defect.item.as_str(), defect.frames), (Kind::Jump, "lradiusrx", 2 * jumps.len()));
        defect.detail
    };
    assert_eq!(elbow(&[40]), "50.0 rad/s from one frame to the next");
    assert_eq!(elbow(&[40, 50]), "cannot be followed: 50.0 rad/s from one frame to the next");
    let mut clip = builtin("stand");
    clip.motion.position[40][0] += 1.0;
    let [defect] = checked(&clip).defects.try_into().unwrap();
    assert_eq!(defect.detail, "cannot be followed: 33.3 m/s from one frame to the next");
}

#[test]
fn kinds_have_names_in_json() {
    let names = [Kind::Floating, Kind::Fall, Kind::JumpHeight, Kind::Unbalanced].map(|kind| serde_json::json!(kind));
    assert_eq!(names, ["floating", "fall", "jump_height", "unbalanced"].map(serde_json::Value::from));
}

#[test]
fn clips_that_another_program_made_have_no_defect() {
    let all = check(&recordings("clips.h5"), &[]).unwrap();
    assert_eq!(all.len(), 3);
    for checked in all {
        assert_eq!(checked.defects, [], "{}", checked.clip);
    }
}

#[test]
fn each_defect_is_found_with_its_frames_and_size() {
    let directory = tempfile::tempdir().unwrap();
    let mut clip = walk();
    let steps = clip.steps();
    let knee = joint("ltibiarx");
    for frame in 0..steps {
        let position = &mut clip.motion.position[frame];
        position[2] += match frame {
            0..10 => -0.1,
            50.. => 0.4,
            _ => 0.0,
        };
    }
    clip.motion.joints[20][knee] = 3.2;
    clip.motion.position[30][0] += 5.0;
    let [checked] = check(&written(directory.path(), &clip), &[]).unwrap().try_into().unwrap();
    println!("{:#?}", checked.defects);
    assert_eq!(kinds(&checked), [Kind::JointLimit, Kind::Penetration, Kind::Floating, Kind::Jump]);
    let first = |kind: Kind| checked.defects.iter().find(|defect| defect.kind == kind).unwrap();
    let limit = first(Kind::JointLimit);
    assert_eq!((limit.item.as_str(), limit.frames, limit.first_frame), ("ltibiarx", 1, 20));
    assert!((limit.worst - (3.2 - 2.96706)).abs() < 1e-12);
    let depth = first(Kind::Penetration);
    assert_eq!((depth.frames, depth.first_frame), (10, 0));
    assert!(
        (0.08..0.11).contains(&depth.worst) && (depth.item.contains("foot") || depth.item.contains("toes")),
        "{depth:?}"
    );
    assert_eq!((first(Kind::Floating).frames, first(Kind::Floating).first_frame), (steps - 50, 50));
    let jumps: Vec<_> = checked.defects.iter().filter(|defect| defect.kind == Kind::Jump).collect();
    let places: Vec<_> = jumps.iter().map(|jump| (jump.item.as_str(), jump.frames, jump.first_frame)).collect();
    assert_eq!(places, [("root", 2, 30), ("ltibiarx", 2, 20)]);
}

/// The file has one clip for each defect, with the defect's name.
#[test]
fn a_defective_file_is_searched_to_its_end() {
    let all = check(defects().as_ref(), &[]).unwrap();
    let of = |clip: &str| all.iter().find(|checked| checked.clip == clip).unwrap();
    for (clip, kind, item) in [
        ("joints_missing", Kind::Unreadable, "joints"),
        ("joints_transposed", Kind::Unreadable, "joints"),
        ("velocity_short", Kind::Unreadable, "velocity"),
        ("steps_text", Kind::Unreadable, "attributes"),
        ("dt_nan", Kind::Unreadable, "attributes"),
        ("joints_nan", Kind::NotFinite, "joints"),
        ("center_of_mass_infinite", Kind::NotFinite, "center_of_mass"),
        ("quaternion_zero", Kind::QuaternionNorm, "quaternion"),
        ("body_quaternion_long", Kind::QuaternionNorm, "body_quaternions"),
    ] {
        let found = of(clip).defects.iter().any(|defect| (defect.kind, defect.item.as_str()) == (kind, item));
        assert!(found, "{clip}: {:?}", of(clip).defects);
    }
    let nan = of("joints_nan").defects.iter().find(|defect| defect.kind == Kind::NotFinite).unwrap();
    assert_eq!((nan.frames, nan.first_frame, nan.worst), (1, 1, 1.0));
    assert!(!of("sound_2019").body_checked && of("sound").body_checked);
}

#[test]
fn the_error_of_a_missing_clip_names_the_nearest() {
    let message = check(defects().as_ref(), &["sonud".into()]).unwrap_err().to_string();
    assert!(message.contains("no clip `sonud` (did you mean `sound`"), "{message}");
}
