//! The part of a file that an experiment uses is a file of its own, which actors get in place of the whole file.

#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use comic_clips::edit::speed;
use comic_clips::{Asset, Catalogue, ClipWriter, Error};
use comic_experiment::ClipSource;
use tempfile::TempDir;

/// A file with copies of built-in clips, each named by a letter.
fn write(path: &Path, copies: &[(&str, &str)]) {
    let mut writer = ClipWriter::create(path, true).unwrap();
    for (name, letters) in copies {
        let clip = Catalogue::open(&[ClipSource::whole(*name)]).unwrap().load(0).unwrap();
        for letter in letters.chars() {
            let mut clip = clip.clone();
            clip.name = letter.to_string();
            writer.add(&clip).unwrap();
        }
    }
    writer.finish().unwrap();
}

/// A directory with a file of eight clips, four names for each of two built-in clips, and a place for its parts.
fn whole() -> (TempDir, PathBuf, PathBuf) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("all.h5");
    write(&path, &[("builtin:CMU_007_01", "abcd"), ("builtin:walk", "efgh")]);
    let cuts = directory.path().join("assets");
    (directory, path, cuts)
}

fn some(source: &str, ids: &[&str]) -> ClipSource {
    ClipSource { ids: ids.iter().map(ToString::to_string).collect(), ..ClipSource::whole(source) }
}

/// Fails unless an actor with this asset has the clips of the learner's catalogue, and no others.
fn assert_same_clips(what: &str, asset: &Asset, sources: &[ClipSource], catalogue: &Catalogue) {
    let part = Catalogue::open_with(sources, |_| Some(asset.path.clone())).unwrap();
    assert_eq!(part.entries(), catalogue.entries(), "{what}");
    for index in 0..catalogue.entries().len() {
        assert!(part.load(index).unwrap() == catalogue.load(index).unwrap(), "{what}: clip {index}");
    }
    let all = Catalogue::open(&[ClipSource::whole(asset.path.to_str().unwrap())]).unwrap();
    assert_eq!(all.entries().len(), catalogue.entries().len(), "{what}");
}

/// The names in a directory, sorted.
fn names(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).unwrap();
    let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort_unstable();
    names
}

fn name(asset: &Asset) -> String {
    asset.path.file_name().unwrap().to_str().unwrap().into()
}

#[test]
fn an_actor_finds_the_same_clips_in_the_part_as_in_the_whole() {
    let (_directory, path, cuts) = whole();
    let source = path.to_str().unwrap();
    // An experiment may name a source several times.
    let sources = [some(source, &["f", "a"]), some(source, &["h"])];
    let catalogue = Catalogue::open(&sources).unwrap();
    let assets = catalogue.assets(Some(&cuts)).unwrap();
    assert_eq!(assets.len(), 1);
    assert_eq!(assets[0].source, source);
    assert!(assets[0].path.starts_with(&cuts));
    assert!(assets[0].size < std::fs::metadata(&path).unwrap().len() / 2, "{assets:?}");
    assert_same_clips("the part", &assets[0], &sources, &catalogue);
}

/// Actors that have the file need no other one.
#[test]
fn the_next_start_of_the_learner_uses_the_file_and_writes_nothing() {
    let (_directory, path, cuts) = whole();
    let catalogue = Catalogue::open(&[some(path.to_str().unwrap(), &["a", "f"])]).unwrap();
    let start = || {
        let assets = catalogue.assets(Some(&cuts)).unwrap();
        let file = std::fs::metadata(&assets[0].path).unwrap();
        (assets, names(&cuts), file.ino(), file.modified().unwrap())
    };
    assert_eq!(start(), start());
}

#[test]
fn a_damaged_part_is_replaced() {
    let (_directory, path, cuts) = whole();
    let sources = [some(path.to_str().unwrap(), &["a", "f"])];
    let catalogue = Catalogue::open(&sources).unwrap();
    let part = catalogue.assets(Some(&cuts)).unwrap().remove(0).path;
    let good = std::fs::read(&part).unwrap();
    let damages: [(&str, &dyn Fn()); 6] = [
        ("empty", &|| std::fs::write(&part, "").unwrap()),
        ("the first half", &|| std::fs::write(&part, &good[..good.len() / 2]).unwrap()),
        ("a zero block", &|| {
            let mut bytes = good.clone();
            let middle = bytes.len() / 2;
            bytes[middle..middle + 4096].fill(0);
            std::fs::write(&part, bytes).unwrap();
        }),
        ("other frames", &|| write(&part, &[("builtin:walk", "a"), ("builtin:CMU_007_01", "f")])),
        ("a clip too many", &|| write(&part, &[("builtin:CMU_007_01", "a"), ("builtin:walk", "fg")])),
        ("a clip too few", &|| write(&part, &[("builtin:CMU_007_01", "a")])),
    ];
    for (what, damage) in damages {
        damage();
        let assets = catalogue.assets(Some(&cuts)).unwrap();
        assert_same_clips(what, &assets[0], &sources, &catalogue);
    }
}

#[test]
fn parts_of_other_selections_and_sources_are_removed() {
    let (_directory, path, cuts) = whole();
    let cut =
        |ids: &[&str]| Catalogue::open(&[some(path.to_str().unwrap(), ids)]).unwrap().assets(Some(&cuts)).unwrap();
    cut(&["a", "f"]);
    std::fs::write(cuts.join("0123456789abcdef0123456789abcdef.h5"), "of another source").unwrap();
    std::fs::write(cuts.join(".clips-abcdef.part"), "of a process that was killed").unwrap();
    let assets = cut(&["a", "g"]);
    assert_eq!(names(&cuts), [name(&assets[0])]);
}

/// The room of the old ones may be what the new ones need.
#[test]
fn other_parts_are_removed_also_if_a_new_one_cannot_be_written() {
    let (_directory, path, cuts) = whole();
    let start = |id: &str| Catalogue::open(&[some(path.to_str().unwrap(), &[id])]).unwrap().assets(Some(&cuts));
    let part = start("g").unwrap().remove(0).path;
    start("a").unwrap();
    // No file can take the place of a directory that has something in it.
    std::fs::create_dir_all(part.join("foreign")).unwrap();
    let refused = start("g").unwrap_err();
    assert!(matches!(refused, Error::Unwritable { .. }), "{refused}");
    assert_eq!(names(&cuts), [part.file_name().unwrap().to_str().unwrap()]);
}

#[test]
fn files_that_are_no_parts_stay() {
    let (_directory, path, cuts) = whole();
    std::fs::create_dir(&cuts).unwrap();
    let digits = "0123456789abcdef".repeat(2);
    let foreign = ["0123.h5", "walks.h5", &digits, &format!("{digits}.txt"), &format!("{}.h5", digits.to_uppercase())];
    foreign.iter().for_each(|name| std::fs::write(cuts.join(name), "foreign").unwrap());
    // Of a part's name, but no file.
    std::fs::create_dir(cuts.join(format!("{digits}.h5"))).unwrap();
    let before = names(&cuts);
    let catalogue = Catalogue::open(&[some(path.to_str().unwrap(), &["a"])]).unwrap();
    let part = name(&catalogue.assets(Some(&cuts)).unwrap()[0]);
    let after: Vec<_> = names(&cuts).into_iter().filter(|name| *name != part).collect();
    assert_eq!(after, before);
}

#[test]
fn the_parts_of_all_sources_stay() {
    let (directory, first, cuts) = whole();
    let second = directory.path().join("more.h5");
    write(&second, &[("builtin:walk", "xyz")]);
    let sources = [some(first.to_str().unwrap(), &["a"]), some(second.to_str().unwrap(), &["x"])];
    let assets = Catalogue::open(&sources).unwrap().assets(Some(&cuts)).unwrap();
    let mut expected: Vec<_> = assets.iter().map(name).collect();
    expected.sort_unstable();
    assert_eq!(names(&cuts), expected);
}

#[test]
fn a_file_most_of_which_is_used_is_sent_as_it_is() {
    let (_directory, path, cuts) = whole();
    let sources = [some(path.to_str().unwrap(), &["a", "b", "c", "d", "e"])];
    let catalogue = Catalogue::open(&sources).unwrap();
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
