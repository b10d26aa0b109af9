//! Every message names the file, the item and the remedy.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use comic_clips::{Catalogue, Error};
use comic_experiment::ClipSource;
use support::{defects, load_one, refused, tiny, whole, with_ids};

/// Asserts that loading the clip gives the error of its defect, with this text.
fn assert_defect(clip: &str, item: &str, reason: &str) {
    let error = load_one(&defects(), clip).unwrap_err();
    assert!(matches!(error, Error::Malformed { .. }), "{clip}: {error}");
    assert_eq!(error.to_string(), format!("{}: /{clip}{item}: {reason}", defects()));
}

#[test]
fn the_sound_clip_is_sound() {
    assert_eq!(load_one(&defects(), "sound").unwrap().steps(), 3);
}

#[test]
fn missing_items_are_named() {
    let missing = "missing; every clip of dm_control's layout has it";
    assert_defect("joints_missing", "/walkers/walker_0/joints", missing);
    assert_defect("walker_missing", "/walkers/walker_0", missing);
    assert_defect("dt_missing", "@dt", missing);
}

#[test]
fn wrong_shapes_are_named_with_the_expected_ones() {
    let expected = |shape: &str, width: usize| {
        format!(
            "has shape {shape}, expected [{width}, 3]: {width} numbers for each of num_steps frames of the CMU \
             humanoid V2020"
        )
    };
    let walker = "/walkers/walker_0";
    assert_defect("joints_transposed", &format!("{walker}/joints"), &expected("[3, 56]", 56));
    assert_defect("joints_narrow", &format!("{walker}/joints"), &expected("[55, 3]", 56));
    assert_defect("position_flat", &format!("{walker}/position"), &expected("[9]", 3));
    assert_defect("velocity_short", &format!("{walker}/velocity"), &expected("[3, 2]", 3));
    assert_defect("bodies_of_2019", &format!("{walker}/body_positions"), &expected("[90, 3]", 93));
    let error = load_one(&defects(), "steps_many").unwrap_err().to_string();
    assert!(error.contains("/steps_many/walkers/walker_0/position: has shape [3, 3], expected [3, 4]"), "{error}");
}

#[test]
fn numbers_that_are_not_finite_or_of_another_type() {
    let walker = "/walkers/walker_0";
    assert_defect("joints_nan", &format!("{walker}/joints"), "NaN in row 5, frame 1; every number must be finite");
    let place = format!("{walker}/center_of_mass");
    assert_defect("center_of_mass_infinite", &place, "inf in row 2, frame 2; every number must be finite");
    let place = format!("{walker}/quaternion");
    assert_defect("quaternion_zero", &place, "a quaternion of frame 1 has norm 0, expected 1");
    let place = format!("{walker}/body_quaternions");
    assert_defect("body_quaternion_long", &place, "a quaternion of frame 2 has norm 2, expected 1");
    let error = load_one(&defects(), "joints_integers").unwrap_err().to_string();
    assert!(error.contains("/joints_integers/walkers/walker_0/joints: type mismatch"), "{error}");
}

#[test]
fn wrong_attributes_are_named() {
    for (clip, number) in [("dt_zero", "0"), ("dt_nan", "NaN"), ("dt_huge", "30")] {
        assert_defect(clip, "@dt", &format!("{number} s is not a valid time step; dm_control uses 0.03 s"));
    }
    assert_defect("steps_zero", "@num_steps", "0 frames; a clip must have 1 to 100000");
    assert_defect("steps_negative", "@num_steps", "-3 is not a valid count");
    assert_defect("steps_huge", "@num_steps", "9223372036854776000 is not a valid count");
    let unknown = "unknown body 2; expected 1 (CMU humanoid V2019) or 4 (CMU humanoid V2020)";
    assert_defect("model_unknown", "/walkers/walker_0@model", unknown);
}

#[test]
fn a_defect_in_the_attributes_is_found_when_the_file_is_opened() {
    let message = refused(with_ids(defects(), &["sound", "model_unknown"]));
    assert!(message.contains("/model_unknown/walkers/walker_0@model: unknown body 2"), "{message}");
}

#[test]
fn the_error_of_a_missing_clip_names_the_nearest() {
    let message = refused(with_ids(tiny(), &["TINY_001_03"]));
    assert_eq!(message, format!("{}: no clip `TINY_001_03` (did you mean `TINY_001_01` or `TINY_001_02`?)", tiny()));
    let message = refused(with_ids(tiny(), &["zebra"]));
    assert_eq!(message, format!("{}: no clip `zebra`; it has TINY_001_01, TINY_001_02", tiny()));
    assert!(refused(with_ids(tiny(), &["TINY_001_01/walkers"])).contains("no clip `TINY_001_01/walkers`"));
    assert!(refused(with_ids(defects(), &["no_clip"])).contains("no clip `no_clip`"), "a dataset is no clip");
}

#[test]
fn a_clip_that_is_listed_twice_is_refused() {
    let message = refused(with_ids(tiny(), &["TINY_001_01", "TINY_001_02", "TINY_001_01"]));
    assert_eq!(message, format!("{}: clip `TINY_001_01` is listed twice; set weight to use it more often", tiny()));
}

#[test]
fn the_error_of_a_missing_file_names_the_nearest() {
    let missing = tiny().replace("tiny.h5", "tinny.h5");
    assert_eq!(refused(whole(&missing)), format!("no clip file `{missing}` (did you mean `tiny.h5`?)"));
    assert_eq!(
        refused(whole("/nowhere/at/all.h5")),
        "no clip file `/nowhere/at/all.h5`; name an HDF5 file in dm_control's layout, or builtin:NAME"
    );
}

#[test]
fn a_file_that_is_not_hdf5_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("text.h5");
    std::fs::write(&path, "walk this way\n".repeat(100)).unwrap();
    assert_eq!(refused(whole(&path)), format!("{}: /: not an HDF5 file", path.display()));
    std::fs::write(&path, "").unwrap();
    assert!(refused(whole(&path)).starts_with(&format!("{}: /: ", path.display())));
    let message = refused(whole(directory.path()));
    assert!(message.starts_with(&format!("{}: cannot be read: ", directory.path().display())), "{message}");
}

#[test]
fn sub_ranges_outside_the_clip_are_refused() {
    let range = |start_step, end_step| ClipSource { start_step, end_step, ..with_ids(tiny(), &["TINY_001_02"]) };
    assert_eq!(refused(range(9, None)), "clip `TINY_001_02`: start_step = 9: must be at most 8; the clip has 9 frames");
    for end in [0, 4, 10, usize::MAX] {
        assert_eq!(
            refused(range(4, Some(end))),
            format!("clip `TINY_001_02`: end_step = {end}: must be 5 to 9; the clip has 9 frames")
        );
    }
    for end in [5, 8, 9] {
        assert!(Catalogue::open(&[range(4, Some(end))]).is_ok());
    }
}

#[test]
fn negative_or_infinite_weights_are_refused() {
    for weight in [-1.0, f64::NAN, f64::INFINITY] {
        let message = refused(ClipSource { weight, ..ClipSource::whole("builtin:walk") });
        assert!(
            message.starts_with(&format!("builtin:walk: weight = {weight}: must be a finite number, 0 or more")),
            "{message}"
        );
    }
}

#[test]
fn sources_without_any_weight_are_refused() {
    let expected = "clips: no source with a weight above 0; name a file or a built-in clip";
    assert_eq!(Catalogue::open(&[]).unwrap_err().to_string(), expected);
    let never = |name| ClipSource { weight: 0.0, ..ClipSource::whole(name) };
    assert_eq!(refused(never("builtin:walk")), expected);
    // As in dm_control, a clip may have weight 0, so that it is never drawn.
    assert!(Catalogue::open(&[never("builtin:walk"), ClipSource::whole("builtin:run")]).is_ok());
}
