//! Compares imported recordings of the CMU database with the clips that MuJoCo and dm_control made of them.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use comic_clips::import::{Constants, Floor, Take, import, read_manifest};
use comic_clips::{Catalogue, Clip, Features, Motion};
use comic_experiment::ClipSource;
use support::{recordings, run_take, with_ids};

const TOLERANCE: f64 = 1e-6;

fn difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// The largest difference of each field of the motion.
fn motion_differences(a: &Motion, b: &Motion) -> Vec<(&'static str, f64)> {
    vec![
        ("position", difference(a.position.as_flattened(), b.position.as_flattened())),
        ("quaternion", difference(a.quaternion.as_flattened(), b.quaternion.as_flattened())),
        ("joints", difference(a.joints.as_flattened(), b.joints.as_flattened())),
        ("velocity", difference(a.velocity.as_flattened(), b.velocity.as_flattened())),
        ("angular_velocity", difference(a.angular_velocity.as_flattened(), b.angular_velocity.as_flattened())),
        ("joints_velocity", difference(a.joints_velocity.as_flattened(), b.joints_velocity.as_flattened())),
    ]
}

fn feature_differences(a: &Features, b: &Features) -> Vec<(&'static str, f64)> {
    vec![
        ("center_of_mass", difference(a.center_of_mass.as_flattened(), b.center_of_mass.as_flattened())),
        ("end_effectors", difference(a.end_effectors.as_flattened(), b.end_effectors.as_flattened())),
        ("appendages", difference(a.appendages.as_flattened(), b.appendages.as_flattened())),
        ("body_positions", difference(&a.body_positions, &b.body_positions)),
        ("body_quaternions", difference(&a.body_quaternions, &b.body_quaternions)),
    ]
}

fn assert_near(name: &str, differences: &[(&str, f64)]) {
    println!("{name}: {differences:?}");
    for (field, difference) in differences {
        assert!(*difference <= TOLERANCE, "{name}: {field} differs by {difference}");
    }
}

fn builtin(name: &str) -> Clip {
    Catalogue::open(&[ClipSource::whole(format!("builtin:{name}"))]).unwrap().load(0).unwrap()
}

/// MuJoCo and dm_control made `builtin:run` of the same recording (`data/README.md`).
#[test]
fn the_run_of_subject_2_is_the_built_in_one() {
    let (clip, taken) = import(&run_take()).unwrap();
    assert_near("CMU_002_03", &motion_differences(&clip.motion, &builtin("run").motion));
    assert_eq!((clip.name.as_str(), clip.dt, clip.steps()), ("CMU_002_03", 0.03, 47));
    assert_eq!((taken.frames, taken.notes), (0..173, vec![]));
}

/// Compares every field of every recording in the manifest.
#[test]
fn recordings_become_the_clips_that_mujoco_and_dm_control_made_of_them() {
    let takes = read_manifest(&recordings("manifest.json")).unwrap();
    assert_eq!(takes.len(), 3);
    for take in takes {
        let (clip, _) = import(&take).unwrap();
        let expected = Catalogue::open(&[with_ids(recordings("clips.h5"), &[&take.name])]).unwrap().load(0).unwrap();
        assert_near(&take.name, &motion_differences(&clip.motion, &expected.motion));
        assert_near(&take.name, &feature_differences(&clip.features.unwrap(), &expected.features.unwrap()));
    }
}

#[test]
fn without_constants_soles_and_floor_are_found_and_reported() {
    let (clip, taken) = import(&Take { constants: Constants::default(), ..run_take() }).unwrap();
    println!("{taken}");
    // A person chose these constants from several takes of this subject: 13.5, 12 and a drifting floor.
    for (found, chosen) in taken.sole_degrees.into_iter().zip([13.5, 12.0]) {
        assert!((found - chosen).abs() <= 4.0, "{found} degrees, chosen {chosen}");
    }
    assert_eq!((taken.floor, taken.arm_regularisation), (Floor::DRIFTING, 0.2));
    assert!((taken.scale - 1.2).abs() < 0.15, "{}", taken.scale);
    assert_eq!(clip.steps(), 47);
}

#[test]
fn soles_and_floor_are_found_near_the_constants_that_a_person_chose() {
    for take in read_manifest(&recordings("manifest.json")).unwrap() {
        let chosen = take.constants.clone();
        let (_, taken) = import(&Take { constants: Constants::default(), ..take.clone() }).unwrap();
        println!("{}: found {taken}", take.name);
        assert_eq!(Some(taken.floor), chosen.floor, "{}", take.name);
        for (found, chosen) in taken.sole_degrees.into_iter().zip(chosen.sole_degrees.unwrap()) {
            assert!((found - chosen).abs() <= 5.0, "{}: {found} degrees, chosen {chosen}", take.name);
        }
    }
}
