//! Any BVH file gives its motion, or an error that names file, line and remedy.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::path::PathBuf;

use comic_clips::retarget::{Recorded, RecordedBone, RecordedPose, Role, find_roles, read_bvh};
use comic_clips::spatial::{Quaternion, Vector, about, half_angle_between, multiply, norm, normalize, subtract};
use proptest::prelude::*;
use support::bvh::write_bvh;
use support::{law, places};

/// A hip with a leg that bends, and an arm without channels.
const SMALL: &str = "\
HIERARCHY
ROOT Hips
{
\tOFFSET 0 0 0
\tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
\tJOINT Leg
\t{
\t\tOFFSET 1 -2 0
\t\tCHANNELS 3 Xrotation Yrotation Zrotation
\t\tEnd Site
\t\t{
\t\t\tOFFSET 0 -3 0
\t\t}
\t}
\tJOINT Arm
\t{
\t\tOFFSET 0 4 0
\t}
}
MOTION
Frames: 2
Frame Time: 0.01
0 10 0 0 0 0 0 0 0
1 11 2 90 0 0 0 0 90
";

fn walk() -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "tests", "data", "bvh", "walk.bvh"].iter().collect()
}

/// Reads a text as a file `a.bvh`.
fn read(text: impl AsRef<[u8]>) -> Result<(Recorded, Vec<String>), String> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.bvh");
    std::fs::write(&path, text).unwrap();
    read_bvh(&path).map_err(|error| error.to_string())
}

fn index(recorded: &Recorded, name: &str) -> usize {
    recorded.bones.iter().position(|bone| bone.name == name).unwrap()
}

fn near(a: Vector, b: Vector, tolerance: f64) -> bool {
    norm(&subtract(a, b)) < tolerance
}

#[test]
fn the_places_of_a_real_walk_are_those_of_another_program() {
    let (walk, notes) = read_bvh(&walk()).unwrap();
    assert_eq!((walk.bones.len(), walk.frames.len(), walk.frame_seconds, notes), (23, 120, 0.008333, vec![]));
    // Computed by multiplying matrices in Python.
    for (frame, bone, expected) in [
        (0, "Head", [63.4476, 55.2502, 8.0145]),
        (0, "LeftHand", [76.0128, 39.2972, 13.8412]),
        (0, "RightToeBase", [68.158, 5.7374, 27.5466]),
        (60, "Head", [61.1312, 54.2372, 42.8525]),
        (60, "LeftHand", [74.0887, 34.8656, 36.2068]),
        (60, "RightToeBase", [70.009, 1.1025, 37.5123]),
        (119, "Head", [43.2043, 53.7576, 68.1181]),
        (119, "LeftHand", [43.3064, 37.7117, 82.571]),
        (119, "RightToeBase", [28.1147, 4.9362, 80.8907]),
    ] {
        let place = places(&walk, frame)[index(&walk, bone)];
        assert!(near(place, expected, 1e-3), "{bone} of frame {frame}: {place:?}, expected {expected:?}");
    }
    assert_eq!(walk.bones[index(&walk, "Head")].end, Some([0.0, 4.5275, 0.0]));
    // An end site without length gives no direction.
    assert_eq!(walk.bones[index(&walk, "LeftHand_End")].end, None);
}

#[test]
fn the_roles_of_a_real_walk_are_known() {
    let (walk, _) = read_bvh(&walk()).unwrap();
    let roles = find_roles(&walk);
    roles.check(&walk).unwrap();
    let name = |role| roles.get(role).map(|bone| walk.bones[bone].name.as_str());
    for (role, bone) in [
        (Role::Pelvis, Some("Hips")),
        (Role::Spine, Some("Spine")),
        (Role::Neck, None),
        (Role::Head, Some("Head")),
        (Role::LeftClavicle, Some("LeftShoulder")),
        (Role::RightUpperArm, Some("RightArm")),
        (Role::LeftShin, Some("LeftLeg")),
        (Role::RightToes, Some("RightToeBase")),
    ] {
        assert_eq!(name(role), bone, "{}", role.name());
    }
}

#[test]
fn rotations_are_in_the_order_of_the_channels() {
    let (small, notes) = read(SMALL).unwrap();
    assert_eq!((small.frame_seconds, notes), (0.01, vec![]));
    // The hips turn by 90 degrees about z: x becomes y.
    let moved = places(&small, 1);
    assert!(near(moved[0], [1.0, 11.0, 2.0], 1e-12));
    assert!(near(moved[1], [3.0, 12.0, 2.0], 1e-12), "{:?}", moved[1]);
    let order = "\
HIERARCHY\nROOT A\n{\nOFFSET 0 0 0\nCHANNELS 3 Yrotation Zrotation Xrotation\n}\nMOTION\nFrames: 1\nFrame Time: 1\n10 20 30\n";
    let (turned, _) = read(order).unwrap();
    let [y, z, x] = [10.0, 20.0, 30.0].map(f64::to_radians);
    let expected = multiply(multiply(about(1, y), about(2, z)), about(0, x));
    assert!(half_angle_between(turned.frames[0].rotations[0], expected) < 1e-7);
}

#[test]
fn a_root_without_position_channels_stays_at_its_offset() {
    let text = "HIERARCHY\nROOT A\n{\nOFFSET 1 2 3\nCHANNELS 1 Yposition\n}\nMOTION\nFrames: 1\nFrame Time: 1\n7\n";
    assert_eq!(read(text).unwrap().0.frames[0].position, [1.0, 7.0, 3.0]);
}

#[test]
fn the_way_of_writing_does_not_matter() {
    let (expected, _) = read(SMALL).unwrap();
    for (what, text) in [
        ("lines of Windows", SMALL.replace('\n', "\r\n")),
        ("a byte order mark", format!("\u{feff}{SMALL}")),
        ("spaces", SMALL.replace('\t', "    ")),
        ("braces on the same line", SMALL.replace("\n{", " {").replace("\n\t{", "{")),
        ("empty lines", SMALL.replace('\n', "\n\n")),
        ("exponents", SMALL.replace("-2 0", "-0.2e1 0E+00")),
        ("lower-case channels", SMALL.replace("rotation", "ROTATION").replace("Frame Time", "frame  time")),
        ("a namespace", SMALL.replace("ROOT ", "ROOT mixamorig:").replace("JOINT ", "JOINT a|b:")),
    ] {
        let (read, _) = read(text).unwrap_or_else(|error| panic!("{what}: {error}"));
        assert_eq!(
            format!("{:?}{:?}", read.bones, read.frames),
            format!("{:?}{:?}", expected.bones, expected.frames),
            "{what}"
        );
    }
}

#[test]
fn a_joint_that_moves_gets_its_median_place_and_a_note() {
    let channels = "CHANNELS 3 Xrotation Yrotation Zrotation";
    let placed = SMALL.replace(channels, "CHANNELS 6 Xposition Yposition Zposition Xrotation Yrotation Zrotation");
    let at = |first: &str, second: &str| {
        placed
            .replace("0 0 0 0 0 0 0\n", &format!("0 0 0 0 {first} 0 0 0\n"))
            .replace("90 0 0 0 0 90", &format!("90 0 0 {second} 0 0 90"))
    };
    let (still, notes) = read(at("1 -2 0.5", "1 -2 0.501")).unwrap();
    assert_eq!((still.bones[1].offset, notes), ([1.0, -2.0, 0.501], vec![]));
    let (_, notes) = read(at("1 -2 0.5", "1 -2 0.6")).unwrap();
    assert_eq!(notes, ["`Leg` moves relative to the parent; bones are rigid, so the median place is used"]);
}

/// MotionBuilder writes a root that stands still, or carries the whole person.
#[test]
fn a_root_that_carries_the_moving_hips_is_merged_with_them() {
    let inner: String =
        SMALL.lines().skip(1).take_while(|line| *line != "MOTION").map(|line| format!("{line}\n")).collect();
    let root = "HIERARCHY\nROOT Reference\n{\nOFFSET 0 0 5\nCHANNELS 3 Zrotation Yrotation Xrotation\n";
    let motion = "MOTION\nFrames: 2\nFrame Time: 0.01\n90 0 0 0 10 0 0 0 0 0 0 0\n90 0 0 1 11 2 90 0 0 0 0 90\n";
    let (merged, notes) = read(format!("{root}{}}}\n{motion}", inner.replace("ROOT", "JOINT"))).unwrap();
    assert_eq!(notes, ["`Reference` carries `Hips`, which is the root of the clip"]);
    let names: Vec<&str> = merged.bones.iter().map(|bone| bone.name.as_str()).collect();
    assert_eq!((names, merged.bones[1].parent), (vec!["Hips", "Leg", "Arm"], Some(0)));
    assert!(!merged.rest_in_world, "the carrier turns the rest pose");
    // Hips that stand still do not change what is the root.
    let still = motion.replace("11 2 90", "10 0 0").replace("1 10 0", "0 10 0");
    let (still, _) = read(format!("{root}{}}}\n{still}", inner.replace("ROOT", "JOINT"))).unwrap();
    assert_eq!(still.bones[0].name, "Hips");
    // The frame is that of SMALL, turned by 90 degrees about z and moved by 5.
    assert!(near(merged.frames[1].position, [-11.0, 1.0, 7.0], 1e-12), "{:?}", merged.frames[1].position);
    assert!(near(places(&merged, 1)[1], [-12.0, 3.0, 7.0], 1e-12), "{:?}", places(&merged, 1)[1]);
}

#[test]
fn an_error_names_the_line_and_what_to_do() {
    let changed = |from: &str, to: &str| {
        assert!(SMALL.contains(from), "{from}");
        read(SMALL.replacen(from, to, 1)).map(drop).unwrap_err()
    };
    for (message, expected) in [
        (changed("HIERARCHY", "skin"), "a.bvh:1: expected HIERARCHY: is this a BVH file?"),
        (changed("JOINT Arm", "ROOT Arm"), "a.bvh:15: a second ROOT, `Arm`: a clip has one person"),
        (changed("JOINT Arm", "JOINT"), "a.bvh:15: a joint without a name"),
        (
            changed("JOINT Arm", &format!("JOINT {}", "a".repeat(201))),
            "a.bvh:15: the name of a joint is too long or cannot",
        ),
        (changed("JOINT Arm", "JOINT \u{1b}[31mArm"), "a.bvh:15: the name of a joint is too long or cannot be printed"),
        (changed("JOINT Arm", "\u{1b}[31m Arm"), "a.bvh:15: unknown word `\u{fffd}[31M`"),
        (changed("JOINT Arm", "BONE Arm"), "a.bvh:15: unknown word `BONE`; a hierarchy has ROOT, JOINT"),
        (changed("\t{\n\t\tOFFSET 0 4 0", "\t\tOFFSET 0 4 0"), "a.bvh:16: expected `{` after joint `Arm`"),
        (changed("\t\tOFFSET 0 4 0\n", ""), "a.bvh:17: joint `Arm` has no OFFSET"),
        (changed("OFFSET 0 4 0", "OFFSET 0 4"), "a.bvh:17: OFFSET has 2 numbers, expected 3"),
        (changed("OFFSET 0 4 0", "OFFSET 0 4,0 0"), "`4,0` is not a number; decimals have a point: 0.5"),
        (changed("OFFSET 0 4 0", "OFFSET 0 NaN 0"), "NaN: expected a finite number"),
        (changed("OFFSET 0 4 0", "OFFSET 0 1e9 0"), "1000000000 is too large for a length or angle"),
        (changed("CHANNELS 3", "CHANNELS 4"), "a.bvh:9: CHANNELS 4, but 3 names follow"),
        (changed("3 Xrotation", "3 Wrotation"), "unknown channel `Wrotation`; expected Xposition, Yposition"),
        (changed("6 Xposition", "6 Yposition"), "channel `Yposition` occurs twice in joint `Hips`"),
        (changed("}\nMOTION", "MOTION"), "a.bvh:19: MOTION inside of joint `Hips`: a `}` is missing"),
        (changed("MOTION", "}\nMOTION"), "a.bvh:20: a `}` more than `{`"),
        (changed("Frames: 2", "Frames: x"), "a.bvh:21: Frames: `x`: expected a number of frames"),
        (changed("Frames: 2", "Frames: 0"), "a.bvh:21: Frames: 0: the file has no motion"),
        (
            changed("Frames: 2", "Frames: 999999999"),
            "a.bvh:21: Frames: 999999999: expected at most 360000; cut the file",
        ),
        (changed("Frames: 2", "Frames: 1"), "a.bvh:24: Frames: 1, but the file has more frames; correct the number"),
        (changed("Frames: 2", "Frames: 3"), "Frames: 3, but the file has 2: is it complete? If it is, write Frames: 2"),
        (changed("Frames: 2\n", ""), "a.bvh:21: expected `frames:` and a number; MOTION, `Frames:`"),
        (changed("0.01", "0"), "a.bvh:22: Frame Time: 0: expected seconds from 0.0001 to 1"),
        (changed("0.01", "NaN"), "a.bvh:22: Frame Time: NaN: expected seconds"),
        (changed("0.01", "120"), "write 0.008333 for 120 frames a second"),
        (changed(" 90\n", "\n"), "a.bvh:24: frame 1 has 8 numbers, but the hierarchy has 9 channels"),
        (changed("MOTION", "\n#"), "a.bvh:21: unknown word `#`"),
        (read("").unwrap_err(), "the file is empty; a BVH file begins with HIERARCHY"),
        (read("HIERARCHY\nMOTION\n").unwrap_err(), "a.bvh:2: MOTION without a ROOT before it"),
        (read("HIERARCHY\nROOT a\n{\n").unwrap_err(), "a.bvh:3: the file ends before MOTION: is it complete?"),
        (read("x".repeat(200_000)).unwrap_err(), "a.bvh:1: a line of 131072 bytes or more: is this a BVH file?"),
    ] {
        assert!(message.contains(expected), "{message}\ndoes not contain\n{expected}");
    }
    let message = read_bvh("/no/such.bvh".as_ref()).unwrap_err().to_string();
    assert!(message.starts_with("/no/such.bvh: cannot be read"), "{message}");
}

#[test]
fn a_hierarchy_of_any_depth_ends_with_an_error() {
    let text = format!("HIERARCHY\nROOT a\n{}", "{\nOFFSET 0 0 0\nJOINT a\n".repeat(100_000));
    let message = read(text).unwrap_err();
    assert!(message.ends_with("more than 1000 joints: export the body without its surface"), "{message}");
}

#[test]
fn what_is_written_is_read_again() {
    let (walk, _) = read_bvh(&walk()).unwrap();
    let mut text = Vec::new();
    write_bvh(&walk, &mut text).unwrap();
    let (again, _) = read(&text).unwrap();
    assert_eq!((again.frames.len(), again.frame_seconds), (120, 0.008333));
    for frame in [0, 50, 119] {
        let (places, expected) = (places(&again, frame), places(&walk, frame));
        for (bone, expected) in walk.bones.iter().zip(expected) {
            assert!(near(places[index(&again, &bone.name)], expected, 1e-4), "{} of frame {frame}", bone.name);
        }
    }
}

fn unit() -> impl Strategy<Value = Quaternion> {
    prop::array::uniform4(-1.0..1.0f64).prop_filter("not too short", |q| norm(q) > 0.1).prop_map(normalize)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..law() })]

    #[test]
    fn every_rotation_survives_writing(rotation in unit(), quarter in any::<bool>(), y in -3.0..3.0f64) {
        // Where the middle angle is a quarter turn, the outer angles are not unique.
        let rotation = if quarter { multiply(about(0, std::f64::consts::FRAC_PI_2), about(1, y)) } else { rotation };
        let recorded = Recorded {
            path: PathBuf::new(),
            rest_in_world: true,
            bones: vec![RecordedBone { name: "a b".into(), parent: None, offset: [0.0; 3], end: None }],
            frame_seconds: 0.01,
            frames: vec![RecordedPose { position: [1.0, -2.0, 3.0], rotations: vec![rotation] }],
        };
        let mut text = Vec::new();
        write_bvh(&recorded, &mut text).unwrap();
        let (again, _) = read(&text).unwrap();
        prop_assert!(half_angle_between(again.frames[0].rotations[0], rotation) < 1e-6);
    }

    #[test]
    fn changed_bytes_never_panic(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..20),
        cut in any::<Option<prop::sample::Index>>(),
    ) {
        let mut bytes = SMALL.as_bytes().to_vec();
        for (place, value) in changes {
            let place = place.index(bytes.len());
            bytes[place] = value;
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        if let Ok((recorded, _)) = read(bytes) {
            prop_assert!(recorded.frames.iter().flat_map(|pose| pose.position).all(f64::is_finite));
        }
    }

    /// Some lines of the hierarchy are elsewhere. A few of these files are valid.
    #[test]
    fn moved_lines_never_panic(moves in prop::collection::vec(any::<[prop::sample::Index; 2]>(), 1..6)) {
        let (hierarchy, motion) = SMALL.split_once("MOTION").unwrap();
        let mut lines: Vec<&str> = hierarchy.lines().collect();
        for [from, to] in moves {
            let line = lines.remove(from.index(lines.len()));
            lines.insert(to.index(lines.len() + 1), line);
        }
        match read(format!("{}\nMOTION{motion}", lines.join("\n"))) {
            Ok((recorded, _)) => {
                let mut parents = recorded.bones.iter().enumerate().skip(1);
                prop_assert!(parents.all(|(index, bone)| bone.parent < Some(index)));
            }
            Err(message) => prop_assert!(message.contains("a.bvh:"), "{message}"),
        }
    }
}
