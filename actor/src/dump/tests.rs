//! Dumps of environments that diverge.

use super::*;

/// An environment of a preset that dumps into a directory.
fn watched(directory: &Path, preset: &str) -> Watched {
    let experiment = comic_experiment::resolve(preset, &[]).unwrap();
    let catalogue = Catalogue::open(&experiment.clips).unwrap();
    let task = comic_tasks::build(&experiment, &catalogue).unwrap();
    let dumps = Dumps::new(directory, &experiment, task.spec()).unwrap();
    Watched::new(task.environment(3).unwrap(), Some(dumps), 3)
}

fn dumped(directory: &Path) -> Vec<PathBuf> {
    std::fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path()).collect()
}

/// An extreme action that depends on the step only.
fn wild(step: usize) -> [f32; 56] {
    std::array::from_fn(|joint| ((step * 56 + joint) as f32).sin())
}

#[test]
fn a_dump_of_tracking_is_reproduced_bit_for_bit() {
    let directory = tempfile::tempdir().unwrap();
    let mut environment = watched(directory.path(), "quickstart");
    environment.reset();
    for step in 0..4 {
        environment.step(&wild(step));
    }
    environment.reset();
    for step in 0..12 {
        environment.step(&wild(step));
    }
    assert!(dumped(directory.path()).is_empty());
    assert_eq!(environment.step(&[f32::NAN; 56]).outcome, Outcome::Diverged);
    let [path] = dumped(directory.path()).try_into().unwrap();
    let dump = Dump::read(&path).unwrap();
    assert_eq!((dump.actions.len(), dump.last.len(), dump.clip_name.as_str()), (13, LAST, "CMU_007_01"));
    assert_eq!(dump.reproduce(&[]).unwrap(), Reproduction { steps: 13, diverged: Some(13), exact: true });
}

#[test]
fn a_dump_of_another_task_begins_in_its_first_state() {
    let directory = tempfile::tempdir().unwrap();
    let mut environment = watched(directory.path(), "get-up");
    environment.reset();
    environment.step(&[f32::INFINITY; 56]);
    let [path] = dumped(directory.path()).try_into().unwrap();
    assert_eq!(
        Dump::read(&path).unwrap().reproduce(&[]).unwrap(),
        Reproduction { steps: 1, diverged: Some(1), exact: true }
    );
}

#[test]
fn states_of_a_diverged_episode_are_restored_from_disk() {
    let directory = tempfile::tempdir().unwrap();
    let mut environment = watched(directory.path(), "quickstart");
    environment.reset();
    environment.environment.simulation_mut().qvel_mut().fill(1e11);
    assert_eq!(environment.step(&[0.0; 56]).outcome, Outcome::Diverged);
    let [path] = dumped(directory.path()).try_into().unwrap();
    let dump = Dump::read(&path).unwrap();
    assert!(dump.last[0].qvel.0.iter().all(|value| *value == 1e11));
    assert_eq!(dump.end, Moment::of(environment.environment.simulation()));
    assert!(!dump.reproduce(&[]).unwrap().exact, "no action explains the velocity");
}

#[test]
fn the_number_of_dumps_is_limited() {
    let directory = tempfile::tempdir().unwrap();
    let mut environment = watched(directory.path(), "quickstart");
    for _ in 0..MOST + 3 {
        environment.reset();
        environment.step(&[f32::NAN; 56]);
    }
    assert_eq!(dumped(directory.path()).len(), MOST);
}

#[test]
fn a_file_that_is_no_dump_is_refused_with_its_name() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("notes.json");
    for text in ["", "{}", "[1, 2]", r#"{"experiment": 3}"#] {
        std::fs::write(&path, text).unwrap();
        let error = Dump::read(&path).unwrap_err();
        assert!(error.is_configuration() && error.to_string().contains("notes.json"), "{error}");
    }
}
