//! A checkpoint is whole or absent, and a damaged one does not affect the others.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use crate::support::RUN;
use comic_learner::checkpoint::{Evaluated, Judgement, Name, Snapshot, Store, find, read};
use comic_proto::chain;
use proptest::prelude::*;

fn snapshot(content: &str) -> Snapshot {
    let mut snapshot = Snapshot::default();
    snapshot.parts.insert("part".into(), content.as_bytes().to_vec());
    snapshot.parts.insert("progress.json".into(), br#"{"format": 2}"#.to_vec());
    snapshot
}

#[test]
fn the_newest_checkpoint_is_found() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 3).unwrap();
    assert!(store.newest().unwrap().is_none());
    store.write(Name::Updates(9), &snapshot("nine")).unwrap();
    store.write(Name::Updates(10), &snapshot("ten")).unwrap();
    assert_eq!(store.newest().unwrap().unwrap().1, snapshot("ten"));
}

#[test]
fn a_damaged_checkpoint_is_skipped() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 3).unwrap();
    store.write(Name::Updates(1), &snapshot("one")).unwrap();
    let newest = store.write(Name::Updates(2), &snapshot("two")).unwrap();
    std::fs::write(newest.join("part"), "twø").unwrap();
    let complaint = format!("{:#}", read(&newest).unwrap_err());
    assert!(complaint.contains("part") && complaint.contains("SHA-256"), "{complaint}");
    assert_eq!(store.newest().unwrap().unwrap().1, snapshot("one"));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    /// In the manifest and in the parts, at any place.
    #[test]
    fn a_cut_or_flipped_byte_costs_one_checkpoint_at_most(
        file in prop::sample::select(vec!["MANIFEST.json", "part", "other"]), place: prop::sample::Index, bit in 0..8u8,
        cut: bool,
    ) {
        let run = tempfile::tempdir().unwrap();
        let store = Store::open(run.path(), 3).unwrap();
        let whole = |content: &str| {
            let mut whole = snapshot(content);
            whole.parts.insert("other".into(), vec![7; 40]);
            whole
        };
        store.write(Name::Updates(1), &whole("one")).unwrap();
        let newest = store.write(Name::Updates(2), &whole("two, and a little longer")).unwrap();
        let file = newest.join(file);
        let mut bytes = std::fs::read(&file).unwrap();
        let place = place.index(bytes.len());
        if cut { bytes.truncate(place) } else { bytes[place] ^= 1 << bit }
        std::fs::write(&file, bytes).unwrap();
        prop_assert_eq!(store.newest().unwrap().unwrap().1, whole("one"));
    }
}

#[test]
fn an_unreadable_checkpoint_is_not_damaged_and_stays_in_place() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 3).unwrap();
    store.write(Name::Updates(1), &snapshot("one")).unwrap();
    let newest = store.write(Name::Updates(2), &snapshot("two")).unwrap();
    // The system refuses to open a link to itself, for every user.
    std::fs::remove_file(newest.join("part")).unwrap();
    std::os::unix::fs::symlink("part", newest.join("part")).unwrap();
    let refused = store.newest().unwrap_err();
    assert_eq!(refused.exit_code(), 1, "{refused}");
    assert!(chain(&refused).contains("cannot read"), "{}", chain(&refused));
    assert!(newest.is_dir());
}

#[test]
fn a_reader_skips_a_damaged_checkpoint_and_leaves_it_in_place() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 3).unwrap();
    let older = store.write(Name::Updates(1), &snapshot("one")).unwrap();
    let newest = store.write(Name::Updates(2), &snapshot("two")).unwrap();
    assert_eq!(find(run.path()).unwrap(), (newest.clone(), snapshot("two")));
    std::fs::write(newest.join("part"), "twø").unwrap();
    for path in [run.path(), &run.path().join("checkpoints"), &older] {
        assert_eq!(find(path).unwrap(), (older.clone(), snapshot("one")));
    }
    assert!(find(&newest).is_err() && newest.is_dir());
}

#[test]
fn a_path_without_a_whole_checkpoint_is_refused_and_the_error_names_the_remedy() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 3).unwrap();
    let damaged = store.write(Name::Updates(1), &snapshot("one")).unwrap();
    std::fs::write(damaged.join("part"), "øne").unwrap();
    let absent = run.path().join("absent");
    for path in [run.path(), &damaged, &damaged.join("part"), &absent] {
        let refused = find(path).unwrap_err();
        assert_eq!(refused.exit_code(), 2, "{refused}");
        let said = refused.to_string();
        assert!(said.contains(&path.display().to_string()) && said.contains("name a run's directory"), "{said}");
    }
}

#[test]
fn a_run_with_only_damaged_checkpoints_does_not_begin_again() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 3).unwrap();
    let only = store.write(Name::Updates(1), &snapshot("one")).unwrap();
    std::fs::write(only.join("part"), "øne").unwrap();
    for start in 1..=2 {
        let refused = Store::open(run.path(), 3).unwrap().newest().unwrap_err();
        assert_eq!(refused.exit_code(), 2, "a restart cannot help: {refused}");
        assert!(refused.to_string().contains("--run"), "start {start}: {refused}");
    }
    assert!(run.path().join("checkpoints/damaged-checkpoint-0000000001").is_dir());
}

#[test]
fn unrelated_files_are_ignored() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 1).unwrap();
    std::fs::write(run.path().join("checkpoints/checkpoint-best.tar"), "mine").unwrap();
    std::fs::create_dir(run.path().join("checkpoints/checkpoint-best")).unwrap();
    store.write(Name::Updates(1), &snapshot("one")).unwrap();
    store.write(Name::Updates(2), &snapshot("two")).unwrap();
    assert_eq!(store.newest().unwrap().unwrap().1, snapshot("two"));
    assert!(run.path().join("checkpoints/checkpoint-best").is_dir());
}

#[test]
fn a_checkpoint_with_the_same_number_is_replaced() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 1).unwrap();
    store.write(Name::Updates(1), &snapshot("one")).unwrap();
    store.write(Name::Updates(1), &snapshot("another")).unwrap();
    assert_eq!(store.newest().unwrap().unwrap().1, snapshot("another"));
}

#[test]
fn two_learners_cannot_share_a_run() {
    let run = tempfile::tempdir().unwrap();
    let held = Store::open(run.path(), 1).unwrap().lock().unwrap();
    assert!(format!("{:#}", Store::open(run.path(), 1).unwrap().lock().unwrap_err()).contains("another learner"));
    drop(held);
    Store::open(run.path(), 1).unwrap().lock().unwrap();
}

#[test]
fn an_unfinished_checkpoint_is_ignored() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 3).unwrap();
    store.write(Name::Updates(1), &snapshot("one")).unwrap();
    // What a crash leaves: the parts, without manifest and final name.
    let unfinished = run.path().join("checkpoints/.checkpoint-0000000002");
    std::fs::create_dir(&unfinished).unwrap();
    std::fs::write(unfinished.join("part"), "two").unwrap();
    assert_eq!(store.newest().unwrap().unwrap().1, snapshot("one"));
    store.write(Name::Updates(2), &snapshot("two")).unwrap();
    assert_eq!(store.newest().unwrap().unwrap().1, snapshot("two"));
}

#[test]
fn a_failed_write_leaves_the_former_checkpoint_and_nothing_else() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 1).unwrap();
    store.write(Name::Updates(1), &snapshot("one")).unwrap();
    let mut unwritable = snapshot("another");
    unwritable.parts.insert("no/such/directory".into(), Vec::new());
    for updates in [1, 2] {
        assert!(store.write(Name::Updates(updates), &unwritable).is_err());
    }
    assert_eq!(store.newest().unwrap().unwrap().1, snapshot("one"));
    let left = std::fs::read_dir(run.path().join("checkpoints")).unwrap().map(|entry| entry.unwrap().file_name());
    assert_eq!(left.collect::<Vec<_>>(), ["checkpoint-0000000001"]);
}

#[test]
fn the_oldest_numbered_checkpoints_are_removed_and_the_named_ones_stay() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 2).unwrap();
    store.write(Name::Initial, &snapshot("initial")).unwrap();
    for updates in 1..=4 {
        store.write(Name::Updates(updates), &snapshot("later")).unwrap();
    }
    let kept = |updates| store.has(Name::Updates(updates));
    assert_eq!([1, 2, 3, 4].map(kept), [false, false, true, true]);
    assert!(store.has(Name::Initial));
}

#[test]
fn a_checkpoint_that_an_evaluator_has_is_held_until_it_has_another() {
    let run = tempfile::tempdir().unwrap();
    let mut store = Store::open(run.path(), 1).unwrap();
    let mut kept_after = |held, written| {
        store.hold(held);
        store.write(Name::Updates(written), &snapshot("later")).unwrap();
        (1..=written).filter(|updates| store.has(Name::Updates(*updates))).collect::<Vec<_>>()
    };
    assert_eq!(kept_after(None, 1), [1]);
    assert_eq!(kept_after(Some(Name::Updates(1)), 2), [1, 2]);
    assert_eq!(kept_after(Some(Name::Updates(1)), 3), [1, 3]);
    assert_eq!(kept_after(Some(Name::Updates(3)), 4), [3, 4]);
    assert_eq!(kept_after(None, 5), [5]);
}

#[test]
fn a_manifest_with_a_path_outside_the_checkpoint_is_refused() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 2).unwrap();
    let path = store.write(Name::Updates(1), &snapshot("one")).unwrap();
    std::fs::write(path.join("MANIFEST.json"), r#"{"../../secret": "00"}"#).unwrap();
    assert!(read(&path).is_err());
}

#[test]
fn every_restart_has_a_larger_epoch() {
    let run = tempfile::tempdir().unwrap();
    let epochs: Vec<u64> = (0..3).map(|_| Store::open(run.path(), 1).unwrap().begin_epoch().unwrap()).collect();
    assert_eq!(epochs, [1, 2, 3]);
}

#[test]
fn a_run_keeps_its_number_and_every_other_run_has_another() {
    let (run, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let number = |directory: &tempfile::TempDir| Store::open(directory.path(), 1).unwrap().run();
    let drawn = number(&run).unwrap();
    assert_eq!(number(&run).unwrap(), drawn);
    assert_ne!(number(&other).unwrap(), drawn);
    std::fs::write(run.path().join("checkpoints/run"), "the best").unwrap();
    let damaged = number(&run).unwrap_err();
    assert!(damaged.exit_code() == 2 && damaged.to_string().contains("checkpoints/run is damaged"), "{damaged}");
}

#[test]
fn a_damaged_epoch_is_an_error_that_names_the_file() {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 1).unwrap();
    std::fs::write(run.path().join("checkpoints/epoch"), "many").unwrap();
    let damaged = store.begin_epoch().unwrap_err();
    assert!(damaged.exit_code() == 2 && damaged.to_string().contains("checkpoints/epoch is damaged"), "{damaged}");
}

/// A run with these checkpoints, all of one epoch.
fn evaluated_run(updates: &[u64]) -> (tempfile::TempDir, Store) {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 2).unwrap();
    updates.iter().for_each(|updates| write_evaluated(&store, *updates));
    (run, store)
}

fn write_evaluated(store: &Store, updates: u64) {
    let mut snapshot = snapshot("policy");
    let progress = format!("{{\"format\": 2, \"run\": {RUN}, \"epoch\": 3, \"version\": 1, \"updates\": {updates}}}");
    snapshot.parts.insert("progress.json".into(), progress.into_bytes());
    store.write(Name::Updates(updates), &snapshot).unwrap();
}

fn judge(store: &Store, updates: u64, normalised_reward: f64) -> Judgement {
    store.judge(Evaluated { run: RUN, epoch: 3, updates, normalised_reward }).unwrap()
}

#[test]
fn the_best_checkpoint_is_kept_besides_the_newest_until_another_is_better() {
    let (run, store) = evaluated_run(&[10, 20]);
    assert_eq!(judge(&store, 10, 0.3), Judgement::Best(Name::Updates(10)));
    assert_eq!(judge(&store, 20, 0.2), Judgement::NotBetter);
    write_evaluated(&store, 30);
    write_evaluated(&store, 40);
    let there = |updates| store.has(Name::Updates(updates));
    assert_eq!([10, 20, 30, 40].map(there), [true, false, true, true]);
    let best = run.path().join("checkpoints/best");
    assert_eq!(find(&best).unwrap().1, read(&run.path().join("checkpoints/checkpoint-0000000010")).unwrap());
    assert_eq!(judge(&store, 40, 0.4), Judgement::Best(Name::Updates(40)));
    write_evaluated(&store, 50);
    assert_eq!([10, 40, 50].map(there), [false, true, true]);
    assert_eq!(std::fs::read_link(&best).unwrap().to_str(), Some("checkpoint-0000000040"));
    assert_eq!(store.newest().unwrap().unwrap().0, run.path().join("checkpoints/checkpoint-0000000050"));
}

#[test]
fn the_record_of_the_best_survives_a_crash_while_it_is_written() {
    let (run, store) = evaluated_run(&[10, 20]);
    judge(&store, 10, 0.3);
    // What a crash leaves: the record is written, the link is missing or unfinished.
    let best = run.path().join("checkpoints/best");
    std::fs::remove_file(&best).unwrap();
    std::os::unix::fs::symlink("checkpoint-0000000020", run.path().join("checkpoints/.best")).unwrap();
    drop(store);
    let store = Store::open(run.path(), 1).unwrap();
    store.begin_epoch().unwrap();
    assert_eq!(std::fs::read_link(&best).unwrap().to_str(), Some("checkpoint-0000000010"));
    assert_eq!(judge(&store, 20, 0.2), Judgement::NotBetter);
    write_evaluated(&store, 30);
    assert!(store.has(Name::Updates(10)));
}

#[test]
fn an_evaluation_of_a_removed_checkpoint_or_of_another_epoch_or_run_changes_nothing() {
    let (run, store) = evaluated_run(&[10, 20, 30]);
    assert_eq!(judge(&store, 10, 0.9), Judgement::Gone);
    for (run, epoch) in [(RUN, 2), (RUN + 1, 3)] {
        let evaluated = Evaluated { run, epoch, updates: 30, normalised_reward: 0.9 };
        assert_eq!(store.judge(evaluated).unwrap(), Judgement::Gone, "{evaluated:?}");
    }
    assert!(!run.path().join("checkpoints/best.json").exists());
    let evaluated = Evaluated { run: RUN, epoch: 3, updates: 30, normalised_reward: 0.9 };
    assert_eq!(store.judge(evaluated).unwrap(), Judgement::Best(Name::Updates(30)));
}

#[test]
fn the_number_of_updates_tells_checkpoints_of_the_same_version_apart() {
    let (_run, store) = evaluated_run(&[11, 12]);
    assert_eq!(judge(&store, 11, 0.1), Judgement::Best(Name::Updates(11)));
}

#[test]
fn a_damaged_record_of_the_best_is_ignored_and_replaced() {
    for damaged in ["", "{", "[]", r#"{"updates": 77, "learner_epoch": 3, "version": 7, "normalised_reward": 9.0}"#] {
        let (run, store) = evaluated_run(&[10, 20]);
        std::fs::write(run.path().join("checkpoints/best.json"), damaged).unwrap();
        store.begin_epoch().unwrap();
        write_evaluated(&store, 30);
        assert!(!store.has(Name::Updates(10)), "{damaged}");
        assert_eq!(judge(&store, 30, 0.1), Judgement::Best(Name::Updates(30)), "{damaged}");
    }
}
