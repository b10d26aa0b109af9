//! A checkpoint with one random part, which the first byte chooses.

#![no_main]

use std::cell::RefCell;
use std::sync::Arc;

use comic_experiment::{Experiment, TaskSpec};
use comic_fuzz::{experiment, layout, seed, spec};
use comic_learner::algorithm::Algorithm as _;
use comic_learner::checkpoint::{Name, Snapshot, Store, read};
use comic_learner::tensors;
use comic_learner::train::statistics::ObservationStatistics;
use comic_learner::vmpo::VmpoLearner;
use comic_networks::to_safetensors;
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Phase};
use libfuzzer_sys::fuzz_target;
use tch::Device;

struct Run {
    directory: tempfile::TempDir,
    valid: Snapshot,
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
    let learner = VmpoLearner::new(&spec, &experiment, &vec![0.0; spec.action], Device::Cpu).expect("valid networks");
    let statistics = ObservationStatistics::new(&spec);
    let mut state = learner.state();
    state.extend(statistics.state());
    let policy = to_safetensors(learner.policy_store()).expect("parameters can be written");
    let config = Config { unrolls: 2, max_staleness: 2, ahead: 0, order: BatchOrder::Arrival };
    let batcher =
        Batcher::new(Arc::new(layout(&spec, &experiment)), config, Phase::begin(0), with_tasks(Ledger::new(), &spec));
    let text = |written: Result<Vec<u8>, serde_json::Error>| written.expect("JSON can be written");
    let parts = [
        ("experiment.toml", experiment.to_toml().expect("an experiment can be written").into_bytes()),
        ("task.json", text(serde_json::to_vec(&spec))),
        ("policy.safetensors", policy.clone()),
        ("target.safetensors", policy),
        ("learner.safetensors", tensors::to_bytes(&state).expect("tensors can be written")),
        ("progress.json", br#"{"format": 2, "epoch": 2, "version": 30, "updates": 29}"#.to_vec()),
        ("accounting.json", text(serde_json::to_vec(&batcher.snapshot()))),
    ];
    let valid = Snapshot { parts: parts.map(|(name, bytes)| (name.to_owned(), bytes)).into() };
    for (number, (name, bytes)) in valid.parts.iter().enumerate() {
        seed(name, &[&[number as u8], &bytes[..]].concat());
    }
    let directory = tempfile::tempdir().expect("a temporary directory");
    Run { directory, valid, spec, learner, statistics }
}

fuzz_target!(init: {
    RUN.with(|_| ());
}, |bytes: &[u8]| {
    let Some((which, bytes)) = bytes.split_first() else { return };
    RUN.with_borrow_mut(|run| {
        let mut snapshot = run.valid.clone();
        let parts = snapshot.parts.len();
        let which = usize::from(*which) % (parts + 1);
        if let Some(part) = snapshot.parts.values_mut().nth(which) {
            *part = bytes.to_vec();
        }
        let store = Store::open(run.directory.path(), 1).expect("a temporary directory");
        let path = store.write(Name::Updates(1), &snapshot).expect("space on the disk");
        if which == parts {
            std::fs::write(path.join("MANIFEST.json"), bytes).expect("space on the disk");
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

/// Reads each part as a learner does that resumes from the checkpoint.
fn resume(run: &mut Run, snapshot: &Snapshot) -> Option<()> {
    Experiment::from_toml("experiment.toml", snapshot.text("experiment.toml").ok()?).ok()?;
    serde_json::from_slice::<TaskSpec>(snapshot.part("task.json").ok()?).ok()?;
    let ledger = Ledger::restore(&serde_json::from_slice(snapshot.part("accounting.json").ok()?).ok()?).ok()?;
    let _ = with_tasks(ledger, &run.spec).join(1, None);
    let mut state = tensors::from_bytes(snapshot.part("learner.safetensors").ok()?).ok()?;
    run.statistics.restore(&mut state).ok()?;
    run.learner.load_state(&state).ok()
}
