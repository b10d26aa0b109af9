//! Recordings in AMASS's layout give a skeleton of average proportions, or an error that names file, array and remedy.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::f64::consts::FRAC_PI_2;
use std::path::{Path, PathBuf};

use comic_clips::retarget::{Recorded, Role, find_roles, read_smpl};
use comic_clips::spatial::{Vector, norm, subtract};
use npyz::npz::NpzWriter;
use npyz::{Order, WriterBuilder as _};
use proptest::prelude::*;
use support::{law, places};
use zip::CompressionMethod;
use zip::write::FileOptions;

/// Frames of the recordings that the tests make.
const FRAMES: usize = 60;
/// The person's stature, m.
const STATURE: f64 = 1.82;

/// A file in the making.
struct Recording {
    order: Order,
    compression: CompressionMethod,
    /// Name, shape and numbers, row by row.
    arrays: Vec<(&'static str, Vec<usize>, Vec<f64>)>,
}

impl Recording {
    /// A person faces −y, stands with `bend` = 0, and bends both knees by twice that angle (rad) with level soles.
    fn of(bend: impl Fn(usize) -> f64) -> Self {
        let (mut poses, mut trans) = (Vec::new(), Vec::new());
        for frame in 0..FRAMES {
            let mut pose = [0.0; 156];
            let angle = bend(frame);
            // The root turns y to z. Hips, knees and ankles turn about x.
            pose[0] = FRAC_PI_2;
            for (joint, turn) in
                [(1, -angle), (2, -angle), (4, 2.0 * angle), (5, 2.0 * angle), (7, -angle), (8, -angle)]
            {
                pose[3 * joint] = turn;
            }
            poses.extend(pose);
            trans.extend([0.5, 2.0, height(angle)]);
        }
        let arrays = vec![
            ("poses", vec![FRAMES, 156], poses),
            ("trans", vec![FRAMES, 3], trans),
            ("mocap_framerate", vec![], vec![120.0]),
        ];
        Self { order: Order::C, compression: CompressionMethod::Deflated, arrays }
    }

    fn squat() -> Self {
        Self::of(bend)
    }

    fn array(&mut self, name: &str) -> &mut (&'static str, Vec<usize>, Vec<f64>) {
        self.arrays.iter_mut().find(|(key, ..)| *key == name).unwrap()
    }

    fn write(&self, path: &Path) {
        let mut file = NpzWriter::create(path).unwrap();
        for (name, shape, numbers) in &self.arrays {
            let options = FileOptions::default().compression_method(self.compression);
            let shape: Vec<u64> = shape.iter().map(|length| *length as u64).collect();
            let array = file.array::<f64>(name, options).unwrap().default_dtype().order(self.order).shape(&shape);
            let mut array = array.begin_nd().unwrap();
            match (self.order, shape.as_slice()) {
                (Order::Fortran, [rows, columns]) => {
                    let entries = (0..*columns).flat_map(|column| (0..*rows).map(move |row| row * columns + column));
                    array.extend(entries.map(|entry| numbers[entry as usize])).unwrap();
                }
                _ => array.extend(numbers.iter().copied()).unwrap(),
            }
            array.finish().unwrap();
        }
    }

    fn read(&self) -> Result<(Recorded, Vec<String>), String> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.npz");
        self.write(&path);
        read_smpl(&path).map_err(|error| error.to_string())
    }
}

/// Bends and stretches the knees once.
fn bend(frame: usize) -> f64 {
    0.8 * (std::f64::consts::PI * frame as f64 / FRAMES as f64).sin()
}

/// Height of the pelvis up to a constant, m. Thigh and shin are 0.245 and 0.246 of the stature.
fn height(bend: f64) -> f64 {
    0.3 + STATURE * (0.245 + 0.246) * bend.cos()
}

fn near(a: Vector, b: Vector, tolerance: f64) -> bool {
    norm(&subtract(a, b)) < tolerance
}

/// Everything that the retargeting reads.
fn content(recorded: &Recorded) -> String {
    format!("{:?} {:?} {}", recorded.bones, recorded.frames, recorded.frame_seconds)
}

#[test]
fn joints_are_where_the_angles_put_them() {
    let (squat, notes) = Recording::squat().read().unwrap();
    assert_eq!(notes, ["stature 1.82 m, at which the feet stay on one floor; proportions are average"]);
    assert_eq!((squat.bones.len(), squat.frames.len(), squat.frame_seconds), (22, FRAMES, 1.0 / 120.0));
    for frame in [0, 20, 30] {
        let (sin, cos) = bend(frame).sin_cos();
        let joints = places(&squat, frame);
        let place = |name: &str| joints[squat.bones.iter().position(|bone| bone.name == name).unwrap()];
        assert!(near(place("pelvis"), [0.5, 2.0, height(bend(frame))], 1e-9));
        // The left is x, and the knees are in front of the hips, at −y.
        let thigh = subtract(place("left_knee"), place("left_hip"));
        assert!(near(thigh, [0.0, -STATURE * 0.245 * sin, -STATURE * 0.245 * cos], 1e-9), "{thigh:?}");
        let shin = subtract(place("right_ankle"), place("right_knee"));
        assert!(near(shin, [0.0, STATURE * 0.246 * sin, -STATURE * 0.246 * cos], 1e-9), "{shin:?}");
        // The soles are level: the ball is in front of the ankle.
        let foot = subtract(place("left_foot"), place("left_ankle"));
        assert!(near(foot, [0.0, -STATURE * 0.076, -STATURE * 0.024], 1e-9), "{foot:?}");
        // The arms are stretched to the sides.
        let arm = subtract(place("left_wrist"), place("left_shoulder"));
        assert!(near(arm, [STATURE * (0.186 + 0.146), 0.0, 0.0], 1e-9), "{arm:?}");
        let ankles = (place("left_ankle")[2], place("right_ankle")[2]);
        let standing = height(0.0) - STATURE * (0.0405 + 0.491);
        assert!((ankles.0 - standing).abs() < 1e-9 && (ankles.1 - standing).abs() < 1e-9, "{ankles:?}");
    }
}

/// SMPL has no bone for the fingers, and one for the neck.
#[test]
fn every_other_role_has_a_joint() {
    let (squat, _) = Recording::squat().read().unwrap();
    let roles = find_roles(&squat);
    roles.check(&squat).unwrap();
    let without: Vec<&str> = Role::all().filter(|role| roles.get(*role).is_none()).map(Role::name).collect();
    assert_eq!(without, ["upper_neck", "left_fingers", "right_fingers"]);
}

#[test]
fn a_person_in_the_rest_pose_has_the_stature() {
    let (standing, _) = Recording::of(|_| 0.0).read().unwrap();
    let joints = places(&standing, 0);
    let head = standing.bones.iter().position(|bone| bone.name == "head").unwrap();
    let top = joints[head][2] + standing.bones[head].end.unwrap()[1];
    let sole = joints[7][2] - 0.039 * 1.7;
    assert!((top - sole - 1.7).abs() < 1e-9, "{}", top - sole);
}

#[test]
fn a_motion_with_straight_legs_gets_the_average_stature() {
    let (_, notes) = Recording::of(|frame| 0.1 * bend(frame)).read().unwrap();
    assert_eq!(notes, ["stature 1.70 m and proportions are assumed: the legs bend too little to find it"]);
}

#[test]
fn jumps_do_not_change_the_stature() {
    let mut jumping = Recording::squat();
    let (_, _, trans) = jumping.array("trans");
    for frame in 20..30 {
        trans[3 * frame + 2] += 0.4;
    }
    let (_, notes) = jumping.read().unwrap();
    assert!(notes[0].starts_with("stature 1.82 m"), "{notes:?}");
}

#[test]
fn feet_that_are_not_on_one_floor_do_not_give_the_stature() {
    let mut climbing = Recording::squat();
    let (_, _, trans) = climbing.array("trans");
    for frame in 0..FRAMES {
        trans[3 * frame + 2] += 0.02 * frame as f64;
    }
    let (_, notes) = climbing.read().unwrap();
    assert!(notes[0].starts_with("stature 1.70 m and proportions are assumed: the feet are on one floor"), "{notes:?}");
}

#[test]
fn the_layout_of_the_file_does_not_matter() {
    let expected = content(&Recording::squat().read().unwrap().0);
    let fortran = Recording { order: Order::Fortran, ..Recording::squat() };
    let stored = Recording { compression: CompressionMethod::Stored, ..Recording::squat() };
    let mut rate = Recording::squat();
    rate.array("mocap_framerate").0 = "mocap_frame_rate";
    // SMPL has 72 columns, SMPL-X 165.
    let with_columns = |columns: usize| {
        let mut other = Recording::squat();
        let (_, shape, numbers) = other.array("poses");
        let rows =
            numbers.chunks(156).flat_map(|row| (0..columns).map(|column| row.get(column).copied().unwrap_or(0.5)));
        (shape[1], *numbers) = (columns, rows.collect());
        other
    };
    let mut split = Recording::squat();
    let (_, _, poses) = split.arrays.remove(0);
    let part = |range: std::ops::Range<usize>| poses.chunks(156).flat_map(|row| row[range.clone()].to_vec()).collect();
    split.arrays.push(("root_orient", vec![FRAMES, 3], part(0..3)));
    split.arrays.push(("pose_body", vec![FRAMES, 63], part(3..66)));
    for (what, recording) in [
        ("Fortran order", fortran),
        ("not compressed", stored),
        ("another name of the rate", rate),
        ("SMPL", with_columns(72)),
        ("SMPL-X", with_columns(165)),
        ("root and body apart", split),
    ] {
        assert_eq!(content(&recording.read().unwrap().0), expected, "{what}");
    }
}

#[test]
fn the_shape_of_the_body_is_not_used_and_that_is_said() {
    let mut shaped = Recording::squat();
    shaped.arrays.push(("betas", vec![16], vec![0.5; 16]));
    let (_, notes) = shaped.read().unwrap();
    assert_eq!(notes[1], "betas not used: only SMPL's body model could interpret it");
}

#[test]
fn an_error_names_the_array_and_what_to_do() {
    let changed = |change: &dyn Fn(&mut Recording)| {
        let mut recording = Recording::squat();
        change(&mut recording);
        recording.read().map(drop).unwrap_err()
    };
    let reshaped = |name: &'static str, shape: &[usize]| {
        changed(&|recording| {
            let (_, old, numbers) = recording.array(name);
            *old = shape.to_vec();
            numbers.resize(shape.iter().product(), 0.0);
        })
    };
    for (message, expected) in [
        (
            changed(&|all| all.arrays.truncate(1)),
            "`trans`: not in the file, which has poses; a motion of AMASS has poses",
        ),
        (changed(&|all| all.arrays.truncate(2)), "`mocap_framerate` or `mocap_frame_rate` or `fps`: not in the file"),
        (
            changed(&|all| all.arrays.clear()),
            "`poses` or `root_orient` and `pose_body`: not in the file, which has no arrays",
        ),
        (reshaped("poses", &[FRAMES, 60]), "`poses`: has shape [60, 60], expected (frames, 66 or more)"),
        (reshaped("poses", &[FRAMES * 156]), "`poses`: has shape [9360], expected (frames, 66 or more)"),
        (reshaped("poses", &[0, 156]), "`poses`: has no frames"),
        (reshaped("trans", &[FRAMES - 1, 3]), "`trans`: has 59 frames, but the poses have 60"),
        (reshaped("mocap_framerate", &[2]), "`mocap_framerate`: has shape [2], expected one number"),
        (
            changed(&|all| all.array("mocap_framerate").2[0] = 0.0),
            "`mocap_framerate`: is 0, expected frames per second",
        ),
        (changed(&|all| all.array("poses").2[156 * 3 + 7] = f64::NAN), "`poses`: is NaN in frame 3, column 7"),
        (
            changed(&|all| all.array("trans").2[2] = 1e30),
            "`trans`: is 1000000000000000000000000000000 in frame 0, column 2",
        ),
    ] {
        assert!(message.contains(expected), "{message}\ndoes not contain\n{expected}");
    }
}

/// Writes an archive with one array `poses` of these bytes, and returns the message of the error.
fn refused(bytes: &[u8]) -> String {
    use std::io::Write as _;
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.npz");
    let mut file = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
    file.start_file("poses.npy", FileOptions::default().compression_method(CompressionMethod::Deflated)).unwrap();
    file.write_all(bytes).unwrap();
    file.finish().unwrap();
    drop(file);
    read_smpl(&path).unwrap_err().to_string()
}

fn npy(header: &str, data: &[u8]) -> Vec<u8> {
    let length = u16::try_from(header.len()).unwrap().to_le_bytes();
    [b"\x93NUMPY\x01\x00", length.as_slice(), header.as_bytes(), data].concat()
}

#[test]
fn a_hostile_array_is_refused_before_memory_is_used() {
    let huge = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 156), }";
    let wide = "{'descr': '<f8', 'fortran_order': False, 'shape': (10, 1000000000000), }";
    let object = "{'descr': '|O', 'fortran_order': False, 'shape': (10, 156), }";
    let deep = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {}", "(".repeat(60_000));
    let short = "{'descr': '<f4', 'fortran_order': False, 'shape': (10, 156), }";
    for (message, expected) in [
        (refused(&npy(huge, &[])), "has 1000000000000 frames, expected at most 360000; cut the recording"),
        (refused(&npy(wide, &[])), "has shape [10, 1000000000000], expected (frames, 66 or more)"),
        (refused(&npy(object, &[0; 100])), "has type |O, expected <f4 or <f8: convert it with astype(\"<f8\")"),
        (refused(&npy(&deep, &[])), "has a header with an invalid shape"),
        (refused(&npy(short, &[0; 100])), "ends too early"),
        (refused(&npy(short, &[0; 10 * 156 * 4 - 1])), "ends too early"),
        (refused(&npy(short, &[0; 10 * 156 * 4 + 1])), "is followed by other data"),
        (refused(b"\x93NUMPY\x02\x00\xff\xff\xff\xff"), "has a header of 4294967295 bytes, expected at most 65536"),
        (refused(&npy("{}", &[])), "has a header without descr"),
        (refused(b"pickle"), "has a header that cannot be read"),
        (refused(b"no array at all"), "is not an array of NumPy"),
    ] {
        assert!(
            message.contains(expected) && message.contains("a.npz: `poses`: "),
            "{message}\ndoes not contain\n{expected}"
        );
    }
}

#[test]
fn a_damaged_array_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.npz");
    Recording { compression: CompressionMethod::Stored, ..Recording::squat() }.write(&path);
    let mut bytes = std::fs::read(&path).unwrap();
    // The last digits of a number of `poses`.
    bytes[8 * 1000] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let message = read_smpl(&path).unwrap_err().to_string();
    assert!(message.contains("`poses`: is damaged"), "{message}");
}

#[test]
fn an_archive_is_refused_before_the_library_trusts_it() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.npz");
    let read = || read_smpl(&path).unwrap_err().to_string();
    let mut file = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
    for array in 0..100 {
        file.start_file(format!("{array}\u{1b}{}.npy", "a".repeat(1000)), FileOptions::default()).unwrap();
    }
    file.finish().unwrap();
    drop(file);
    let message = read();
    assert!(message.contains("not in the file, which has 0a") && !message.contains('\u{1b}'), "{message}");
    assert!(message.len() < 5000, "{}", message.len());

    // The end of an archive: 65,534 entries on this disk and in all.
    let record = [b"PK\x05\x06\0\0\0\0\xfe\xff\xfe\xff".as_slice(), &[0; 10]].concat();
    std::fs::write(&path, [vec![0; 100_000], record.clone()].concat()).unwrap();
    assert!(read().contains("a.npz: more than 100 arrays"), "{}", read());
    // The number of entries of ZIP64 can have eight bytes.
    let locator = [b"PK\x06\x07".as_slice(), &[0; 16]].concat();
    let none = [b"PK\x05\x06".as_slice(), &[0; 18]].concat();
    std::fs::write(&path, [locator, none].concat()).unwrap();
    assert!(read().contains("a.npz: more than 100 arrays"), "{}", read());
    // A file without blocks on the disk.
    std::fs::File::create(&path).unwrap().set_len((1 << 30) + 1).unwrap();
    assert!(read().contains("1073741825 bytes, expected at most 1073741824"), "{}", read());
}

#[test]
fn a_file_of_another_kind_is_recognised() {
    let message = read_smpl("/no/such.npz".as_ref()).unwrap_err().to_string();
    assert!(message.starts_with("/no/such.npz: cannot be read"), "{message}");
    let file: PathBuf = [env!("CARGO_MANIFEST_DIR"), "Cargo.toml"].iter().collect();
    let message = read_smpl(&file).unwrap_err().to_string();
    assert!(
        message.contains("not an .npz file") && message.contains("a recording of AMASS is an .npz file"),
        "{message}"
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..law() })]

    #[test]
    fn changed_bytes_never_panic(changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..20)) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.npz");
        Recording { compression: CompressionMethod::Stored, ..Recording::squat() }.write(&path);
        let mut bytes = std::fs::read(&path).unwrap();
        // Most bytes are numbers of `poses`; its header and the other arrays are where something can go wrong.
        let (poses, rest) = (200, bytes.len() - 2500);
        for (place, value) in changes {
            let place = place.index(poses + 2500);
            bytes[if place < poses { place } else { rest + place - poses }] = value;
        }
        std::fs::write(&path, bytes).unwrap();
        if let Ok((recorded, _)) = read_smpl(&path) {
            prop_assert!(recorded.frames.iter().flat_map(|pose| pose.position).all(f64::is_finite));
        }
    }
}
