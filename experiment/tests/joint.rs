//! Experiments of several tasks.
#![allow(clippy::unwrap_used, reason = "a test that cannot continue fails")]

use comic_experiment::{TaskName, TaskSpec, resolve};

#[test]
fn the_joint_presets_have_the_papers_probabilities() {
    let of = |preset: &str| resolve(preset, &[]).unwrap().tasks();
    assert_eq!(of("joint-get-up"), [(TaskName::Tracking, 0.9), (TaskName::GetUp, 0.1)]);
    assert_eq!(of("joint-ball"), [(TaskName::Tracking, 0.8), (TaskName::BallCatch, 0.2)]);
}

#[test]
fn meaningless_joint_tasks_are_refused() {
    let refused = |joint: &str, other: &str| {
        let overrides = [format!("joint=[{joint}]"), other.to_string()];
        resolve("quickstart", &overrides).unwrap_err().to_string()
    };
    let get_up = r#"{task="get-up", probability=0.1}"#;
    for (joint, other, field) in [
        (r#"{task="tracking", probability=0.1}"#, "seed=1", "joint.0.task"),
        (&format!("{get_up}, {get_up}"), "seed=1", "joint.1.task"),
        (r#"{task="get-up", probability=0}"#, "seed=1", "joint.0.probability"),
        (r#"{task="get-up", probability=1}"#, "seed=1", "joint.0.probability"),
        (r#"{task="get-up", probability=nan}"#, "seed=1", "joint.0.probability"),
        (r#"{task="get-up", probability=0.5}, {task="ball-catch", probability=0.5}"#, "seed=1", "joint"),
        (r#"{task="gaps", probability=0.5}"#, "seed=1", "gaps.corridor.vision"),
        (get_up, "network.value_lstm=[8]", "network.value_lstm"),
    ] {
        let error = refused(joint, other);
        assert!(error.contains(field), "{joint}, {other}: {error}");
    }
    resolve("quickstart", &[r#"joint=[{task="gaps", probability=0.5}]"#.into(), "gaps.corridor.vision=off".into()])
        .unwrap();
    let error = resolve("quickstart", &[r#"joint=[{task="get-up", probabilty=0.1}]"#.into()]).unwrap_err().to_string();
    assert!(error.contains("joint.0.probability"), "{error}");
}

#[test]
fn clips_are_numbered_task_by_task() {
    let experiment = resolve("joint-ball", &[]).unwrap();
    let spec = TaskSpec::new(&experiment, vec!["walk".into(), "run".into()]).unwrap();
    assert_eq!(spec.clips, ["walk", "run", "ball-catch"]);
    assert_eq!([0, 1, 2].map(|clip| spec.task_of(clip)), [0, 0, 1]);
    let ball = &experiment.ball_catch;
    let most = 2.0 * ball.touch_reward + ball.standing_reward + ball.walking_reward;
    assert_eq!([0, 1, 2].map(|clip| spec.max_reward(clip)), [1.45, 1.45, most]);
    assert_eq!(
        (spec.reward_terms.len(), spec.task),
        (1, TaskSpec::tracking(&experiment.tracking, Vec::new()).unwrap().task)
    );
}
