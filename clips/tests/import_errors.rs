//! Any ASF or AMC file gives a clip or an error that names file, line and remedy.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::path::Path;

use comic_clips::import::{Constants, Take, import, read_manifest};
use proptest::prelude::*;
use support::{law, run_take};

/// Imports the run with changed files.
fn changed(directory: &Path, asf: impl Fn(String) -> String, amc: impl Fn(String) -> String) -> Result<(), String> {
    let take = run_take();
    let read = |path: &Path| std::fs::read_to_string(path).unwrap().replace("\r\n", "\n");
    let paths = ["s.asf", "m.amc"].map(|name| directory.join(name));
    std::fs::write(&paths[0], asf(read(&take.asf))).unwrap();
    std::fs::write(&paths[1], amc(read(&take.amc))).unwrap();
    let [asf, amc] = paths;
    import(&Take { asf, amc, ..take }).map(drop).map_err(|error| error.to_string())
}

fn same(text: String) -> String {
    text
}

#[test]
fn a_bad_line_is_named_with_its_number_and_what_it_should_be() {
    let directory = tempfile::tempdir().unwrap();
    let amc = |from: &'static str, to: &'static str| {
        changed(directory.path(), same, |text| text.replacen(from, to, 1)).unwrap_err()
    };
    let asf = |from: &'static str, to: &'static str| {
        changed(directory.path(), |text| text.replacen(from, to, 1), same).unwrap_err()
    };
    for (message, expected) in [
        (amc("\nlowerback ", "\nlowerback NaN "), "m.amc:6: lowerback has 4 numbers, expected 3"),
        (amc("\nrradius ", "\nrradius x"), "is not a number"),
        (amc("\nrradius ", "\nrradius 1e99\nrradius "), "is too large for a length or angle of a recording"),
        (amc("\nrradius ", "\nrtail "), "unknown bone `rtail`; CMU's skeletons have lowerback, upperback"),
        (amc("\nroot ", "\nrtoes 0\n#root "), "frame 1 has no `root`"),
        (amc(":DEGREES", ":RADIANS"), "m.amc:3: angles must be in degrees"),
        (amc("\n1\n", "\n"), "expected the number of a frame: is this an AMC file?"),
        (asf("angle deg", "angle rad"), "s.asf:8: angles must be in degrees: `angle deg`"),
        (asf("dof rx ry rz", "dof rz ry rx"), "bone lfemur: has dof `rz ry rx`, expected `rx ry rz`"),
        (
            asf("axis 0 0 20", "axis 0 0 30"),
            "which differs from the body's; only skeletons of the CMU database can be imported",
        ),
        (asf("name lfemur", "name lthigh"), "bone lthigh: moves (rx ry rz), but the body has no joint for it"),
        (asf("TX TY TZ RX RY RZ", "RX RY RZ TX TY TZ"), "expected `TX TY TZ RX RY RZ`"),
        (asf("length 0.45", "length 0"), "0 is not a valid length"),
    ] {
        assert!(message.contains(expected), "{message}\ndoes not contain\n{expected}");
    }
}

#[test]
fn a_truncated_recording_is_recognised_by_its_missing_bones() {
    let directory = tempfile::tempdir().unwrap();
    let cut = |text: String| text[..text.rfind("\nlfemur").unwrap() + 1].to_string();
    let message = changed(directory.path(), same, cut).unwrap_err();
    assert!(message.contains("has other bones than the first frame (they differ in lfemur"), "{message}");
    assert!(message.ends_with("is the file complete?"), "{message}");
}

#[test]
fn a_file_of_another_kind_is_recognised() {
    let directory = tempfile::tempdir().unwrap();
    let message = changed(directory.path(), |_| String::new(), same).unwrap_err();
    assert!(message.ends_with("s.asf: no `length` under `:units`: is this an ASF file?"), "{message}");
    let message = changed(directory.path(), same, |_| String::new()).unwrap_err();
    assert!(message.ends_with("m.amc: no frames: is this an AMC file?"), "{message}");
    let message = changed(directory.path(), same, |_| "x".repeat(5000)).unwrap_err();
    assert!(message.ends_with("m.amc:1: a line of 4096 bytes or more: is this a text file?"), "{message}");
    let take = Take { asf: "/no/such.asf".into(), ..run_take() };
    assert!(import(&take).unwrap_err().to_string().starts_with("/no/such.asf: cannot be read"));
}

#[test]
fn constants_out_of_bounds_are_refused() {
    let refused = |constants: Constants| import(&Take { constants, ..run_take() }).unwrap_err().to_string();
    let message = refused(Constants { scale: Some(f64::NAN), ..Constants::default() });
    assert_eq!(message, "scale NaN: expected a number from 0.01 to 100");
    let message = refused(Constants { sole_degrees: Some([0.0, 91.0]), ..Constants::default() });
    assert_eq!(message, "sole pitch 91: expected degrees from -90 to 90");
    for frames in [170..173, 500..600] {
        let message = refused(Constants { frames: Some(frames), ..Constants::default() });
        assert!(message.contains("of 173 are too few: a clip needs at least 5 frames"), "{message}");
    }
}

#[test]
fn a_gap_in_the_frame_numbers_is_a_note() {
    let directory = tempfile::tempdir().unwrap();
    let take = run_take();
    let amc = directory.path().join("m.amc");
    std::fs::write(&amc, std::fs::read_to_string(&take.amc).unwrap().replacen("\r\n7\r\n", "\r\n8\r\n", 1)).unwrap();
    let (_, taken) = import(&Take { amc, ..take }).unwrap();
    assert!(taken.notes[0].starts_with("frame 8 of "), "{:?}", taken.notes);
}

#[test]
fn the_error_of_a_malformed_manifest_names_the_place() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("manifest.json");
    std::fs::write(&path, "[\n {\"key\": \"A\", \"asf\": \"a.asf\"}\n]").unwrap();
    let message = read_manifest(&path).unwrap_err().to_string();
    assert!(message.contains("not a manifest: missing field `amc` at line 2"), "{message}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..law() })]

    #[test]
    fn changed_bytes_never_panic(
        asf in any::<bool>(),
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..40),
    ) {
        let take = run_take();
        let directory = tempfile::tempdir().unwrap();
        let changed = directory.path().join("changed");
        // Some frames are enough, since every frame is read alike.
        let mut bytes = std::fs::read(if asf { &take.asf } else { &take.amc }).unwrap();
        bytes.truncate(30_000);
        for (place, value) in changes {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        std::fs::write(&changed, bytes).unwrap();
        let constants = Constants::default();
        let take = if asf { Take { asf: changed, constants, ..take } } else { Take { amc: changed, constants, ..take } };
        if let Ok((clip, _)) = import(&take) {
            prop_assert!(clip.motion.joints_velocity.iter().flatten().all(|speed| speed.is_finite()));
        }
    }

    #[test]
    fn extreme_numbers_never_panic(numbers in proptest::collection::vec(-1e6..1e6, 62 * 6)) {
        let directory = tempfile::tempdir().unwrap();
        let mut text = String::new();
        for (frame, numbers) in numbers.chunks(62).enumerate() {
            let part = |range: std::ops::Range<usize>| {
                numbers[range].iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
            };
            let lines = [("root", 0..6), ("rhumerus", 6..9), ("lhumerus", 9..12), ("rclavicle", 12..14), ("lfoot", 14..16)];
            text += &format!("{}\n", frame + 1);
            for (bone, range) in lines {
                text += &format!("{bone} {}\n", part(range));
            }
        }
        let amc = directory.path().join("m.amc");
        std::fs::write(&amc, text).unwrap();
        let (clip, _) = import(&Take { amc, constants: Constants::default(), ..run_take() }).unwrap();
        prop_assert!(clip.features.unwrap().body_positions.iter().all(|place| place.is_finite()));
    }
}
