//! The built-in clips.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::collections::BTreeMap;

use comic_clips::{BUILTIN_TERMS, Catalogue, Clip, JOINT_RANGES, Motion, WalkerModel, builtin_names};
use comic_experiment::ClipSource;
use sha2::{Digest as _, Sha256};
use support::{names, recordings, refused, with_ids};

fn load(name: &str) -> Clip {
    Catalogue::open(&[ClipSource::whole(format!("builtin:{name}"))]).unwrap().load(0).unwrap()
}

#[test]
fn every_name_loads_a_v2020_clip_of_unit_quaternions_within_the_joint_ranges() {
    for name in builtin_names() {
        let clip = load(name);
        assert_eq!((clip.model, clip.dt, clip.features.is_none()), (WalkerModel::Cmu2020, 0.03, true), "{name}");
        assert!(clip.steps() >= 40, "{name}");
        let motion = &clip.motion;
        for quaternion in &motion.quaternion {
            assert!((quaternion.iter().map(|part| part * part).sum::<f64>() - 1.0).abs() < 1e-12, "{name}");
        }
        for pose in &motion.joints {
            for (angle, [low, high]) in pose.iter().zip(JOINT_RANGES) {
                assert!((low..=high).contains(angle), "{name}: {angle} is not in [{low}, {high}]");
            }
        }
        let lengths = [motion.quaternion.len(), motion.joints.len(), motion.velocity.len()];
        assert_eq!(lengths, [clip.steps(); 3], "{name}");
        assert_eq!([motion.angular_velocity.len(), motion.joints_velocity.len()], [clip.steps(); 2], "{name}");
    }
}

#[test]
fn there_are_walks_a_run_a_jump_squats_and_a_turn() {
    for (alias, own) in [
        ("walk", "CMU_007_01"),
        ("brisk-walk", "CMU_002_02"),
        ("run", "CMU_002_03"),
        ("jump", "CMU_013_39"),
        ("squat", "CMU_013_30"),
        ("turn", "CMU_086_09_a"),
    ] {
        assert_eq!(load(alias), load(own));
        let catalogue = Catalogue::open(&[ClipSource::whole(format!("builtin:{alias}"))]).unwrap();
        assert_eq!(names(&catalogue), [own], "an alias is listed by the clip's own name");
    }
}

#[test]
fn the_motions_match_their_names() {
    let forward = |name: &str| {
        let clip = load(name);
        let (first, last) = (clip.motion.position[0], clip.motion.position[clip.steps() - 1]);
        f64::hypot(last[0] - first[0], last[1] - first[1]) / (clip.dt * clip.steps() as f64)
    };
    assert!((0.8..2.0).contains(&forward("walk")), "{}", forward("walk"));
    assert!(forward("run") > 2.0, "{}", forward("run"));
    assert_eq!(forward("stand"), 0.0);
    let lowest = load("squat").motion.position.iter().map(|root| root[2]).fold(f64::INFINITY, f64::min);
    assert!(lowest < 0.8, "a squat must lower the root, which is at least at {lowest} m");
}

#[test]
fn stand_is_motionless_and_upright() {
    let clip = load("stand");
    assert_eq!((clip.name.as_str(), clip.steps()), ("stand", 120));
    let motion = &clip.motion;
    assert!(motion.joints.windows(2).all(|pair| pair[0] == pair[1]));
    assert!(motion.velocity.iter().chain(&motion.angular_velocity).flatten().all(|speed| *speed == 0.0));
    assert!(motion.joints_velocity.iter().flatten().all(|speed| *speed == 0.0));
    // The world z component of the root's y axis, which points up the spine.
    let [w, x, y, z] = motion.quaternion[0];
    let up = 2.0 * (y * z + w * x);
    assert!((up - 4.0_f64.to_radians().cos()).abs() < 1e-12, "{up}");
    let forward = 2.0 * (x * y - w * z);
    assert!((forward - 4.0_f64.to_radians().sin()).abs() < 1e-12, "leans towards +x: {forward}");
}

/// SHA-256 of all arrays of a motion, as `data/make_recordings.py` computes it.
fn hash(motion: &Motion) -> String {
    let arrays = [
        motion.position.as_flattened(),
        motion.quaternion.as_flattened(),
        motion.joints.as_flattened(),
        motion.velocity.as_flattened(),
        motion.angular_velocity.as_flattened(),
        motion.joints_velocity.as_flattened(),
    ];
    let bytes: Vec<u8> = arrays.into_iter().flatten().flat_map(|number| number.to_le_bytes()).collect();
    format!("{:x}", Sha256::digest(bytes))
}

#[test]
fn recorded_motion_is_bit_for_bit_the_motion_that_dm_control_computed() {
    let text = std::fs::read_to_string(recordings("motion.json")).unwrap();
    let expected: BTreeMap<String, String> = serde_json::from_str(&text).unwrap();
    let recorded = builtin_names().into_iter().filter(|name| name.starts_with("CMU_"));
    let found: BTreeMap<String, String> = recorded.map(|name| (name.into(), hash(&load(name).motion))).collect();
    assert_eq!(found.len(), 11);
    assert_eq!(found, expected);
}

#[test]
fn the_data_has_its_provenance_and_acknowledgement() {
    let manifest = include_str!("../data/builtin.json");
    for name in builtin_names().into_iter().filter(|name| name.starts_with("CMU_")) {
        assert!(manifest.contains(&format!("\"key\": \"{name}\"")), "{name}");
    }
    let readme = include_str!("../data/README.md");
    assert!(readme.contains(
        "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from \
         NSF EIA-0196217."
    ));
    assert!(include_bytes!("../data/builtin.bin").len() < 3_000_000);
}

#[test]
fn the_error_of_an_unknown_name_lists_the_nearest_and_all_names() {
    let message = refused(ClipSource::whole("builtin:walking"));
    assert!(
        message.starts_with("no built-in clip `walking` (did you mean `walk`?); built-in clips are stand, walk, "),
        "{message}"
    );
    let message = refused(ClipSource::whole("builtin:cmu_007_02"));
    assert!(message.contains("did you mean `CMU_007_01`, `CMU_007_04` or `CMU_002_02`?"), "{message}");
    let message = refused(ClipSource::whole("builtin:"));
    assert!(message.starts_with("no built-in clip ``; built-in clips are stand, "), "{message}");
}

#[test]
fn a_builtin_clip_takes_neither_subset_nor_ids() {
    let source = ClipSource { subset: Some("walk_tiny".into()), ..ClipSource::whole("builtin:walk") };
    assert_eq!(refused(source), "builtin:walk: a built-in clip is a single clip and has neither subset nor ids");
    let message = refused(with_ids("builtin:walk", &["CMU_007_01"]));
    assert!(message.contains("neither subset nor ids"), "{message}");
}

#[test]
fn a_builtin_clip_named_without_its_prefix_is_recognised() {
    assert_eq!(refused(ClipSource::whole("walk")), "no clip file `walk` (did you mean `builtin:walk`?)");
}

#[test]
fn the_terms_are_those_of_the_notice() {
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(words(include_str!("../../NOTICE")).contains(&words(BUILTIN_TERMS)));
}
