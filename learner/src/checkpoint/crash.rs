//! Crashes in the middle of writing a checkpoint, with whatever a disk may lose then.
//!
//! The model is pessimistic. When the machine stops, each change that was not synced is either kept or lost, and a file's
//! contents may be cut in half, independently of all other changes.

use std::path::{Path, PathBuf};

use proptest::prelude::*;
use tempfile::TempDir;

use crate::checkpoint::name::Name;
use crate::checkpoint::snapshot::Snapshot;
use crate::checkpoint::steps::{Step, carry_out, making};
use crate::checkpoint::store::Store;

const KEPT: usize = 1;

fn snapshot(content: &str) -> Snapshot {
    let part =
        |name: &str| (name.to_owned(), format!("{content} of {name}, long enough to be cut in half").into_bytes());
    Snapshot { parts: ["policy", "optimiser", "progress"].map(part).into() }
}

/// A run with one checkpoint, and the steps by which it gets another, of a new name or of the same.
fn run_with(next: Name) -> (TempDir, Store, Vec<Step<'static>>) {
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), KEPT).unwrap();
    store.begin_epoch().unwrap();
    store.write(Name::Updates(1), &snapshot("one")).unwrap();
    let steps = store.steps(next, &snapshot("two")).unwrap().iter().map(owned).collect();
    (run, store, steps)
}

fn owned(step: &Step<'_>) -> Step<'static> {
    match step.clone() {
        Step::Write(path, bytes) => Step::Write(path, bytes.into_owned().into()),
        Step::MakeDirectory(path) => Step::MakeDirectory(path),
        Step::SyncFile(path) => Step::SyncFile(path),
        Step::SyncDirectory(path) => Step::SyncDirectory(path),
        Step::Rename(from, to) => Step::Rename(from, to),
        Step::Link(path, target) => Step::Link(path, target),
        Step::Remove(path) => Step::Remove(path),
    }
}

/// What can happen to one step.
#[derive(Clone, Copy, PartialEq)]
enum Fate {
    Lasts,
    /// The file exists, with half of its contents.
    Torn,
    Lost,
}

/// Whether a later one of the steps makes what `step` did to its directory last.
fn entry_lasts(step: &Step<'_>, later: &[Step<'_>]) -> bool {
    let path = match step {
        Step::MakeDirectory(path) | Step::Write(path, _) | Step::Link(path, _) | Step::Remove(path) => path,
        Step::Rename(_, to) => to,
        Step::SyncFile(_) | Step::SyncDirectory(_) => return true,
    };
    later
        .iter()
        .any(|step| matches!(step, Step::SyncDirectory(directory) if Some(directory.as_path()) == path.parent()))
}

fn contents_last(step: &Step<'_>, later: &[Step<'_>]) -> bool {
    let Step::Write(path, _) = step else { return true };
    later.iter().any(|step| matches!(step, Step::SyncFile(synced) if synced == path))
}

/// Leaves the disk as it may be after `done` and a crash. `luck` decides, with two bits for each step.
fn crash(done: &[Step<'_>], luck: u128) {
    for (number, step) in done.iter().enumerate() {
        let (later, bits) = (&done[number + 1..], luck >> (2 * number) & 3);
        let fate = match bits {
            0 | 1 => Fate::Lasts,
            2 if !contents_last(step, later) => Fate::Torn,
            3 if !entry_lasts(step, later) => Fate::Lost,
            _ => Fate::Lasts,
        };
        // A step that depends on a lost one fails, and is lost too.
        let _ = match (fate, step) {
            (Fate::Lost, _) => Ok(()),
            (Fate::Torn, Step::Write(path, bytes)) => {
                Step::Write(path.clone(), bytes[..bytes.len() / 2].to_vec().into()).carry_out()
            }
            _ => step.carry_out(),
        };
    }
}

/// What the next start finds: one of these checkpoints, whole. Afterwards everything works as before.
fn survives(run: &Path, expected: &[&Snapshot]) -> Result<(), TestCaseError> {
    let store = Store::open(run, KEPT).map_err(fail)?;
    let found = store.newest().map_err(fail)?.map(|(_, snapshot)| snapshot);
    prop_assert_eq!(store.begin_epoch().map_err(fail)?, 2);
    prop_assert!(expected.iter().any(|expected| found.as_ref() == Some(*expected)), "{:?}", found);
    let left = std::fs::read_dir(run.join("checkpoints")).map_err(fail)?.flatten();
    let hidden: Vec<_> =
        left.map(|entry| entry.file_name()).filter(|name| name.to_string_lossy().starts_with('.')).collect();
    prop_assert!(hidden.is_empty(), "half-finished: {:?}", hidden);
    let third = snapshot("three");
    store.write(Name::Updates(3), &third).map_err(fail)?;
    prop_assert_eq!(store.newest().map_err(fail)?.map(|(_, snapshot)| snapshot), Some(third));
    Ok(())
}

fn fail(error: impl std::fmt::Display) -> TestCaseError {
    TestCaseError::fail(format!("{error:#}"))
}

fn names() -> impl Strategy<Value = Name> {
    prop_oneof![Just(Name::Updates(1)), Just(Name::Updates(2))]
}

/// Every file below a directory.
fn files(directory: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    for path in std::fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path()) {
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.push((path.clone(), std::fs::read(&path).unwrap()));
        }
    }
    found
}

/// Restores a run's checkpoints.
fn put_back(run: &Path, files: &[(PathBuf, Vec<u8>)]) {
    std::fs::remove_dir_all(run.join("checkpoints")).unwrap();
    for (path, bytes) in files {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
}

proptest! {
    // Each case syncs a few dozen times.
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn after_a_crash_at_any_moment_there_is_the_former_checkpoint_or_the_new_one(
        next in names(), moment in any::<prop::sample::Index>(), luck in any::<u128>(),
    ) {
        let (run, store, steps) = run_with(next);
        let done = moment.index(steps.len() + 1);
        crash(&steps[..done], luck);
        drop(store);
        let (one, two) = (snapshot("one"), snapshot("two"));
        survives(run.path(), &[&one, &two])?;
    }

    #[test]
    fn a_written_checkpoint_survives_a_crash(next in names(), luck in any::<u128>()) {
        let (run, store, steps) = run_with(next);
        crash(&steps, luck);
        drop(store);
        survives(run.path(), &[&snapshot("two")])?;
    }

    /// A learner is killed, the next one repairs what it left, and the power fails. Nothing was synced because of the kill.
    #[test]
    fn a_crash_while_repairing_loses_nothing(
        next in names(), killed in any::<prop::sample::Index>(), moment in any::<prop::sample::Index>(), luck in any::<u128>(),
    ) {
        let (run, store, mut steps) = run_with(next);
        let before = files(run.path());
        steps.truncate(killed.index(steps.len() + 1));
        carry_out(&steps).map_err(fail)?;
        let repairs = store.repairs().map_err(fail)?;
        put_back(run.path(), &before);
        steps.extend_from_slice(&repairs[..moment.index(repairs.len() + 1)]);
        crash(&steps, luck);
        drop(store);
        let (one, two) = (snapshot("one"), snapshot("two"));
        survives(run.path(), &[&one, &two])?;
    }
}

/// A crash comes right after they were made.
#[test]
fn a_new_runs_directories_survive_a_crash() {
    let place = tempfile::tempdir().unwrap();
    let directory = place.path().join("runs/first/checkpoints");
    let steps = making(&directory);
    crash(&steps, u128::MAX);
    assert!(directory.is_dir());
    assert!(making(&directory).is_empty(), "an existing directory is not made again");
    carry_out(&steps).expect("two learners can make it at the same time");
    let syncs: Vec<_> = (0..steps.len()).filter(|step| matches!(steps[*step], Step::SyncDirectory(_))).collect();
    assert_eq!(syncs.len(), 3);
    for sync in syncs {
        let place = tempfile::tempdir().unwrap();
        let directory = place.path().join("runs/first/checkpoints");
        let mut steps = making(&directory);
        steps.remove(sync);
        crash(&steps, u128::MAX);
        assert!(!directory.is_dir(), "a sync could be left out");
    }
}

/// Shows that the tests above can fail: every sync is needed.
#[test]
fn without_any_one_of_the_syncs_a_crash_can_lose_data() {
    // The worst for all steps at once, and the worst for each single step.
    let lucks: Vec<u128> = [u128::MAX, u128::MAX / 3 * 2]
        .into_iter()
        .chain((0..60).flat_map(|step| [2 << (2 * step), 3 << (2 * step)]))
        .collect();
    let (_run, _store, steps) = run_with(Name::Updates(2));
    let syncs: Vec<usize> =
        (0..steps.len()).filter(|step| matches!(steps[*step], Step::SyncFile(_) | Step::SyncDirectory(_))).collect();
    assert!(syncs.len() > 4);
    for sync in syncs {
        let lost = lucks.iter().any(|luck| {
            let (run, _store, mut steps) = run_with(Name::Updates(2));
            let left_out = steps.remove(sync);
            crash(&steps, *luck);
            let lost = survives(run.path(), &[&snapshot("two")]).is_err();
            assert!(matches!(left_out, Step::SyncFile(_) | Step::SyncDirectory(_)));
            lost
        });
        assert!(lost, "{:?} could be left out", steps[sync]);
    }
}
