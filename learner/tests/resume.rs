//! A checkpoint holds everything that changes the future: a run that was stopped and resumed ends, bit for bit, where
//! one that was not stopped ends. Actors are replaced by a recorded stream of unrolls.

#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::path::Path;
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use comic_experiment::{Experiment, TaskSpec, resolve};
use comic_learner::checkpoint::{Snapshot, Store, find, read};
use comic_learner::device::Backend;
use comic_learner::observe::probes::Probed as _;
use comic_learner::publish::{Published, Publisher};
use comic_learner::train::parts::{Ending, TrainerParts};
use comic_learner::train::trainer::Trainer;
use comic_learner::world::World;
use comic_proto::v1::{EvaluationReport, UnrollHeader};
use comic_proto::{Field, UnrollBuffer, UnrollLayout, UnrollShape};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Outcome, Phase};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;

mod open_service;

use open_service::open_service;

const INCARNATION: u64 = 7;
const UPDATES: u64 = 6;
/// Steps an unroll.
const LENGTH: usize = 5;
/// Unrolls a batch.
const BATCH: u64 = 8;

/// What each preset adds to be small.
const PRESETS: [(&str, &[&str]); 5] = [
    ("tracking-mlp", &["network.mlp.hidden=[16]"]),
    ("tracking-lstm", &["network.lstm.units=[8, 6]", "network.value_lstm=[6]", "vmpo.value_burn_in=1"]),
    ("tracking-mixture", &["network.primitives.torso=[16]", "network.primitives.hidden=8"]),
    ("tracking-product", &["network.primitives.torso=[16]", "network.primitives.hidden=8"]),
    ("joint-get-up", &["network.mlp.hidden=[16]"]),
];

fn experiment(preset: &str, updates: u64) -> Experiment {
    let mut overrides: Vec<String> = [
        "network.encoder=[16]",
        "network.value=[16]",
        // More than there are rows in half of the updates: where the run is resumed, statistics wait for the next publication.
        "network.normaliser_steps=200",
        "vmpo.target_period=2",
        "vmpo.gradient_steps=3",
        "vmpo.minibatch_unrolls=4",
        "optimiser.learning_rate=1e-2",
    ]
    .map(String::from)
    .to_vec();
    overrides.push(format!("unroll.length={LENGTH}"));
    overrides.push(format!("unroll.batch={BATCH}"));
    overrides.push(format!("budget.updates={updates}"));
    let own = PRESETS.iter().find(|(name, _)| *name == preset).map_or(&[][..], |(_, own)| own);
    overrides.extend(own.iter().map(ToString::to_string));
    let mut experiment = resolve(preset, &overrides).unwrap();
    // A bottleneck where the preset has one.
    experiment.network.latent.size = experiment.network.latent.size.min(4);
    experiment
}

fn spec(experiment: &Experiment) -> TaskSpec {
    TaskSpec::new(experiment, vec!["a".into(), "b".into()]).unwrap()
}

/// The `sequence`-th unroll of the recording: the same numbers whenever it is asked for.
fn recorded(layout: &UnrollLayout, spec: &TaskSpec, sequence: u64) -> UnrollBuffer {
    let task = sequence as usize % spec.tasks.len();
    let first_clip: usize = spec.tasks[..task].iter().map(|task| task.clips).sum();
    let clips = first_clip as u32..(first_clip + spec.tasks[task].clips) as u32;
    let mut random = Pcg64::seed_from_u64(sequence);
    let mut unroll = UnrollBuffer::new(layout);
    for field in Field::ALL {
        for t in 0..layout.rows(field) {
            match field {
                Field::Clip => unroll.set_clip(t, random.random_range(clips.clone())),
                Field::Valid | Field::Discount => unroll.row_mut(field, t).fill(1.0),
                Field::First => {}
                Field::LogWeights => {
                    let even = -(layout.width(field) as f32).ln();
                    unroll.row_mut(field, t).fill(even);
                }
                Field::Std => unroll.row_mut(field, t).fill(0.5),
                _ => unroll.row_mut(field, t).fill_with(|| random.random_range(-1.0..1.0)),
            }
        }
    }
    // Episodes end inside of some, and some are padding from there on.
    let row = 1 + sequence as usize % (LENGTH - 2);
    let ends = match sequence % 4 {
        1 => row..row + 1,
        3 => row..LENGTH,
        _ => 0..0,
    };
    for t in ends {
        unroll.row_mut(Field::Valid, t).fill(0.0);
        unroll.row_mut(Field::First, t + 1).fill(1.0);
    }
    unroll
}

/// The whole process shares libtorch's generator, which makes the networks' first values.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// An epoch of the learner that is over.
struct Epoch {
    ended: comic_learner::error::Result<Ending>,
    /// The parameters that actors would act with.
    published: Arc<Published>,
    prometheus: String,
}

/// One epoch of the learner, fed with the recording from the end of its accounting up to `unrolls`, altered.
fn live(experiment: &Experiment, run: &Path, unrolls: u64, alter: fn(u64, &mut UnrollBuffer)) -> Epoch {
    live_evaluated(experiment, run, unrolls, alter, &[])
}

/// The same; these evaluations are reported at its beginning.
fn live_evaluated(
    experiment: &Experiment,
    run: &Path,
    unrolls: u64,
    alter: fn(u64, &mut UnrollBuffer),
    evaluations: &[EvaluationReport],
) -> Epoch {
    let experiment = experiment.clone();
    let spec = spec(&experiment);
    let store = Store::open(run, 3).unwrap();
    let resume = store.newest().unwrap().map(|(_, snapshot)| snapshot);
    let epoch = store.begin_epoch().unwrap();
    let ledger = resume.as_ref().map_or_else(Ledger::new, |snapshot| {
        Ledger::restore(&serde_json::from_slice(snapshot.part("accounting.json").unwrap()).unwrap()).unwrap()
    });
    let ledger = ledger.with_tasks(spec.tasks.iter().map(|task| task.name.clone()));
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(&spec, &experiment)));
    let config = Config { unrolls: experiment.unroll.batch, max_staleness: 1000, ahead: 1, order: BatchOrder::Arrival };
    let batcher = Batcher::new(layout.clone(), config, Phase::begin(epoch), ledger);
    let publisher = Publisher::new(epoch);
    let service = open_service(run, store.run().unwrap(), &experiment, &spec, &batcher, &publisher);
    evaluations.iter().for_each(|report| service.evaluations().report(report.clone()).unwrap());
    let pose = vec![0.1; spec.action];
    let run = run.to_path_buf();
    let joined = batcher.join(INCARNATION, None).unwrap();
    let feeder = std::thread::spawn({
        let (batcher, layout, spec) = (batcher.clone(), layout.clone(), spec.clone());
        let batch = experiment.unroll.batch as u64;
        move || {
            for sequence in joined.next_sequence..unrolls {
                let (actor, incarnation) = (joined.actor, INCARNATION);
                let header = UnrollHeader { actor, incarnation, sequence, learner_epoch: epoch, ..Default::default() };
                let task = (sequence % spec.tasks.len() as u64) as u32;
                let header = UnrollHeader { version: batcher.phase().version, task, ..header };
                let mut unroll = recorded(&layout, &spec, sequence);
                alter(sequence, &mut unroll);
                match futures::executor::block_on(batcher.insert(&header, unroll.into_bytes())) {
                    Outcome::Taken => {}
                    Outcome::Closed => break,
                    other => panic!("{other:?}"),
                }
                // Batch by batch, so that no unroll waits while the trainer changes the phase.
                while (sequence + 1) % batch == 0 && batcher.accounting().in_flight > 0 && !batcher.is_closed() {
                    std::thread::yield_now();
                }
            }
        }
    });
    let parts = TrainerParts {
        experiment,
        spec,
        pose,
        low_level: None,
        backend: Backend::cpu(),
        world: World::alone(),
        run,
        epoch,
        resume,
        batcher: batcher.clone(),
        publisher: publisher.clone(),
        service: service.trainer(),
    };
    let ended = Trainer::new(parts).unwrap().run();
    batcher.close();
    feeder.join().unwrap();
    Epoch { ended, published: publisher.newest().unwrap(), prometheus: service.probed().metrics_page() }
}

/// The last checkpoint after so many updates of a preset.
fn trained(preset: &str, run: &Path, updates: u64) -> Snapshot {
    trained_on(&experiment(preset, updates), run, updates)
}

/// The same of an experiment. The feeder gives exactly the unrolls that the updates need, so that the accounting is the same in
/// every run.
fn trained_on(experiment: &Experiment, run: &Path, updates: u64) -> Snapshot {
    let unrolls = (updates + 1) * experiment.unroll.batch as u64;
    assert_eq!(live(experiment, run, unrolls, |_, _| {}).ended.unwrap(), Ending::Budget);
    last_checkpoint(run)
}

fn last_checkpoint(run: &Path) -> Snapshot {
    Store::open(run, 3).unwrap().newest().unwrap().unwrap().1
}

/// Everything but the clock, the epoch, the run's number and the budget.
fn comparable(snapshot: &Snapshot) -> Vec<(String, Vec<u8>)> {
    let mut parts: Vec<_> = snapshot.parts.clone().into_iter().filter(|(name, _)| name != "experiment.toml").collect();
    for (name, bytes) in &mut parts {
        if name == "progress.json" {
            let mut progress: serde_json::Value = serde_json::from_slice(bytes).unwrap();
            for passing in ["seconds", "epoch", "run"] {
                progress.as_object_mut().unwrap().remove(passing);
            }
            *bytes = progress.to_string().into_bytes();
        }
    }
    parts
}

#[test]
fn a_resumed_run_ends_bit_for_bit_where_an_unbroken_one_ends() {
    let _alone = ONE_AT_A_TIME.lock();
    // libtorch's sums depend on its threads.
    tch::set_num_threads(1);
    for (preset, _) in PRESETS {
        let (unbroken, broken) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let expected = trained(preset, unbroken.path(), UPDATES);
        trained(preset, broken.path(), UPDATES / 2);
        let resumed = trained(preset, broken.path(), UPDATES);
        let (expected, resumed) = (comparable(&expected), comparable(&resumed));
        for ((name, expected), (_, resumed)) in expected.iter().zip(&resumed) {
            assert!(expected == resumed, "{preset}: {name} differs after a resume");
        }
        assert_eq!(expected.len(), resumed.len());
    }
}

/// SVG(0) with a replay of twenty unrolls, which is full after three batches. In lockstep, so that whole batches enter.
fn off_policy(updates: u64, saves: bool) -> Experiment {
    let mut overrides: Vec<String> = [
        "algorithm=svg0",
        "svg0.encoder=[8]",
        "svg0.core=6",
        "svg0.policy=5",
        "svg0.action_value=[8]",
        "svg0.burn_in=1",
        "svg0.minibatch_sequences=4",
        "svg0.target_period=3",
        "svg0.publish_period=3",
        "network.normaliser_steps=100",
        "replay.max_size=100",
        "replay.min_size=60",
        "replay.samples_per_insert=2",
        "unroll.lockstep=true",
        "unroll.ahead=0",
        "budget.minutes=0",
    ]
    .map(String::from)
    .to_vec();
    overrides.push(format!("replay.save={saves}"));
    overrides.push(format!("unroll.length={LENGTH}"));
    overrides.push(format!("unroll.batch={BATCH}"));
    overrides.push(format!("budget.updates={updates}"));
    resolve("go-to-target", &overrides).unwrap()
}

#[test]
fn a_resumed_run_with_a_saved_replay_ends_bit_for_bit_where_an_unbroken_one_ends() {
    let _alone = ONE_AT_A_TIME.lock();
    tch::set_num_threads(1);
    let [unbroken, broken, forgetful] = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let expected = trained_on(&off_policy(UPDATES, true), unbroken.path(), UPDATES);
    let ended = |run: &Path, saves: bool| {
        trained_on(&off_policy(UPDATES - 2, saves), run, UPDATES - 2);
        trained_on(&off_policy(UPDATES, saves), run, UPDATES)
    };
    let resumed = ended(broken.path(), true);
    assert_eq!(resumed.parts.len(), expected.parts.len());
    for ((name, expected), (_, resumed)) in comparable(&expected).iter().zip(&comparable(&resumed)) {
        assert!(expected == resumed, "{name} differs after a resume");
    }
    // One copy, that of the last checkpoint.
    let copies = std::fs::read_dir(broken.path().join("checkpoints")).unwrap();
    let copies: Vec<_> = copies.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    let copies: Vec<_> = copies.iter().filter(|name| name.starts_with("replay-")).collect();
    assert_eq!(copies, [&format!("replay-{UPDATES:010}")]);
    // Without it, learning begins again with an empty replay.
    let lost = ended(forgetful.path(), false);
    assert_ne!(lost.part("policy.safetensors").unwrap(), expected.part("policy.safetensors").unwrap());
}

/// As actors use it: unrolls enter as they arrive, and the rate limiter decides.
#[test]
fn off_policy_learning_goes_on_without_lockstep_also_with_other_numbers_after_a_resume() {
    let _alone = ONE_AT_A_TIME.lock();
    let run = tempfile::tempdir().unwrap();
    for (updates, samples_per_insert) in [(12, 2.0), (24, 8.0), (36, 0.5)] {
        let mut experiment = off_policy(updates, true);
        experiment.unroll.lockstep = false;
        experiment.replay.samples_per_insert = samples_per_insert;
        let Epoch { ended, prometheus: telemetry, .. } = live(&experiment, run.path(), u64::MAX, |_, _| {});
        assert_eq!(ended.unwrap(), Ending::Budget);
        let shown = |name: &str| {
            let line = telemetry.lines().find_map(|line| line.strip_prefix(name)).unwrap();
            line.trim().parse::<f64>().unwrap()
        };
        assert!(shown("comic_gradient_steps_total") > 0.0, "{telemetry}");
        let lines = std::fs::read_to_string(run.path().join("metrics.jsonl")).unwrap();
        let line: serde_json::Value = serde_json::from_str(lines.lines().last().unwrap()).unwrap();
        assert_eq!(line["replay"]["inserted"], line["accounting"]["trained"], "{line}");
        // The batch that set the normaliser's first scale.
        assert_eq!(line["accounting"]["dropped"]["superseded"], BATCH, "{line}");
    }
}

#[test]
fn training_changes_the_parameters() {
    let _alone = ONE_AT_A_TIME.lock();
    let run = tempfile::tempdir().unwrap();
    let trained = trained("tracking-mlp", run.path(), 1);
    let initial = read(&run.path().join("checkpoints/initial")).unwrap();
    assert_ne!(trained.part("policy.safetensors").unwrap(), initial.part("policy.safetensors").unwrap());
}

#[test]
fn the_checkpoint_of_the_best_evaluation_outlives_the_newest_few() {
    let _alone = ONE_AT_A_TIME.lock();
    let run = tempfile::tempdir().unwrap();
    let checkpoints = run.path().join("checkpoints");
    let epoch = |updates: u64, report: &str| {
        let experiment = experiment("tracking-mlp", updates);
        // The first run of the learner is epoch 1.
        let number = Store::open(run.path(), 3).unwrap().run().unwrap();
        let evaluation = EvaluationReport {
            run: Some(number),
            learner_epoch: 1,
            version: 2,
            updates: 1,
            json: report.into(),
            ..EvaluationReport::default()
        };
        let unrolls = (updates + 1) * BATCH;
        live_evaluated(&experiment, run.path(), unrolls, |_, _| {}, &[evaluation]).ended.unwrap();
    };
    epoch(1, "[]");
    assert!(!checkpoints.join("best.json").exists(), "that report has no mean");
    for updates in 2..6 {
        epoch(updates, r#"{"overall": {"normalised_reward": 0.25}}"#);
    }
    let best = find(&checkpoints.join("best")).unwrap().1;
    assert_eq!(best, read(&checkpoints.join("checkpoint-0000000001")).unwrap());
    assert!(!checkpoints.join("checkpoint-0000000002").exists());
    assert_eq!(std::fs::read_to_string(run.path().join("evaluations.jsonl")).unwrap().lines().count(), 5);
}

/// Rewards whose squares overflow; the wire would not let them through.
fn poison(_: u64, unroll: &mut UnrollBuffer) {
    for t in 0..LENGTH {
        unroll.row_mut(Field::Reward, t).fill(1e30);
    }
}

/// Without a normaliser, so that the first batch is learnt from: one step and one version for each update. Four skipped
/// steps restore the last good state.
fn delicate(updates: u64) -> Experiment {
    let mut experiment = experiment("tracking-mlp", updates);
    experiment.network.normaliser_steps = 0;
    experiment.vmpo.gradient_steps = 1;
    experiment.vmpo.target_period = 1;
    experiment.learner.restore_after = 4;
    experiment
}

#[test]
fn after_too_many_skipped_steps_the_last_good_state_is_restored() {
    let _alone = ONE_AT_A_TIME.lock();
    tch::set_num_threads(1);
    let run = tempfile::tempdir().unwrap();
    // Three batches as they were recorded, then nothing but poison.
    let Epoch { ended, published, prometheus } = live(&delicate(3 + 4), run.path(), u64::MAX, |sequence, unroll| {
        if sequence >= 3 * BATCH {
            poison(sequence, unroll);
        }
    });
    assert_eq!(ended.unwrap(), Ending::Budget);
    assert!(page(run.path()).contains("\"state\":\"over\""));
    let initial = read(&run.path().join("checkpoints/initial")).unwrap();
    let last = last_checkpoint(run.path());
    for part in ["learner.safetensors", "policy.safetensors"] {
        assert!(last.part(part).unwrap() == initial.part(part).unwrap(), "{part} is not the last good one");
    }
    // Three updates, and the one that restored: none of the skipped ones published anything.
    assert_eq!(published.version, 1 + 3 + 1);
    assert!(published.frames() == frames_of(&published, &initial));
    assert!(prometheus.contains("comic_updates_skipped_total 4\n") && prometheus.contains("comic_restores_total 1\n"));
}

fn page(run: &Path) -> String {
    std::fs::read_to_string(run.join("index.html")).unwrap()
}

#[test]
fn if_the_last_good_state_does_not_help_training_ends_and_names_the_remedies() {
    let _alone = ONE_AT_A_TIME.lock();
    let run = tempfile::tempdir().unwrap();
    let Epoch { ended, prometheus, .. } = live(&delicate(100), run.path(), u64::MAX, poison);
    let said = format!("{:#}", ended.unwrap_err());
    assert!(said.contains("optimiser.learning_rate") && said.contains("update 7"), "{said}");
    assert!(prometheus.contains("comic_restores_total 1\n"), "{prometheus}");
    assert!(page(run.path()).contains("\"state\":\"failed\""), "the page of the run goes on");
}

#[test]
fn a_learning_rate_that_makes_parameters_infinite_ends_training() {
    let _alone = ONE_AT_A_TIME.lock();
    let run = tempfile::tempdir().unwrap();
    let mut experiment = delicate(1000);
    experiment.optimiser.learning_rate = 1e38;
    let Epoch { ended, published, .. } = live(&experiment, run.path(), u64::MAX, |_, _| {});
    assert!(ended.is_err());
    let initial = read(&run.path().join("checkpoints/initial")).unwrap();
    assert!(published.frames() == frames_of(&published, &initial), "infinite parameters were published");
}

/// The frames of this version, if it had a checkpoint's parameters.
fn frames_of(version: &Published, checkpoint: &Snapshot) -> Vec<Bytes> {
    // The first epoch of a run.
    let publisher = Publisher::new(1);
    let parameters = Bytes::copy_from_slice(checkpoint.part("policy.safetensors").unwrap());
    publisher.publish(version.version, &parameters);
    publisher.newest().unwrap().frames().to_vec()
}
