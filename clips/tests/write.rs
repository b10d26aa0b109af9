//! Reads back the files that it writes. In `tests/tests/clips_in_dm_control.rs` dm_control reads such files.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

mod support;

use std::path::Path;

use comic_clips::{Catalogue, Clip, ClipWriter, Error, Features, Motion, merge, subsets_with};
use comic_experiment::ClipSource;
use support::{names, tiny, whole, with_ids};

fn clips() -> Vec<Clip> {
    let catalogue = Catalogue::open(&[whole(tiny())]).unwrap();
    (0..2).map(|index| catalogue.load(index).unwrap()).collect()
}

fn files_in(directory: &Path) -> usize {
    std::fs::read_dir(directory).unwrap().count()
}

#[test]
fn clips_are_read_back_bit_for_bit() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("out.h5");
    let mut writer = ClipWriter::create(&path, false).unwrap();
    for clip in clips() {
        writer.add(&clip).unwrap();
    }
    writer.finish().unwrap();
    let catalogue = Catalogue::open(&[whole(&path)]).unwrap();
    assert_eq!(names(&catalogue), ["TINY_001_01", "TINY_001_02"]);
    for (index, clip) in clips().into_iter().enumerate() {
        assert_eq!(catalogue.load(index).unwrap(), clip);
    }
    assert_eq!(files_in(directory.path()), 1, "a temporary file is left");
}

#[test]
fn a_file_is_whole_or_absent_and_only_replaced_on_demand() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("out.h5");
    let mut writer = ClipWriter::create(&path, false).unwrap();
    writer.add(&clips()[0]).unwrap();
    assert!(!path.exists());
    drop(writer);
    assert_eq!(files_in(directory.path()), 0);

    let writer = ClipWriter::create(&path, false).unwrap();
    std::fs::write(&path, "mine").unwrap();
    assert!(matches!(writer.finish(), Err(Error::Exists { .. })), "the file appeared after the writer was made");
    let message = ClipWriter::create(&path, false).map(drop).unwrap_err().to_string();
    assert!(message.ends_with("out.h5 exists; add --force to replace it, or name another file"), "{message}");
    assert_eq!(std::fs::read(&path).unwrap(), b"mine");

    let mut writer = ClipWriter::create(&path, true).unwrap();
    writer.add(&clips()[0]).unwrap();
    writer.finish().unwrap();
    assert_eq!(names(&Catalogue::open(&[whole(&path)]).unwrap()), ["TINY_001_01"]);
}

#[test]
fn names_are_unique_and_valid_on_a_command_line() {
    let directory = tempfile::tempdir().unwrap();
    let mut writer = ClipWriter::create(&directory.path().join("out.h5"), false).unwrap();
    let [clip, _] = clips().try_into().unwrap();
    writer.add(&clip).unwrap();
    assert!(matches!(writer.add(&clip), Err(Error::NameTaken { .. })));
    for name in ["", "a/b", "..", "a b"] {
        let named = Clip { name: name.into(), ..clip.clone() };
        assert!(matches!(writer.add(&named), Err(Error::Name { .. })), "{name}");
    }
}

#[test]
fn a_clip_that_could_not_be_read_back_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let mut writer = ClipWriter::create(&directory.path().join("out.h5"), false).unwrap();
    let [clip, _] = clips().try_into().unwrap();
    for steps in [0, 100_001] {
        let motion = Motion { position: vec![[0.0; 3]; steps], ..Motion::default() };
        let error = writer.add(&Clip { motion, features: None, ..clip.clone() }).unwrap_err();
        assert!(matches!(error, Error::Length { .. }), "{error}");
        let expected = format!(
            "clip `TINY_001_01` has {steps} frames; a clip in a file must have 1 to 100000, so split a longer motion"
        );
        assert_eq!(error.to_string(), expected);
    }
    for made_from in ["m".repeat(4097), "mirror \u{1b}[2J".into()] {
        let message = writer.add(&Clip { made_from: Some(made_from), ..clip.clone() }).unwrap_err().to_string();
        assert!(message.contains("made_from must be a text of at most 4096 bytes"), "{message}");
    }
    writer.add(&Clip { made_from: Some("m".repeat(4096)), ..clip }).unwrap();
}

#[test]
fn a_merged_file_has_the_clips_of_all_sources() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("merged.h5");
    let sources =
        [with_ids(tiny(), &["TINY_001_02"]), ClipSource::whole("builtin:walk"), ClipSource::whole("builtin:stand")];
    assert_eq!(merge(&sources, &path, false, |_, _| ()).unwrap(), 3);
    let merged = Catalogue::open(&[whole(&path)]).unwrap();
    assert_eq!(names(&merged), ["CMU_007_01", "TINY_001_02", "stand"]);
    let walk = merged.load(0).unwrap();
    assert_eq!(walk.features.as_ref().unwrap(), &Features::of(&walk.motion), "a built-in clip gets features");
    assert_eq!(merged.load(1).unwrap(), clips()[1]);

    let twice = [whole(tiny()), with_ids(tiny(), &["TINY_001_02"])];
    let message = merge(&twice, &directory.path().join("twice.h5"), false, |_, _| ()).unwrap_err().to_string();
    assert!(message.starts_with("clip `TINY_001_02` occurs twice"), "{message}");
    assert_eq!(files_in(directory.path()), 1);
}

#[test]
fn a_missing_directory_is_named() {
    let message = ClipWriter::create(Path::new("/no/such/place/out.h5"), false).map(drop).unwrap_err().to_string();
    assert!(message.contains("/no/such/place/out.h5: cannot be written"), "{message}");
}

#[test]
fn a_clip_knows_the_subsets_it_is_in() {
    assert_eq!(subsets_with("CMU_139_16"), ["get_up", "all"]);
    assert!(subsets_with("stand").is_empty());
}
