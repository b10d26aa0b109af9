//! A seed decides the episodes of an environment from then on.
#![allow(clippy::unwrap_used, reason = "a test that cannot continue fails")]

use comic_clips::Catalogue;
use comic_experiment::TaskName;
use comic_tasks::Simulated;

/// An environment of a task, with another one in joint training if it is named.
fn environment(task: &str, joint: &str, seed: u64) -> Box<dyn Simulated> {
    let overrides = [format!("task={task}"), format!("joint={joint}")];
    let experiment = comic_experiment::resolve("tracking-mlp", &overrides).unwrap();
    let catalogue = Catalogue::open(&experiment.clips).unwrap();
    comic_tasks::build(&experiment, &catalogue).unwrap().environment(seed).unwrap()
}

/// Starts and states of two episodes.
fn episodes(environment: &mut dyn Simulated) -> Vec<Vec<f64>> {
    let mut seen = Vec::new();
    for _ in 0..2 {
        environment.reset();
        for _ in 0..3 {
            let step = environment.step_control(&[0.1; 56]);
            let mut state = environment.simulation().qpos().to_vec();
            state.push(step.reward());
            seen.push(state);
        }
    }
    seen
}

fn is_decided_by_the_seed(task: &str, joint: &str) {
    let (mut one, mut other) = (environment(task, joint, 1), environment(task, joint, 2));
    // Another history must not matter.
    episodes(other.as_mut());
    for seed in [9, 10] {
        one.reseed(seed);
        other.reseed(seed);
        assert_eq!(episodes(one.as_mut()), episodes(other.as_mut()), "{task} {joint}");
    }
    one.reseed(9);
    other.reseed(10);
    assert_ne!(episodes(one.as_mut()), episodes(other.as_mut()), "{task} {joint}");
}

#[test]
fn the_episodes_of_every_task_depend_on_the_new_seed_alone() {
    for task in TaskName::ALL {
        is_decided_by_the_seed(task.name(), "[]");
    }
}

#[test]
fn so_do_those_of_joint_training() {
    is_decided_by_the_seed("tracking", "[{ task = 'get-up', probability = 0.5 }]");
}
