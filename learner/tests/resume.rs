//! A checkpoint holds everything that changes the future: a run that was stopped and resumed ends, bit for bit, where
//! one that was not stopped ends. Actors are replaced by a recorded stream of unrolls.

#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::path::Path;
use std::sync::{Arc, Mutex};

use comic_experiment::{Experiment, TaskSpec, resolve};
use comic_learner::checkpoint::{Snapshot, Store};
use comic_learner::publish::Publisher;
use comic_learner::security::{Limits, Security};
use comic_learner::service::{self, Shared};
use comic_learner::trainer::{Ending, Setup, Trainer};
use comic_proto::v1::UnrollHeader;
use comic_proto::{Field, UnrollBuffer, UnrollLayout, UnrollShape};
use comic_replay::{Batcher, Config, Ledger, Order, Outcome, Phase};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;

const INCARNATION: u64 = 7;
const UPDATES: u64 = 6;

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
        "network.normaliser_steps=100",
        "vmpo.target_period=2",
        "vmpo.gradient_steps=3",
        "vmpo.minibatch_unrolls=4",
        "unroll.length=5",
        "unroll.batch=8",
        "optimiser.learning_rate=1e-2",
    ]
    .map(String::from)
    .to_vec();
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
    unroll
}

/// libtorch's generator, which the networks' first values come from, is the process's.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// One life of the learner, fed with the recording from where its books say; its last checkpoint.
fn live(preset: &str, run: &Path, updates: u64) -> Snapshot {
    let experiment = experiment(preset, updates);
    let spec = spec(&experiment);
    let store = Store::open(run, 3).unwrap();
    let resume = store.newest().unwrap().map(|(_, snapshot)| snapshot);
    let epoch = store.begin_life().unwrap();
    let ledger = resume.as_ref().map_or_else(Ledger::new, |snapshot| {
        Ledger::restore(&serde_json::from_slice(snapshot.part("books.json").unwrap()).unwrap()).unwrap()
    });
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(&spec, &experiment)));
    let config = Config { unrolls: experiment.unroll.batch, max_staleness: 1000, ahead: 1, order: Order::Arrival };
    let batcher = Batcher::new(layout.clone(), config, Phase { epoch, ..Phase::default() }, ledger);
    let publisher = Publisher::new(epoch);
    let shared = Shared::new(service::Setup {
        run: run.to_path_buf(),
        security: Security::default(),
        limits: Limits::default(),
        experiment: experiment.clone(),
        spec: spec.clone(),
        assets: Vec::new(),
        batcher: batcher.clone(),
        publisher: publisher.clone(),
    })
    .unwrap();
    let pose = vec![0.1; spec.action];
    let run = run.to_path_buf();
    let joined = batcher.join(INCARNATION, None).unwrap();
    let feeder = std::thread::spawn({
        let (batcher, layout, spec) = (batcher.clone(), layout.clone(), spec.clone());
        // Exactly what the rest of the run needs, so that the books are the same whoever feeds.
        let batch = experiment.unroll.batch as u64;
        let unrolls = (updates + 1) * batch;
        move || {
            for sequence in joined.next_sequence..unrolls {
                let (actor, incarnation) = (joined.actor, INCARNATION);
                let header = UnrollHeader { actor, incarnation, sequence, learner_epoch: epoch, ..Default::default() };
                let header = UnrollHeader { version: batcher.phase().version, ..header };
                let inserted = batcher.insert(&header, recorded(&layout, &spec, sequence).into_bytes());
                assert_eq!(futures::executor::block_on(inserted), Outcome::Taken);
                // Batch by batch, so that none waits while the trainer changes the terms.
                while (sequence + 1) % batch == 0 && batcher.books().in_flight > 0 {
                    std::thread::yield_now();
                }
            }
        }
    });
    let trainer = Trainer::new(Setup { experiment, spec, pose, run, epoch, resume, batcher, publisher, shared });
    assert_eq!(trainer.unwrap().run().unwrap(), Ending::Budget);
    feeder.join().unwrap();
    store.newest().unwrap().unwrap().1
}

/// Everything but the clock, the count of lives and the budget.
fn comparable(snapshot: &Snapshot) -> Vec<(String, Vec<u8>)> {
    let mut parts: Vec<_> = snapshot.parts.clone().into_iter().filter(|(name, _)| name != "experiment.toml").collect();
    for (name, bytes) in &mut parts {
        if name == "progress.json" {
            let mut progress: serde_json::Value = serde_json::from_slice(bytes).unwrap();
            for passing in ["seconds", "epoch"] {
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
        let expected = live(preset, unbroken.path(), UPDATES);
        live(preset, broken.path(), UPDATES / 2);
        let resumed = live(preset, broken.path(), UPDATES);
        let (expected, resumed) = (comparable(&expected), comparable(&resumed));
        for ((name, expected), (_, resumed)) in expected.iter().zip(&resumed) {
            assert!(expected == resumed, "{preset}: {name} differs after a resume");
        }
        assert_eq!(expected.len(), resumed.len());
    }
}

#[test]
fn training_changes_the_parameters() {
    let _alone = ONE_AT_A_TIME.lock();
    let run = tempfile::tempdir().unwrap();
    let trained = live("tracking-mlp", run.path(), 1);
    let initial = comic_learner::checkpoint::read(&run.path().join("checkpoints/initial")).unwrap();
    assert_ne!(trained.part("policy.safetensors").unwrap(), initial.part("policy.safetensors").unwrap());
}
