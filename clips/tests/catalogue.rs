//! From sources to entries and clips.

mod support;

use comic_clips::edit::mirror;
use comic_clips::{Catalogue, ClipWriter, Error, Features, WalkerModel, pose_to_action};
use comic_experiment::{ClipSource, Experiment, resolve};
use hdf5_pure::{AttrValue, File};
use support::{defects, golden, names, recordings, refused, tiny, wheel_clips, whole, with_ids};

#[test]
fn a_whole_file_gives_all_its_clips_sorted_by_name() {
    let catalogue = Catalogue::open(&[whole(tiny())]).unwrap();
    assert_eq!(names(&catalogue), ["TINY_001_01", "TINY_001_02"]);
    let first = &catalogue.entries()[0];
    assert_eq!((first.steps, first.dt, first.model), (12, 0.03, WalkerModel::Cmu2020));
    assert_eq!((first.start_step, first.end_step, first.weight), (0, None, 1.0));
}

#[test]
fn sources_keep_their_order_and_ids_are_sorted_within_one() {
    let sources = [
        with_ids(tiny(), &["TINY_001_02", "TINY_001_01"]),
        ClipSource { weight: 2.5, start_step: 10, end_step: Some(40), ..ClipSource::whole("builtin:walk") },
        ClipSource::whole("builtin:stand"),
        with_ids(tiny(), &["TINY_001_02"]),
    ];
    let catalogue = Catalogue::open(&sources).unwrap();
    assert_eq!(names(&catalogue), ["TINY_001_01", "TINY_001_02", "CMU_007_01", "stand", "TINY_001_02"]);
    let walk = &catalogue.entries()[2];
    assert_eq!((walk.steps, walk.start_step, walk.end_step, walk.weight), (87, 10, Some(40), 2.5));
    assert_eq!(catalogue.load(1).unwrap(), catalogue.load(4).unwrap());
    assert_eq!(catalogue.load(5).unwrap_err().to_string(), "no clip with index 5; the experiment has 5 clips");
}

#[test]
fn a_clip_has_one_entry_per_frame_in_every_field() {
    let clip = Catalogue::open(&[whole(tiny())]).unwrap().load(1).unwrap();
    assert_eq!((clip.name.as_str(), clip.steps()), ("TINY_001_02", 9));
    let motion = &clip.motion;
    let lengths = [&motion.position, &motion.velocity, &motion.angular_velocity].map(Vec::len);
    assert_eq!(lengths, [9; 3]);
    assert_eq!([motion.quaternion.len(), motion.joints.len(), motion.joints_velocity.len()], [9; 3]);
    let Features { center_of_mass, end_effectors, appendages, body_positions, body_quaternions } =
        clip.features.unwrap();
    assert_eq!([center_of_mass.len(), end_effectors.len(), appendages.len()], [9; 3]);
    assert_eq!([body_positions.len(), body_quaternions.len()], [9 * 31 * 3, 9 * 31 * 4]);
}

/// A file stores an array as [feature, frame], a clip stores it as [frame, feature]; a wrong transpose breaks this relation.
#[test]
fn frames_of_a_file_are_its_columns() {
    let clip = Catalogue::open(&[with_ids(recordings("clips.h5"), &["CMU_007_01"])]).unwrap().load(0).unwrap();
    let features = clip.features.as_ref().unwrap();
    for step in 0..clip.steps() {
        // The first tracking body, lhipjoint, hangs rigidly on the root.
        let (root, body) = (clip.motion.position[step], &features.body_positions[step * 93..step * 93 + 3]);
        let distance = root.iter().zip(body).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(distance < 1e-6, "lhipjoint lies on the root: {distance} m apart in frame {step}");
        assert_eq!(features.end_effectors[step], features.appendages[step][..12], "frame {step}");
    }
}

#[test]
fn the_test_clips_of_dm_control_open() {
    let catalogue = Catalogue::open(&[whole(wheel_clips())]).unwrap();
    assert_eq!(names(&catalogue), ["cmuv2019_001", "cmuv2019_002"]);
    for (index, entry) in catalogue.entries().iter().enumerate() {
        assert_eq!((entry.model, entry.dt, entry.steps), (WalkerModel::Cmu2019, 0.05, 10));
        let features = catalogue.load(index).unwrap().features.unwrap();
        assert_eq!((features.body_positions.len(), features.body_quaternions.len()), (900, 1200));
    }
}

#[test]
fn clips_that_a_script_wrote_with_h5py_open() {
    let catalogue = Catalogue::open(&[whole(golden("synthetic_v2020.h5"))]).unwrap();
    assert_eq!(names(&catalogue), ["DRAWN_001_01", "DRAWN_002_01"]);
    assert_eq!([0, 1].map(|index| catalogue.load(index).unwrap().steps()), [40, 40]);
}

#[test]
fn opening_reads_only_the_attributes_of_the_chosen_clips() {
    // Nearly every clip of this file is defective. Clips that are not chosen, or not loaded, give no error.
    let catalogue = Catalogue::open(&[with_ids(defects(), &["sound", "joints_missing", "sound_2019"])]).unwrap();
    assert_eq!(names(&catalogue), ["joints_missing", "sound", "sound_2019"]);
    assert!(catalogue.load(0).is_err());
    assert_eq!(catalogue.load(1).unwrap().steps(), 3);
    assert_eq!(catalogue.load(2).unwrap().model, WalkerModel::Cmu2019);
}

#[test]
fn a_subset_is_chosen_from_a_file_and_missing_clips_are_counted() {
    let source = ClipSource { subset: Some("get_up".into()), ..whole(tiny()) };
    assert_eq!(
        refused(source),
        format!(
            "{}: 7 of the 7 clips of subset `get_up` are missing: CMU_139_16, CMU_139_17, CMU_139_18, CMU_140_01, \
             CMU_140_02, …; list the ids you have, or get the whole file",
            tiny()
        )
    );
}

#[test]
fn ids_beside_a_subset_choose_from_it() {
    let source =
        |subset: &str, id: &str| ClipSource { subset: Some(subset.into()), ..with_ids(recordings("clips.h5"), &[id]) };
    assert_eq!(names(&Catalogue::open(&[source("all", "CMU_007_01")]).unwrap()), ["CMU_007_01"]);
    let message = refused(source("get_up", "CMU_007_01"));
    assert!(message.contains("clip `CMU_007_01` is not in subset `get_up`"), "{message}");
}

#[test]
fn a_catalogue_finds_files_through_the_callers_function() {
    let sources = [with_ids("motion.h5", &["TINY_001_01"]), ClipSource::whole("builtin:stand")];
    let catalogue = Catalogue::open_with(&sources, |source| (source == "motion.h5").then(|| tiny().into())).unwrap();
    assert_eq!(names(&catalogue), ["TINY_001_01", "stand"]);
    assert_eq!(catalogue.assets(None).unwrap()[0].source, "motion.h5");
    let message = Catalogue::open_with(&sources, |_| None).unwrap_err().to_string();
    assert_eq!(message, "no clip file `motion.h5`; there is no local copy of it");
}

#[test]
fn assets_are_the_files_each_hashed_once() {
    let sources =
        [with_ids(tiny(), &["TINY_001_01"]), ClipSource::whole("builtin:walk"), with_ids(tiny(), &["TINY_001_02"])];
    let assets = Catalogue::open(&sources).unwrap().assets(None).unwrap();
    let bytes = std::fs::read(tiny()).unwrap();
    assert_eq!(assets.len(), 1);
    assert_eq!((assets[0].source.clone(), assets[0].size), (tiny(), bytes.len() as u64));
    assert_eq!(assets[0].sha256[..], *<sha2::Sha256 as sha2::Digest>::digest(bytes));
    assert!(Catalogue::open(&[ClipSource::whole("builtin:walk")]).unwrap().assets(None).unwrap().is_empty());
}

#[test]
fn the_mean_action_is_the_mean_over_frames_in_use_by_weight() {
    let source = |name: &str, weight, end| ClipSource {
        weight,
        start_step: 2,
        end_step: Some(end),
        ..with_ids(tiny(), &[name])
    };
    let catalogue = Catalogue::open(&[source("TINY_001_01", 3.0, 5), source("TINY_001_02", 1.0, 9)]).unwrap();
    let mut expected = [0.0; 56];
    // dm_control's slices: 2..=5 are four frames. The end step 9 is the second clip's end, so seven frames are left.
    for (index, weight, frames) in [(0, 3.0, 2..6), (1, 1.0, 2..9)] {
        for pose in &catalogue.load(index).unwrap().motion.joints[frames] {
            for (sum, action) in expected.iter_mut().zip(pose_to_action(pose)) {
                *sum += weight * action / (3.0 * 4.0 + 7.0);
            }
        }
    }
    for (mean, expected) in catalogue.mean_action().unwrap().iter().zip(expected) {
        assert!((mean - expected).abs() < 1e-12);
    }
}

#[test]
fn a_catalogue_is_shared_between_threads() {
    fn shared<T: Send + Sync>() {}
    shared::<Catalogue>();
    let catalogue = Catalogue::open(&[whole(tiny())]).unwrap();
    let expected = catalogue.load(0).unwrap();
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| assert_eq!(catalogue.load(0).unwrap(), expected));
        }
    });
}

#[test]
fn originals_are_the_clips_that_were_not_made_from_others() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("copies.h5");
    let mut writer = ClipWriter::create(&path, false).unwrap();
    let walk = Catalogue::open(&[ClipSource::whole("builtin:walk")]).unwrap().load(0).unwrap();
    let mut copy = mirror(&walk).unwrap().0;
    // The file's first clip is the copy.
    copy.name = "A_mirror".into();
    writer.add(&copy).unwrap();
    writer.add(&walk).unwrap();
    writer.finish().unwrap();

    let sources = [whole(&path), ClipSource::whole("builtin:stand")];
    let open = |sources: &[ClipSource]| Catalogue::open(sources).unwrap();
    assert_eq!(names(&open(&sources)), ["A_mirror", "CMU_007_01", "stand"]);
    let originals = open(&sources).originals().unwrap();
    assert_eq!(names(&originals), ["CMU_007_01", "stand"]);
    for (index, entry) in originals.entries().iter().enumerate() {
        assert_eq!(originals.load(index).unwrap().name, entry.name);
    }

    let copies = [with_ids(&path, &["A_mirror"]), ClipSource { weight: 0.0, ..ClipSource::whole("builtin:stand") }];
    for left in [&copies[..1], &copies] {
        let error = open(left).originals().unwrap_err();
        assert!(matches!(error, Error::NoOriginals), "{error}");
    }

    // Only an evaluation of a task that follows clips needs originals.
    let experiment = |preset: &str| -> Experiment { resolve(preset, &[]).unwrap() };
    for (preset, follows) in [("tracking-mlp", true), ("joint-get-up", true), ("get-up", false)] {
        let (some, none) = (open(&sources), open(&copies[..1]));
        let some = some.for_evaluation(&experiment(preset), true).unwrap();
        assert_eq!(some.entries().len(), if follows { 2 } else { 3 }, "{preset}");
        assert_eq!(none.for_evaluation(&experiment(preset), true).is_err(), follows, "{preset}");
        let all = open(&sources).for_evaluation(&experiment(preset), false).unwrap();
        assert_eq!(all.entries().len(), 3, "{preset}");
    }
}

#[test]
fn what_a_clip_was_made_from_is_a_short_text_or_an_error() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hostile.h5");
    let opened = |made_from: AttrValue| {
        let file = File::create(&path).unwrap();
        let group = file.root().create_group_with("walk", |clip| {
            clip.set_attr("dt", AttrValue::F64(0.03)).set_attr("num_steps", AttrValue::I64(3));
            clip.set_attr("made_from", made_from);
            clip.create_group_with("walkers", |walkers| {
                walkers.create_group_with("walker_0", |walker| {
                    walker.set_attr("model", AttrValue::I64(4));
                });
            });
        });
        group.unwrap();
        file.close().unwrap();
        Catalogue::open(&[whole(&path)])
    };
    let longest = "mirror ".repeat(1000)[..4096].to_string();
    for (text, expected) in [("", None), ("mirror a", Some("mirror a")), (&longest, Some(longest.as_str()))] {
        let catalogue = opened(AttrValue::String(text.into())).unwrap();
        assert_eq!(catalogue.entries()[0].made_from.as_deref(), expected);
    }
    let two = || vec!["mirror a".to_string(), "mirror b".into()];
    let refused = [
        AttrValue::String("m".repeat(4097)),
        AttrValue::String("mirror \u{1b}[2J".into()),
        AttrValue::String("mirror\na".into()),
        AttrValue::String("mirror \u{9b}2J".into()),
        AttrValue::I64(7),
        AttrValue::F64Array(vec![1.0, 2.0]),
        AttrValue::StringArray(two()),
        AttrValue::AsciiStringArray(two()),
    ];
    let rule = "must be a text of at most 4096 bytes without control characters; remove the attribute";
    for value in refused {
        let message = opened(value).unwrap_err().to_string();
        assert_eq!(message, format!("{}: /walk@made_from: {rule}", path.display()));
    }
}
