//! A checkpoint of which one part is anything: the first byte says which.

#![no_main]

use std::cell::RefCell;
use std::sync::Arc;

use comic_experiment::{Experiment, TaskSpec};
use comic_fuzz::{experiment, layout, seed, spec};
use comic_learner::checkpoint::{Name, Snapshot, Store, read};
use comic_learner::train::statistics::ObservationStatistics;
use comic_learner::tensors;
use comic_learner::vmpo::VmpoLearner;
use comic_networks::to_safetensors;
use comic_replay::{Batcher, Config, Ledger, BatchOrder, Phase};
use libfuzzer_sys::fuzz_target;
use tch::Device;

struct Run {
    directory: tempfile::TempDir,
    sound: Snapshot,
    learner: VmpoLearner,
    statistics: ObservationStatistics,
    spec: TaskSpec,
}

thread_local! {
    static RUN: RefCell<Run> = RefCell::new(run());
}

fn run() -> Run {
    let experiment = experiment();
    let spec = spec(&experiment);
    let learner = VmpoLearner::new(&spec, &experiment, &vec![0.0; spec.action], Device::Cpu).expect("sound networks");
    let statistics = ObservationStatistics::new(&spec);
    let mut state = learner.state();
    state.extend(statistics.state());
    let policy = to_safetensors(learner.policy_store()).expect("parameters are written");
    let config = Config { unrolls: 2, max_staleness: 2, ahead: 0, order: BatchOrder::Arrival };
    let batcher = Batcher::new(Arc::new(layout(&spec, &experiment)), config, Phase::begin(0), with_tasks(Ledger::new(), &spec));
    let text = |written: Result<Vec<u8>, serde_json::Error>| written.expect("JSON is written");
    let parts = [
        ("experiment.toml", experiment.to_toml().expect("an experiment is written").into_bytes()),
        ("task.json", text(serde_json::to_vec(&spec))),
        ("policy.safetensors", policy.clone()),
        ("target.safetensors", policy),
        ("learner.safetensors", tensors::to_bytes(&state).expect("tensors are written")),
        ("progress.json", br#"{"epoch": 2, "version": 30, "updates": 29}"#.to_vec()),
        ("accounting.json", text(serde_json::to_vec(&batcher.snapshot()))),
    ];
    let sound = Snapshot { parts: parts.map(|(name, bytes)| (name.to_owned(), bytes)).into() };
    for (number, (name, bytes)) in sound.parts.iter().enumerate() {
        seed(name, &[&[number as u8], &bytes[..]].concat());
    }
    let directory = tempfile::tempdir().expect("a directory");
    Run { directory, sound, spec, learner, statistics }
}

fuzz_target!(init: {
    RUN.with(|_| ());
}, |bytes: &[u8]| {
    let Some((which, bytes)) = bytes.split_first() else { return };
    RUN.with_borrow_mut(|run| {
        let mut snapshot = run.sound.clone();
        let parts = snapshot.parts.len();
        let which = usize::from(*which) % (parts + 1);
        if let Some(part) = snapshot.parts.values_mut().nth(which) {
            *part = bytes.to_vec();
        }
        let store = Store::open(run.directory.path(), 1).expect("a directory");
        let path = store.write(Name::Updates(1), &snapshot).expect("a disk with room");
        if which == parts {
            std::fs::write(path.join("MANIFEST.json"), bytes).expect("a disk with room");
        }
        let _ = comic_actor::checkpoint::read(run.directory.path());
        if let Ok(snapshot) = read(&path) {
            let _ = resume(run, &snapshot);
        }
    });
});

fn with_tasks(ledger: Ledger, spec: &TaskSpec) -> Ledger {
    ledger.with_tasks(spec.tasks.iter().map(|task| task.name.clone()))
}

/// What a learner makes of each part when it goes on from a checkpoint.
fn resume(run: &mut Run, snapshot: &Snapshot) -> Option<()> {
    Experiment::from_toml("experiment.toml", snapshot.text("experiment.toml").ok()?).ok()?;
    serde_json::from_slice::<TaskSpec>(snapshot.part("task.json").ok()?).ok()?;
    let ledger = Ledger::restore(&serde_json::from_slice(snapshot.part("accounting.json").ok()?).ok()?).ok()?;
    let _ = with_tasks(ledger, &run.spec).join(1, None);
    let mut state = tensors::from_bytes(snapshot.part("learner.safetensors").ok()?).ok()?;
    run.statistics.restore(&mut state).ok()?;
    run.learner.load_state(&state).ok()
}
