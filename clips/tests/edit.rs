//! Clips that are made of other clips: what they keep, what changes, and by how much.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::path::{Path, PathBuf};

use comic_clips::check::check;
use comic_clips::edit::{join, mirror, rewrite, speed};
use comic_clips::spatial::{add, half_angle_between, norm, normalize, rotated, subtract};
use comic_clips::{
    Catalogue, Clip, ClipWriter, Error, Features, JOINT_RANGES, JOINTS, Motion, WalkerModel, builtin_names, merge,
};
use comic_experiment::ClipSource;
use proptest::prelude::*;
use support::{law, names, whole, with_ids};

const DT: f64 = 0.03;
/// Tracking bodies of each side: legs, then arms; first of the left side, and first of the right side.
const SIDES: [[usize; 3]; 2] = [[0, 5, 5], [17, 24, 7]];
const THORAX: usize = 12;
/// Bodies of the spine by index, and how far each is to the left of the one that carries it, m: 1.2 times the positions in
/// dm_control's `humanoid_CMU_V2020.xml`. All other offsets are symmetric.
const SIDEWAYS: [(usize, f64); 4] = [(11, 0.0006790344), (12, 0.0006150336), (14, -0.003961716), (15, 0.0012021)];
/// Twice the sideways offsets of the thorax and below: the arms are at most this far from their mirror image, m.
const ARMS_MISS: f64 = 2.0 * (0.0006790344 + 0.0006150336);
/// The same of the centre of mass, from all offsets of bodies and of their centres, weighted by mass, m.
const CENTER_MISS: f64 = 2.82e-3;

fn builtin(name: &str) -> Clip {
    Catalogue::open(&[ClipSource::whole(format!("builtin:{name}"))]).unwrap().load(0).unwrap()
}

fn written(directory: &Path, clips: &[Clip]) -> PathBuf {
    let path = directory.join("made.h5");
    let mut writer = ClipWriter::create(&path, true).unwrap();
    clips.iter().for_each(|clip| writer.add(clip).unwrap());
    writer.finish().unwrap();
    path
}

fn joint(name: &str) -> usize {
    JOINTS.iter().position(|joint| *joint == name).unwrap()
}

fn features(clip: &Clip) -> Features {
    clip.features.clone().unwrap_or_else(|| Features::of(&clip.motion))
}

/// A tracking body's index after left and right are exchanged.
fn other(body: usize) -> usize {
    for [left, right, count] in SIDES {
        if (left..left + count).contains(&body) {
            return body + right - left;
        }
        if (right..right + count).contains(&body) {
            return body + left - right;
        }
    }
    body
}

fn places(features: &Features) -> Vec<Vec<[f64; 3]>> {
    features.body_positions.chunks_exact(31 * 3).map(|frame| frame.as_chunks().0.to_vec()).collect()
}

fn orientations(features: &Features) -> Vec<Vec<[f64; 4]>> {
    features.body_quaternions.chunks_exact(31 * 4).map(|frame| frame.as_chunks().0.to_vec()).collect()
}

/// Greatest difference of two lists of numbers.
fn apart(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// A clip with these poses and velocities, all else 0. No angle is beyond what both arms can reach.
fn random_clip() -> impl Strategy<Value = Clip> {
    let pose = || prop::array::uniform32(0.0..1.0f64);
    let frame =
        (pose(), pose(), prop::array::uniform4(-1.0..1.0f64)).prop_filter("no rotation", |(_, _, q)| norm(q) > 0.1);
    prop::collection::vec(frame, 2..8).prop_map(|frames| {
        let mut motion = Motion::default();
        for (low, high, quaternion) in frames {
            let share = |i: usize| if i < 28 { low[i] } else { high[i - 28] };
            motion.joints.push(std::array::from_fn(|i| {
                let [least, most] = JOINT_RANGES[i];
                let most = if JOINTS[i].ends_with("humerusrz") { 1.1 } else { most };
                least + share(i) * (most - least)
            }));
            motion.joints_velocity.push(std::array::from_fn(|i| 20.0 * share(55 - i) - 10.0));
            motion.position.push([low[29], low[30], low[31]]);
            motion.velocity.push([high[29], high[30], high[31]]);
            motion.angular_velocity.push([high[28], low[28], low[27]]);
            motion.quaternion.push(normalize(quaternion));
        }
        Clip { name: "random".into(), made_from: None, model: WalkerModel::Cmu2020, dt: DT, motion, features: None }
    })
}

proptest! {
    #![proptest_config(law())]

    #[test]
    fn mirroring_twice_gives_the_motion_back_bit_for_bit(clip in random_clip()) {
        let (once, fit) = mirror(&clip).unwrap();
        prop_assert_eq!(fit.frames, 0);
        prop_assert_eq!(mirror(&once).unwrap().0.motion, clip.motion);
    }

    #[test]
    fn bodies_of_a_mirrored_motion_are_the_mirror_image_of_the_bodies(clip in random_clip()) {
        let (before, after) = (features(&clip), features(&mirror(&clip).unwrap().0));
        let image = |[x, y, z]: [f64; 3]| [-x, y, z];
        for ((before, places), turned) in places(&before).iter().zip(places(&after)).zip(orientations(&after)) {
            let miss = |body: usize| subtract(places[other(body)], image(before[body]));
            for body in 0..before.len() {
                let expected = match body {
                    ..=10 => [0.0; 3],
                    // From the upper back to the face; each is carried by the one before it.
                    11..=16 => {
                        let sideways = SIDEWAYS.iter().find(|(at, _)| *at == body).map_or(0.0, |(_, offset)| *offset);
                        add(miss(body - 1), rotated(turned[body - 1], [2.0 * sideways, 0.0, 0.0]))
                    }
                    _ => miss(THORAX),
                };
                prop_assert!(apart(&miss(body), &expected) < 1e-9, "body {body}: {:?}, {expected:?}", miss(body));
            }
        }
        for (before, after) in before.end_effectors.iter().zip(&after.end_effectors) {
            let [rradius, lradius, rfoot, lfoot] = [0, 3, 6, 9].map(|at| image(before[at..at + 3].try_into().unwrap()));
            prop_assert!(apart(&after[..6], [lradius, rradius].as_flattened()) < ARMS_MISS);
            prop_assert!(apart(&after[6..], [lfoot, rfoot].as_flattened()) < 1e-9);
        }
        for (before, after) in before.center_of_mass.iter().zip(&after.center_of_mass) {
            prop_assert!(norm(&subtract(image(*before), *after)) < CENTER_MISS);
        }
    }

    #[test]
    fn another_speed_follows_a_parabola_exactly(
        parts in prop::array::uniform3(-0.2..0.2f64), percent in 50usize..=200, steps in 3usize..40
    ) {
        let factor = percent as f64 / 100.0;
        let [at, velocity, acceleration] = parts;
        let value = |t: f64| at + velocity * t + acceleration * t * t;
        let slope = |t: f64| velocity + 2.0 * acceleration * t;
        let knee = joint("lfemurry");
        let mut clip = builtin("stand");
        for (step, (joints, velocity)) in clip.motion.joints.iter_mut().zip(&mut clip.motion.joints_velocity).enumerate() {
            (joints[knee], velocity[knee]) = (value(DT * step as f64), slope(DT * step as f64));
        }
        truncate(&mut clip, steps);
        let made = speed(&clip, factor).unwrap();
        prop_assert_eq!(made.steps(), ((steps - 1) * 100) / percent + 1);
        for (step, (joints, velocity)) in made.motion.joints.iter().zip(&made.motion.joints_velocity).enumerate() {
            let t = factor * DT * step as f64;
            prop_assert!((joints[knee] - value(t)).abs() < 1e-12);
            prop_assert!((velocity[knee] - factor * slope(t)).abs() < 1e-10);
        }
    }

    #[test]
    fn another_speed_stays_in_the_ranges(clip in random_clip(), percent in 50usize..=200) {
        let Ok(made) = speed(&clip, percent as f64 / 100.0) else { return Ok(()) };
        for (angle, [low, high]) in made.motion.joints.iter().flat_map(|joints| joints.iter().zip(JOINT_RANGES)) {
            prop_assert!((low..=high).contains(angle));
        }
        for quaternion in &made.motion.quaternion {
            prop_assert!((norm(quaternion) - 1.0).abs() < 1e-12);
        }
    }
}

fn truncate(clip: &mut Clip, steps: usize) {
    let Motion { position, quaternion, joints, velocity, angular_velocity, joints_velocity } = &mut clip.motion;
    position.truncate(steps);
    quaternion.truncate(steps);
    joints.truncate(steps);
    velocity.truncate(steps);
    angular_velocity.truncate(steps);
    joints_velocity.truncate(steps);
}

/// The greatest difference of a stored joint velocity from the central difference of the angles, rad/s.
fn inconsistency(clip: &Clip) -> f64 {
    let motion = &clip.motion;
    let differences = motion.joints.windows(3).zip(&motion.joints_velocity[1..]).map(|(poses, velocity)| {
        let central: [f64; 56] = std::array::from_fn(|i| (poses[2][i] - poses[0][i]) / (2.0 * clip.dt));
        apart(&central, velocity)
    });
    differences.fold(0.0, f64::max)
}

#[test]
fn velocities_of_a_mirrored_clip_are_the_differences_of_its_poses() {
    for name in builtin_names() {
        let clip = builtin(name);
        let (mirrored, fit) = mirror(&clip).unwrap();
        assert!(inconsistency(&mirrored) < 1e-9, "{name}");
        assert!(fit.wrists < 0.05 && fit.mean_degrees < 2.0, "{name}: {fit:?}");
        let fastest = |clip: &Clip| clip.motion.joints_velocity.iter().flatten().fold(0.0, |most, v| v.abs().max(most));
        assert!(fastest(&mirrored) <= 1.1 * fastest(&clip), "{name}: fitted arms jump");
    }
}

#[test]
fn a_right_arm_takes_the_motion_of_a_left_arm_where_its_range_ends() {
    let (clip, (mirrored, fit)) = (builtin("walk"), mirror(&builtin("walk")).unwrap());
    assert!(fit.frames > 0);
    for (before, after) in clip.motion.joints.iter().zip(&mirrored.motion.joints) {
        assert!(after.iter().zip(JOINT_RANGES).all(|(angle, [low, high])| (low - 1e-9..=high + 1e-9).contains(angle)));
        // Legs, and the left arm, which has the whole range.
        assert_eq!(before[joint("rtibiarx")], after[joint("ltibiarx")]);
        assert_eq!(before[joint("rhumerusrz")], -after[joint("lhumerusrz")]);
    }
}

#[test]
fn edited_clips_have_no_defect() {
    let directory = tempfile::tempdir().unwrap();
    let mut made = Vec::new();
    for name in ["walk", "run", "jump", "squat", "turn", "jog", "stand"] {
        let clip = builtin(name);
        made.extend([mirror(&clip).unwrap().0, speed(&clip, 0.8).unwrap(), speed(&clip, 1.25).unwrap()]);
    }
    made.extend([
        join(&builtin("walk"), &builtin("squat")).unwrap().0,
        join(&builtin("run"), &builtin("turn")).unwrap().0,
    ]);
    for checked in check(&written(directory.path(), &made), &[]).unwrap() {
        let [low, _] = checked.lowest_point.unwrap();
        assert_eq!(checked.defects, [], "{}", checked.clip);
        // The recordings have -0.002.
        assert!(low > -0.007, "{}: {low}", checked.clip);
    }
}

#[test]
fn the_same_speed_is_the_same_motion() {
    for name in builtin_names() {
        assert_eq!(speed(&builtin(name), 1.0).unwrap().motion, builtin(name).motion, "{name}");
    }
}

#[test]
fn twice_the_speed_takes_every_second_frame_and_doubles_velocities() {
    let (clip, fast) = (builtin("walk").motion, speed(&builtin("walk"), 2.0).unwrap());
    assert_eq!((fast.steps(), fast.name.as_str(), fast.dt), (44, "CMU_007_01_x200", DT));
    for step in 0..fast.steps() {
        assert_eq!(fast.motion.position[step], clip.position[2 * step]);
        assert_eq!(fast.motion.quaternion[step], clip.quaternion[2 * step]);
        assert_eq!(fast.motion.joints[step], clip.joints[2 * step]);
        assert_eq!(fast.motion.velocity[step], clip.velocity[2 * step].map(|part| 2.0 * part));
        assert_eq!(fast.motion.angular_velocity[step], clip.angular_velocity[2 * step].map(|part| 2.0 * part));
        assert_eq!(fast.motion.joints_velocity[step], clip.joints_velocity[2 * step].map(|part| 2.0 * part));
    }
}

#[test]
fn between_two_frames_the_root_is_on_the_path_of_the_recording() {
    // Half as many frames at double speed, then the old speed: the frames between are interpolated.
    for name in ["walk", "turn", "run", "jump"] {
        let clip = builtin(name);
        let back = speed(&speed(&clip, 2.0).unwrap(), 0.5).unwrap().motion;
        for step in 0..back.position.len() {
            assert!(norm(&subtract(back.position[step], clip.motion.position[step])) < 0.005, "{name} {step}");
            assert!(half_angle_between(back.quaternion[step], clip.motion.quaternion[step]) < 0.03, "{name} {step}");
            assert!(norm(&subtract(back.velocity[step], clip.motion.velocity[step])) < 0.15, "{name} {step}");
            let turning = subtract(back.angular_velocity[step], clip.motion.angular_velocity[step]);
            assert!(norm(&turning) < 1.0, "{name} {step}: {turning:?}");
        }
    }
}

#[test]
fn a_joined_clip_has_the_legs_of_one_and_the_arms_of_the_other() {
    let (legs, upper) = (builtin("walk"), builtin("squat"));
    let (joined, _) = join(&legs, &upper).unwrap();
    assert_eq!(joined.steps(), legs.steps());
    assert_eq!(joined.name, "CMU_007_01_join_CMU_013_30");
    assert_eq!(joined.motion.position, legs.motion.position);
    assert_eq!(joined.motion.angular_velocity, legs.motion.angular_velocity);
    let (leg, arm) = (0..joint("lowerbackrz"), joint("thoraxrz")..56);
    for step in 0..joined.steps() {
        assert_eq!(joined.motion.joints[step][leg.clone()], legs.motion.joints[step][leg.clone()]);
        assert_eq!(joined.motion.joints_velocity[step][leg.clone()], legs.motion.joints_velocity[step][leg.clone()]);
        assert_eq!(joined.motion.joints[step][arm.clone()], upper.motion.joints[step][arm.clone()]);
        assert_eq!(joined.motion.joints_velocity[step][arm.clone()], upper.motion.joints_velocity[step][arm.clone()]);
    }
    assert!(inconsistency(&joined) < 1e-9);
}

#[test]
fn a_joined_clip_is_balanced_like_its_legs() {
    for legs in ["walk", "run", "squat", "turn", "stand"] {
        for upper in ["walk", "jog", "squat", "vertical-jump", "turn"] {
            let (one, other) = (builtin(legs), builtin(upper));
            let (joined, balance) = join(&one, &other).unwrap();
            let wanted = features(&one).center_of_mass;
            let far = |clip: &Clip| {
                let pairs = features(clip)
                    .center_of_mass
                    .into_iter()
                    .zip(&wanted)
                    .map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]));
                pairs.fold(0.0, f64::max)
            };
            assert!((far(&joined) - balance.after[1]).abs() < 1e-9, "{legs}, {upper}");
            let ([mean, most], lean) = (balance.after, balance.lean_degrees);
            assert!(mean < 0.0012 && most < 0.004, "{legs}, {upper}: {balance:?}");
            assert!(balance.before[1] < 0.05 && lean < 8.0, "{legs}, {upper}: {balance:?}");
        }
    }
}

#[test]
fn a_clip_joined_with_itself_is_the_same() {
    for name in ["walk", "jump", "turn"] {
        let (joined, balance) = join(&builtin(name), &builtin(name)).unwrap();
        assert!(balance.before[1] < 1e-12 && balance.lean_degrees < 1e-6);
        assert!(apart(joined.motion.joints.as_flattened(), builtin(name).motion.joints.as_flattened()) < 1e-9);
    }
}

#[test]
fn a_file_says_what_a_clip_was_made_from_and_merging_keeps_it() {
    let directory = tempfile::tempdir().unwrap();
    let slow = speed(&builtin("walk"), 0.8).unwrap();
    let mirrored = mirror(&slow).unwrap().0;
    let joined = join(&mirrored, &builtin("run")).unwrap().0;
    let path = written(directory.path(), &[slow, mirrored, joined, builtin("walk")]);
    let merged = directory.path().join("merged.h5");
    merge(&[whole(&path)], &merged, false, |_, _| ()).unwrap();
    for path in [path, merged] {
        let catalogue = Catalogue::open(&[whole(&path)]).unwrap();
        assert_eq!(
            names(&catalogue),
            ["CMU_007_01", "CMU_007_01_x80", "CMU_007_01_x80_mirror", "CMU_007_01_x80_mirror_join_CMU_002_03"]
        );
        let made = catalogue.entries().iter().map(|entry| entry.made_from.as_deref()).collect::<Vec<_>>();
        let expected = [
            None,
            Some("speed 0.8 CMU_007_01"),
            Some("mirror (speed 0.8 CMU_007_01)"),
            Some("join (mirror (speed 0.8 CMU_007_01)) CMU_002_03"),
        ];
        assert_eq!(made, expected);
        assert_eq!(catalogue.load(2).unwrap().made_from, catalogue.entries()[2].made_from);
    }
}

#[test]
fn copies_are_written_with_or_without_their_originals() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("copies.h5");
    let sources = [ClipSource::whole("builtin:walk"), ClipSource::whole("builtin:stand")];
    let mirrored = |clip: &Clip, writer: &mut ClipWriter| writer.add(&mirror(clip)?.0);
    assert_eq!(rewrite(&sources, &path, false, false, mirrored).unwrap(), 2);
    assert_eq!(names(&Catalogue::open(&[whole(&path)]).unwrap()), ["CMU_007_01_mirror", "stand_mirror"]);
    assert!(matches!(rewrite(&sources, &path, false, true, mirrored), Err(Error::Exists { .. })));
    assert_eq!(rewrite(&sources, &path, true, true, mirrored).unwrap(), 4);
    let catalogue = Catalogue::open(&[with_ids(&path, &["stand", "stand_mirror"])]).unwrap();
    assert_eq!(catalogue.load(0).unwrap().motion.joints.len(), catalogue.load(1).unwrap().steps());

    let broken = |clip: &Clip, writer: &mut ClipWriter| writer.add(&speed(clip, 7.0)?);
    let absent = directory.path().join("absent.h5");
    assert!(rewrite(&sources, &absent, false, false, broken).is_err());
    assert!(!absent.exists());
}

#[test]
fn clips_that_cannot_be_edited_are_refused() {
    let walk = builtin("walk");
    let changed = |change: &dyn Fn(&mut Clip)| {
        let mut clip = walk.clone();
        change(&mut clip);
        clip
    };
    let refused = [
        ("0 frames", changed(&|clip| clip.motion = Motion::default())),
        ("1 frames", changed(&|clip| truncate(clip, 1))),
        ("number of frames", changed(&|clip| clip.motion.joints.truncate(5))),
        ("number of frames", changed(&|clip| clip.motion.joints_velocity.clear())),
        ("NaN", changed(&|clip| clip.motion.joints[3][4] = f64::NAN)),
        ("NaN", changed(&|clip| clip.motion.angular_velocity[3][0] = f64::INFINITY)),
        ("dt", changed(&|clip| clip.dt = 0.0)),
        ("dt", changed(&|clip| clip.dt = f64::NAN)),
        ("V2019", changed(&|clip| clip.model = WalkerModel::Cmu2019)),
    ];
    for (reason, clip) in &refused {
        let errors = [
            mirror(clip).map(drop).unwrap_err(),
            speed(clip, 0.8).map(drop).unwrap_err(),
            join(clip, &walk).map(drop).unwrap_err(),
            join(&walk, clip).map(drop).unwrap_err(),
        ];
        for error in errors.map(|error| error.to_string()) {
            assert!(error.starts_with("clip `CMU_007_01`") && error.contains(reason), "{reason}: {error}");
        }
    }
    let slower = changed(&|clip| clip.dt = 0.05);
    assert!(matches!(join(&walk, &slower), Err(Error::WrongTimestep { dt: 0.05, .. })));
    let two = changed(&|clip| truncate(clip, 2));
    assert!(matches!(speed(&two, 2.0), Err(Error::Edit { .. })));
    assert_eq!(speed(&two, 0.5).unwrap().steps(), 3);
    for factor in [0.0, 0.49, 2.01, 0.805, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(speed(&walk, factor), Err(Error::Constant { .. })), "{factor}");
    }
    // Large numbers are finite, and give a clip or an error, never a panic.
    let huge = changed(&|clip| clip.motion.joints.as_flattened_mut().fill(1e300));
    drop((mirror(&huge), speed(&huge, 0.8), join(&huge, &walk)));
}

#[test]
fn a_name_that_is_too_long_for_a_copy_is_refused() {
    let named = |length: usize| Clip { name: "n".repeat(length), ..builtin("stand") };
    assert_eq!(mirror(&named(193)).unwrap().0.name.len(), 200);
    assert_eq!(speed(&named(196), 0.8).unwrap().name.len(), 200);
    assert_eq!(join(&named(100), &named(94)).unwrap().0.name.len(), 200);
    let long = [mirror(&named(194)).map(drop), speed(&named(197), 0.8).map(drop)];
    for error in long.map(|made| made.unwrap_err()) {
        assert!(matches!(error, Error::Edit { .. }), "{error}");
        assert!(
            error.to_string().contains("its name is too long: the name of the new clip would have 201 bytes"),
            "{error}"
        );
    }
    let message = join(&named(100), &named(95)).unwrap_err().to_string();
    assert!(message.contains("the names of the sources are too long together"), "{message}");
    assert!(message.ends_with("would have 201 bytes, but 200 is the most; use clips with shorter names"), "{message}");
}
