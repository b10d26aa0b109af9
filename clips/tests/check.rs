//! The check finds every defect of a file, and none in a sound one.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::path::{Path, PathBuf};

use comic_clips::check::{Checked, Kind, check};
use comic_clips::import::import;
use comic_clips::{Catalogue, Clip, ClipWriter, JOINTS, merge};
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

fn walk() -> Clip {
    Catalogue::open(&[ClipSource::whole("builtin:walk")]).unwrap().load(0).unwrap()
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
