//! Episodes of tracking: their starts, steps and ends.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

use std::sync::Arc;

use comic_clips::{Catalogue, pose_to_action};
use comic_experiment::{ClipSource, TRACKING_MAX_REWARD, TRACKING_OBSERVATIONS, TaskSpec, TerminationError, Tracking};
use comic_tasks::{Environment, Episode, Error, Outcome, Simulated, Task, TrackingEnvironment, TrackingTask};

fn catalogue(names: &[&str]) -> Catalogue {
    let sources: Vec<ClipSource> = names.iter().map(|name| ClipSource::whole(format!("builtin:{name}"))).collect();
    Catalogue::open(&sources).unwrap()
}

fn task_of(config: &Tracking, clips: &[&str]) -> Arc<TrackingTask> {
    Arc::new(TrackingTask::new(config, &catalogue(clips)).unwrap())
}

fn lenient() -> Tracking {
    Tracking { termination_threshold: 1e9, ..Tracking::default() }
}

/// The f32 observation: proprioception, then task.
fn observation(task: &TrackingTask, environment: &TrackingEnvironment) -> (Vec<f32>, Vec<f32>) {
    let mut proprioception = vec![f32::NAN; task.spec().proprioception];
    let mut rest = vec![f32::NAN; task.spec().task];
    environment.observe(&mut proprioception, &mut rest);
    (proprioception, rest)
}

/// Large actions that depend only on the step.
fn wild(step: usize) -> [f32; 56] {
    std::array::from_fn(|joint| (((step * 56 + joint) * 7919) % 2001) as f32 / 1000.0 - 1.0)
}

#[test]
fn the_default_observation_has_the_papers_sizes() {
    let task = task_of(&Tracking::default(), &["walk"]);
    assert_eq!((task.spec().proprioception, task.spec().task, task.spec().action), (205, 1086, 56));
    assert_eq!(task.spec().reward_terms.len(), 5);
}

#[test]
fn the_observation_is_dm_controls_in_the_configured_order() {
    let mut names: Vec<String> = TRACKING_OBSERVATIONS.map(String::from).to_vec();
    names.reverse();
    let task = task_of(&Tracking { observations: names.clone(), ..lenient() }, &["walk"]);
    let mut environment = task.tracking_environment(3);
    for step in 0..5 {
        environment.step(&wild(step));
    }
    let dictionary = environment.dictionary();
    let numbers = |name: &str| {
        let full = format!("walker/{name}");
        dictionary.iter().find(|(known, _)| *known == full).unwrap().1.iter().map(|value| *value as f32)
    };
    let proprioception = [
        "joints_pos",
        "joints_vel",
        "sensors_velocimeter",
        "sensors_gyro",
        "end_effectors_pos",
        "world_zaxis",
        "actuator_activation",
        "sensors_touch",
        "sensors_torque",
    ];
    let expected: (Vec<f32>, Vec<f32>) =
        (proprioception.into_iter().flat_map(numbers).collect(), names.iter().flat_map(|name| numbers(name)).collect());
    assert_eq!(observation(&task, &environment), expected);
    // The learner derives the same sizes without a simulator.
    let spec = TaskSpec::tracking(&Tracking { observations: names, ..lenient() }, task.spec().clips.clone());
    assert_eq!(task.spec(), &spec.unwrap());
}

#[test]
fn an_episode_begins_in_the_clips_pose_with_zero_activations() {
    let task = task_of(&Tracking::default(), &["walk"]);
    let mut environment = task.tracking_environment(0);
    environment.reset_to(0, 17).unwrap();
    let clip = catalogue(&["walk"]).load(0).unwrap();
    let data = environment.simulation();
    assert_eq!(data.qpos()[..3], clip.motion.position[17]);
    assert_eq!(data.qpos()[7..], clip.motion.joints[17]);
    assert_eq!(data.qvel()[3..6], clip.motion.angular_velocity[17]);
    assert!(data.act().iter().all(|value| *value == 0.0));
    assert!(environment.termination_error() < 1e-9);
    assert_eq!((environment.episode().clip, environment.episode().start), (0, 17));
}

#[test]
fn preset_actuators_keep_the_first_step_near_the_reference() {
    let config = Tracking { preset_actuators: true, ..Tracking::default() };
    let after_one_servo_step = |config: &Tracking| {
        let mut environment = task_of(config, &["walk"]).tracking_environment(0);
        environment.reset_to(0, 20).unwrap();
        let mut action = [0.0f32; 56];
        environment.servo_action(&mut action);
        environment.step(&action);
        environment.termination_error()
    };
    assert!(2.0 * after_one_servo_step(&config) < after_one_servo_step(&Tracking::default()));

    let mut environment = task_of(&config, &["walk"]).tracking_environment(0);
    environment.reset_to(0, 20).unwrap();
    let clip = catalogue(&["walk"]).load(0).unwrap();
    assert_eq!(environment.simulation().act(), pose_to_action(&clip.motion.joints[20]));
}

#[test]
fn the_servo_action_aims_at_the_next_frame() {
    let mut environment = task_of(&Tracking::default(), &["run"]).tracking_environment(0);
    environment.reset_to(0, 5).unwrap();
    let clip = catalogue(&["run"]).load(0).unwrap();
    for frame in 6..9 {
        let mut action = [0.0f32; 56];
        environment.servo_action(&mut action);
        assert_eq!(action, pose_to_action(&clip.motion.joints[frame]).map(|value| value as f32));
        environment.step(&action);
    }
}

#[test]
fn an_episode_is_truncated_at_the_clips_end_with_discount_one() {
    let task = task_of(&lenient(), &["walk"]);
    let mut environment = task.tracking_environment(0);
    let last_start = task.starts()[0].frames.end - 1;
    environment.reset_to(0, last_start).unwrap();
    assert_eq!(environment.episode().steps_left, 10);
    for _ in 1..10 {
        assert_eq!(environment.step(&[0.0; 56]).outcome, Outcome::Running);
        assert!(!environment.achievement().success, "an episode that still runs");
    }
    let last = environment.step(&[0.0; 56]);
    assert_eq!((last.outcome, last.discount), (Outcome::Truncated, 1.0));
    assert!(environment.achievement().success, "it lasted to the clip's end");
    environment.reset_to(0, last_start).unwrap();
    assert!(!environment.achievement().success, "the next episode begins without success");
}

#[test]
fn an_episode_is_truncated_at_the_time_limit_with_discount_one() {
    let mut environment = task_of(&Tracking { time_limit: 0.1, ..lenient() }, &["walk"]).tracking_environment(0);
    let outcomes: Vec<_> = (0..4).map(|_| environment.step(&[0.0; 56])).collect();
    assert!(outcomes[..3].iter().all(|step| step.outcome == Outcome::Running));
    assert_eq!((outcomes[3].outcome, outcomes[3].discount), (Outcome::Truncated, 1.0));
}

#[test]
fn an_episode_is_terminated_beyond_the_threshold_with_discount_zero_and_its_reward() {
    let task = task_of(&Tracking::default(), &["walk"]);
    let mut environment = task.tracking_environment(0);
    environment.reset_to(0, 0).unwrap();
    let mut last = None;
    for step in 0..60 {
        let result = environment.step(&wild(step));
        assert_eq!(result.outcome == Outcome::Terminated, environment.termination_error() > 0.3);
        let distance_term = 0.5 * (1.0 - environment.termination_error() / 0.3);
        assert!((result.reward_terms[4] - distance_term).abs() < 1e-15);
        if result.outcome == Outcome::Terminated {
            last = Some(result);
            break;
        }
        assert_eq!(result.discount, 1.0);
    }
    let last = last.unwrap();
    assert_eq!(last.discount, 0.0);
    assert!(last.reward_terms[4] < 0.0 && last.reward_terms[0] > 0.0);
}

#[test]
fn the_reward_of_a_step_is_below_the_maximum() {
    let mut environment =
        task_of(&Tracking { preset_actuators: true, ..Tracking::default() }, &["stand"]).tracking_environment(0);
    let mut action = [0.0f32; 56];
    environment.servo_action(&mut action);
    let reward = environment.step(&action).reward();
    assert!(reward > 0.3 && reward < TRACKING_MAX_REWARD, "{reward}");
}

#[test]
fn an_action_that_is_no_number_diverges_and_a_reset_recovers() {
    let task = task_of(&Tracking::default(), &["walk"]);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut environment = task.tracking_environment(0);
        let mut action = [0.0f32; 56];
        action[13] = bad;
        for attempt in [&action[..], &[0.0; 56]] {
            let step = environment.step(attempt);
            assert_eq!((step.outcome, step.discount, step.reward()), (Outcome::Diverged, 0.0, 0.0));
        }
        let (proprioception, rest) = observation(&task, &environment);
        assert!(proprioception.iter().chain(&rest).all(|value| *value == 0.0));
        environment.reset();
        assert_ne!(environment.step(&[0.0; 56]).outcome, Outcome::Diverged);
    }
}

#[test]
fn an_action_of_another_length_diverges() {
    let mut environment = task_of(&Tracking::default(), &["walk"]).tracking_environment(0);
    assert_eq!(environment.step(&[0.0; 55]).outcome, Outcome::Diverged);
}

#[test]
fn steps_after_the_end_do_not_panic() {
    let mut environment = task_of(&Tracking::default(), &["walk"]).tracking_environment(0);
    for step in 0..400 {
        environment.step(&wild(step));
        assert_eq!(environment.dictionary().len(), 28);
    }
}

#[test]
fn a_seed_decides_every_episode_of_an_environment() {
    let task = task_of(&Tracking::default(), &["walk", "run", "jump"]);
    let episodes = |seed: u64| {
        let mut environment = task.tracking_environment(seed);
        let mut seen = Vec::new();
        for step in 0..40 {
            let result = environment.step(&wild(step));
            if result.outcome != Outcome::Running {
                environment.reset();
            }
            seen.push((environment.episode().clip, environment.episode().start, result.reward().to_bits()));
        }
        seen
    };
    // Other threads with environments of the same model give the same episodes.
    let elsewhere = std::thread::scope(|scope| {
        let threads: Vec<_> = [1, 1, 2].map(|seed| scope.spawn(move || (seed, episodes(seed)))).into_iter().collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect::<Vec<_>>()
    });
    assert_eq!(elsewhere[0].1, episodes(1));
    assert_eq!(elsewhere[1].1, episodes(1));
    assert_ne!(elsewhere[2].1, episodes(1));
}

#[test]
fn episodes_start_at_start_frames_with_enough_steps_left() {
    let task = task_of(&Tracking::default(), &["walk", "run"]);
    let mut environment = task.tracking_environment(5);
    for _ in 0..200 {
        environment.reset();
        let episode = environment.episode();
        assert!(task.starts()[episode.clip].frames.contains(&episode.start));
        assert!(episode.steps_left >= 10);
    }
}

#[test]
fn a_sub_range_behaves_like_a_clip() {
    let source = ClipSource { start_step: 20, end_step: Some(60), ..ClipSource::whole("builtin:walk") };
    let catalogue = Catalogue::open(&[source]).unwrap();
    let task = Arc::new(TrackingTask::new(&lenient(), &catalogue).unwrap());
    assert_eq!(task.starts()[0].frames, 20..45);
    let mut environment = task.tracking_environment(0);
    environment.reset_to(0, 20).unwrap();
    // dm_control's end is inclusive, so these are 41 frames. The last five are only references.
    assert_eq!(environment.episode().steps_left, 35);
    let time = |environment: &TrackingEnvironment| environment.dictionary().pop().unwrap().1[0];
    assert_eq!(time(&environment), 0.0);
    environment.step(&[0.0; 56]);
    assert!((time(&environment) - 1.0 / 40.0).abs() < 1e-12);
    assert!(matches!(environment.reset_to(0, 19), Err(Error::Start { .. })));
    assert!(matches!(environment.reset_to(0, 55), Err(Error::Start { .. })));
    assert!(matches!(environment.reset_to(1, 20), Err(Error::Start { .. })));
}

#[test]
fn an_option_starts_every_episode_at_the_clips_start() {
    let config = Tracking { always_start_at_clip_start: true, ..Tracking::default() };
    let mut environment = task_of(&config, &["walk", "run"]).tracking_environment(9);
    for _ in 0..50 {
        environment.reset();
        assert_eq!(environment.episode().start, 0);
    }
}

#[test]
fn the_supplements_termination_error_is_a_sum_and_dm_controls_a_mean() {
    let run = |kind: TerminationError| {
        let config = Tracking { termination_error: kind, ..lenient() };
        let mut environment = task_of(&config, &["walk"]).tracking_environment(0);
        environment.reset_to(0, 3).unwrap();
        (0..20).map(|step| (environment.step(&wild(step)), environment.termination_error()).1).collect::<Vec<_>>()
    };
    for (sum, mean) in run(TerminationError::Supplement).into_iter().zip(run(TerminationError::DmControl)) {
        // mean = bodies / 186 + joints / 112, sum = bodies + joints.
        assert!(112.0 * mean <= sum * (1.0 + 1e-12) && sum <= 186.0 * mean * (1.0 + 1e-12), "{sum} {mean}");
    }
}

#[test]
fn the_error_of_an_unknown_observation_names_the_nearest() {
    let config = Tracking { observations: vec!["reference_rel_joint".into()], ..Tracking::default() };
    let error = TrackingTask::new(&config, &catalogue(&["walk"])).unwrap_err();
    assert_eq!(
        error.to_string(),
        "tracking.observations: no observation `reference_rel_joint`; did you mean `reference_rel_joints`?"
    );
}

#[test]
fn a_clip_that_is_too_short_for_its_references_is_refused_by_name() {
    let config = Tracking { min_steps: 5000, ..Tracking::default() };
    let error = TrackingTask::new(&config, &catalogue(&["stand"])).unwrap_err();
    assert!(error.to_string().contains("`stand` is too short"), "{error}");
}

#[test]
fn clips_of_the_2019_body_are_compared_but_not_trained_on() {
    let setup = concat!(env!("CARGO_MANIFEST_DIR"), "/../.deps/dm_control").to_string();
    let path = std::env::var("COMIC_DM_CONTROL_DIR").unwrap_or(setup) + "/test_trajectories.h5";
    let catalogue = Catalogue::open(&[ClipSource::whole(path)]).unwrap();
    let config = Tracking { min_steps: 1, ..Tracking::default() };
    let error = TrackingTask::new(&config, &catalogue).unwrap_err();
    assert!(error.to_string().contains("cmuv2019_001"), "{error}");
    let task = Arc::new(TrackingTask::comparison(&config, &catalogue).unwrap());
    assert_eq!(task.spec().proprioception, 149);
    let mut environment = task.tracking_environment(0);
    environment.step(&[0.0; 56]);
    let (proprioception, rest) = observation(&task, &environment);
    assert!(proprioception.iter().chain(&rest).all(|value| value.is_finite()));
}

/// Over 400 starts of training from the 72 frames of a walk: the deviations of the joints' velocities have the standard
/// deviation that the field says, and starts of evaluations have none.
#[test]
fn start_noise_moves_the_starts_of_training_alone() {
    let deviation = |start_noise: f64, training: bool| {
        let task = task_of(&Tracking { start_noise, ..lenient() }, &["walk"]);
        let exact = task_of(&lenient(), &["walk"]);
        let (mut environment, mut reference) = (task.tracking_environment(1), exact.tracking_environment(2));
        let mut squares = 0.0;
        for _ in 0..400 {
            environment.reset();
            let start = environment.episode().start;
            if !training {
                environment.reset_to(0, start).unwrap();
            }
            reference.reset_to(0, start).unwrap();
            let [own, other] = [environment.simulation(), reference.simulation()].map(|data| data.qvel()[6..].to_vec());
            squares += own.iter().zip(other).map(|(one, other)| (one - other).powi(2)).sum::<f64>();
        }
        (squares / (400.0 * 56.0)).sqrt()
    };
    assert_eq!(deviation(0.0, true), 0.0);
    assert_eq!(deviation(2.0, false), 0.0);
    // Twice 0.5 rad/s, of 22,400 draws.
    assert!((deviation(2.0, true) - 1.0).abs() < 0.02);
}

/// The clips and start frames of some episodes of training with wild actions, in which the body falls.
fn starts_of(environment: &mut TrackingEnvironment, episodes: usize) -> Vec<(usize, usize)> {
    let mut starts = Vec::new();
    for _ in 0..episodes {
        environment.reset();
        let episode = environment.episode();
        starts.push((episode.clip, episode.start));
        for step in 0.. {
            if environment.step(&wild(step)).outcome != Outcome::Running {
                break;
            }
        }
    }
    starts
}

#[test]
fn with_starts_by_failures_the_seed_alone_still_decides_the_episodes() {
    let config = Tracking { failure_starts: 0.5, ..Tracking::default() };
    let task = task_of(&config, &["walk", "squat"]);
    let (mut one, mut other) = (task.tracking_environment(1), task.tracking_environment(2));
    // Another history must not matter.
    starts_of(&mut other, 5);
    one.reseed(9);
    other.reseed(9);
    let starts = starts_of(&mut one, 10);
    assert_eq!(starts, starts_of(&mut other, 10));
    assert_ne!(starts, starts_of(&mut task.tracking_environment(10), 10));
}

#[test]
fn an_episode_that_its_caller_ends_counts_as_one_that_did_not_fail() {
    let task = task_of(&Tracking { failure_starts: 1.0, ..lenient() }, &["walk", "squat"]);
    // No episode has an end of its own within so few steps.
    let starts = |steps: usize| -> Vec<Episode> {
        let mut environment = task.tracking_environment(1);
        let mut next = || {
            (0..steps).map(|step| environment.step(&wild(step))).for_each(|_| ());
            environment.reset();
            environment.episode()
        };
        (0..40).map(|_| next()).collect()
    };
    assert_ne!(starts(0), starts(9));
}

#[test]
fn evaluations_do_not_count_as_failures() {
    let config = Tracking { failure_starts: 1.0, ..Tracking::default() };
    let task = task_of(&config, &["walk", "squat"]);
    let (mut one, mut other) = (task.tracking_environment(1), task.tracking_environment(1));
    for start in 0..20 {
        one.reset_to(1, start).unwrap();
        for step in 0.. {
            if one.step(&wild(step)).outcome != Outcome::Running {
                break;
            }
        }
    }
    assert_eq!(starts_of(&mut one, 10), starts_of(&mut other, 10));
}

#[test]
fn without_starts_by_failures_nothing_of_an_episode_changes_the_next_start() {
    let task = task_of(&Tracking::default(), &["walk", "squat"]);
    let (mut one, mut other) = (task.tracking_environment(1), task.tracking_environment(1));
    let mut starts = Vec::new();
    for _ in 0..10 {
        other.reset();
        starts.push((other.episode().clip, other.episode().start));
    }
    assert_eq!(starts_of(&mut one, 10), starts);
}

#[test]
fn an_episode_never_leaves_its_clip() {
    let (config, clips) = (Tracking { failure_starts: 0.5, ..lenient() }, ["run", "walk"]);
    let (task, catalogue) = (task_of(&config, &clips), catalogue(&clips));
    let look_ahead = config.reference_steps.iter().max().unwrap();
    let mut environment = task.tracking_environment(4);
    for _ in 0..30 {
        environment.reset();
        let episode = environment.episode();
        let clip = catalogue.load(episode.clip).unwrap();
        for step in 1.. {
            let outcome = environment.step(&[0.0; 56]).outcome;
            // The reference is the frame of this clip, and of no other, to the last frame of the episode.
            let reference = environment.scenery().reference.unwrap();
            assert_eq!(reference[7..], clip.motion.joints[episode.start + step]);
            if outcome != Outcome::Running {
                assert_eq!(episode.start + step + look_ahead + 1, clip.steps());
                break;
            }
        }
    }
}
