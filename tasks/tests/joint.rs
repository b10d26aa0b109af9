//! Joint training: several tasks in one environment.
#![allow(clippy::unwrap_used, reason = "a test that cannot continue fails")]

use std::sync::Arc;

use comic_clips::{Catalogue, Clip, ClipWriter};
use comic_experiment::{ClipSource, Experiment, resolve};
use comic_tasks::{MAX_REWARD_TERMS, Outcome, Simulated, Task};
use mujoco_rs::prelude::MjtObjBase;

fn experiment(joint: &str) -> Experiment {
    resolve("tracking-mlp", &[format!("joint={joint}"), "get_up.lying_share=0".into()]).unwrap()
}

fn build(experiment: &Experiment) -> Arc<dyn Task> {
    comic_tasks::build(experiment, &Catalogue::open(&experiment.clips).unwrap()).unwrap()
}

/// dm_control's own file has clips of 50 ms, too.
#[test]
fn clips_with_other_steps_than_the_other_tasks_are_refused_with_the_reason() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("slow.h5");
    let walk = Catalogue::open(&experiment(BOTH).clips).unwrap().load(0).unwrap();
    let mut writer = ClipWriter::create(&path, false).unwrap();
    writer.add(&Clip { name: "slow".into(), dt: 0.05, ..walk }).unwrap();
    writer.finish().unwrap();
    let joint = Experiment { clips: vec![ClipSource::whole(path.to_str().unwrap())], ..experiment(BOTH) };
    let catalogue = Catalogue::open(&joint.clips).unwrap();
    let refused = comic_tasks::build(&joint, &catalogue).unwrap_err().to_string();
    for part in ["`slow`", "0.05 s", "0.03 s", "`joint`"] {
        assert!(refused.contains(part), "no {part} in {refused}");
    }
    assert!(comic_tasks::build(&Experiment { joint: Vec::new(), ..joint }, &catalogue).is_ok(), "tracking alone");
}

const BOTH: &str = r#"[{task="get-up", probability=0.1}, {task="ball-catch", probability=0.2}]"#;

#[test]
fn episodes_draw_their_tasks_with_the_given_probabilities() {
    let task = build(&experiment(BOTH));
    let mut environment = task.environment(3).unwrap();
    let draws = 4000;
    let mut counts = [0.0; 3];
    for _ in 0..draws {
        environment.reset();
        counts[environment.episode().task] += 1.0;
    }
    for (count, probability) in counts.into_iter().zip([0.7, 0.1, 0.2]) {
        let (expected, deviation) =
            (f64::from(draws) * probability, (f64::from(draws) * probability * (1.0 - probability)).sqrt());
        assert!((count - expected).abs() < 5.0 * deviation, "{counts:?}");
    }
}

#[test]
fn every_step_has_the_height_of_the_head() {
    let task = build(&experiment(BOTH));
    let mut environment = task.environment(3).unwrap();
    for clip in 0..3 {
        environment.reset_to(clip, 10).unwrap();
        let step = environment.step_control(&[0.0; 56]);
        let head = environment.model().name_to_id(MjtObjBase::mjOBJ_BODY, "walker/head").unwrap();
        assert_eq!(step.head_height, environment.simulation().xpos()[head][2], "clip {clip}");
        assert!((0.1..2.0).contains(&step.head_height), "{}", step.head_height);
    }
    // The reward of get-up is a function of this height (supplement) with target height 1.808 m.
    environment.reset_to(1, 10).unwrap();
    let step = environment.step_control(&[0.0; 56]);
    assert!((step.reward() - (-(step.head_height - 1.808).powi(2)).exp()).abs() < 1e-12, "{step:?}");
    assert_eq!(environment.step_control(&[f64::NAN; 56]).head_height, 0.0);
}

#[test]
fn clips_are_numbered_task_by_task_and_every_start_belongs_to_its_task() {
    let task = build(&experiment(BOTH));
    let spec = task.spec().clone();
    assert_eq!(spec.clips, ["CMU_007_01", "get-up", "ball-catch"]);
    assert_eq!(spec.reward_terms, ["reward"]);
    let share: f64 = task.starts().iter().map(|start| start.probability).sum();
    assert!((share - 1.0).abs() < 1e-12);
    let mut environment = Arc::clone(&task).environment(1).unwrap();
    for start in task.starts() {
        environment.reset_to(start.clip, start.frames.start).unwrap();
        let episode = environment.episode();
        assert_eq!((episode.clip, episode.task), (start.clip, spec.task_of(start.clip)));
    }
    assert!(environment.reset_to(3, 0).is_err());
}

#[test]
fn each_task_is_as_alone_with_its_observation_last_and_its_reward_in_one_term() {
    let together = experiment(BOTH);
    let joint = build(&together);
    let mut environment = Arc::clone(&joint).environment(1).unwrap();
    for (index, (name, _)) in together.tasks().into_iter().enumerate() {
        let alone = build(&Experiment { task: name, joint: Vec::new(), ..together.clone() });
        let mut own = Arc::clone(&alone).environment(1).unwrap();
        let start = alone.starts()[0].frames.start;
        environment.reset_to(index, start).unwrap();
        own.reset_to(0, start).unwrap();
        let action = [0.1; 56];
        for _ in 0..3 {
            let observed = |environment: &dyn Simulated, width: usize| {
                let (mut body, mut task) = (vec![0.0; 205], vec![9.0; width]);
                environment.observe(&mut body, &mut task);
                (body, task)
            };
            let (mut expected, found) =
                (observed(own.as_ref(), alone.spec().task), observed(environment.as_ref(), joint.spec().task));
            let mut filled = vec![0.0; joint.spec().task - expected.1.len()];
            filled.append(&mut expected.1);
            expected.1 = filled;
            assert_eq!(found, expected, "{name}");
            let (expected, found) = (own.step(&action), environment.step(&action));
            assert_eq!((found.reward(), found.discount), (expected.reward(), expected.discount), "{name}");
            assert_eq!(found.reward_terms[1..], [0.0; MAX_REWARD_TERMS - 1]);
            assert_eq!(environment.achievement(), own.achievement(), "{name}");
            if expected.outcome != Outcome::Running {
                break;
            }
        }
    }
}
