//! The part of a file that an experiment uses is a file of its own, which actors get in place of the whole file.

#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::path::Path;

use comic_clips::edit::speed;
use comic_clips::{Catalogue, ClipWriter};
use comic_experiment::ClipSource;

/// A file of eight clips: four names for each of two built-in clips.
fn whole(path: &Path) {
    let mut writer = ClipWriter::create(path, false).unwrap();
    for (name, letters) in [("builtin:CMU_007_01", "abcd"), ("builtin:walk", "efgh")] {
        let clip = Catalogue::open(&[ClipSource::whole(name)]).unwrap().load(0).unwrap();
        for letter in letters.chars() {
            let mut clip = clip.clone();
            clip.name = letter.to_string();
            writer.add(&clip).unwrap();
        }
    }
    writer.finish().unwrap();
}

fn some(source: &str, ids: &[&str]) -> ClipSource {
    ClipSource { ids: ids.iter().map(ToString::to_string).collect(), ..ClipSource::whole(source) }
}

#[test]
fn an_actor_finds_the_same_clips_in_the_part_as_in_the_whole() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("all.h5");
    whole(&path);
    let source = path.to_str().unwrap();
    // An experiment may name a source several times.
    let sources = [some(source, &["f", "a"]), some(source, &["h"])];
    let catalogue = Catalogue::open(&sources).unwrap();
    let cuts = directory.path().join("assets");
    let assets = catalogue.assets(Some(&cuts)).unwrap();
    assert_eq!(assets.len(), 1);
    assert_eq!(assets[0].source, source);
    assert!(assets[0].path.starts_with(&cuts));
    assert!(assets[0].size < std::fs::metadata(&path).unwrap().len() / 2, "{assets:?}");
    let part = Catalogue::open_with(&sources, |_| Some(assets[0].path.clone())).unwrap();
    assert_eq!(part.entries(), catalogue.entries());
    for index in 0..catalogue.entries().len() {
        assert_eq!(part.load(index).unwrap(), catalogue.load(index).unwrap());
    }
    // The next epoch of the learner finds the file, so actors that have it need no other one.
    assert_eq!(catalogue.assets(Some(&cuts)).unwrap(), assets);
}

#[test]
fn a_file_most_of_which_is_used_is_sent_as_it_is() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("all.h5");
    whole(&path);
    let sources = [some(path.to_str().unwrap(), &["a", "b", "c", "d", "e"])];
    let catalogue = Catalogue::open(&sources).unwrap();
    let cuts = directory.path().join("assets");
    assert_eq!(catalogue.assets(Some(&cuts)).unwrap(), catalogue.assets(None).unwrap());
    assert!(!cuts.exists());
}

#[test]
fn the_part_of_a_file_says_what_its_clips_were_made_from() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("copies.h5");
    let walk = Catalogue::open(&[ClipSource::whole("builtin:walk")]).unwrap().load(0).unwrap();
    let mut writer = ClipWriter::create(&path, false).unwrap();
    for percent in [80, 90, 110] {
        writer.add(&speed(&walk, f64::from(percent) / 100.0).unwrap()).unwrap();
    }
    writer.finish().unwrap();
    let sources = [some(path.to_str().unwrap(), &["CMU_007_01_x90"])];
    let assets = Catalogue::open(&sources).unwrap().assets(Some(directory.path())).unwrap();
    assert_ne!(assets[0].path, path, "it must be a part");
    let part = Catalogue::open_with(&sources, |_| Some(assets[0].path.clone())).unwrap();
    assert_eq!(part.entries()[0].made_from.as_deref(), Some("speed 0.9 CMU_007_01"));
    assert_eq!(part.load(0).unwrap().made_from, part.entries()[0].made_from);
}
