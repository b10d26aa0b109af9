//! The normaliser takes effect with a publication, for learner and actors at the same time. At learning rate 0 the behaviour
//! policy is then the online policy in every gradient step, although the statistics of the observations grow with every batch.

#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::path::Path;
use std::sync::Arc;

use comic_experiment::{Experiment, TaskSpec, resolve};
use comic_learner::checkpoint::Store;
use comic_learner::device::Backend;
use comic_learner::publish::{Published, Publisher};
use comic_learner::tensors;
use comic_learner::train::parts::{Ending, TrainerParts};
use comic_learner::train::trainer::Trainer;
use comic_learner::world::World;
use comic_networks::{Policy as _, RecurrentState, Routing, VmpoPolicy, from_safetensors};
use comic_proto::v1::{ParametersChunk, UnrollHeader};
use comic_proto::{Field, UnrollBuffer, UnrollLayout, UnrollShape};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Outcome, Phase};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;
use serde_json::Value;
use tch::{Device, Kind, Tensor, nn};
use tonic_prost::prost::Message as _;

mod open_service;

use open_service::open_service;

/// Steps an unroll.
const LENGTH: usize = 5;
/// Unrolls a batch.
const BATCH: u64 = 8;
/// Updates from one publication to the next.
const PERIOD: u64 = 3;
/// Three publications, and two updates after the last one.
const UPDATES: u64 = 3 * PERIOD + 2;
const INCARNATION: u64 = 7;

/// Of `preset` with small networks, with statistics that never cease to grow, and with a line of metrics after every update.
fn experiment(preset: &str, own: &[&str]) -> Experiment {
    let common = [
        "network.normaliser_steps=1000000",
        &format!("unroll.length={LENGTH}"),
        &format!("unroll.batch={BATCH}"),
        "budget.minutes=0",
        &format!("budget.updates={UPDATES}"),
    ]
    .map(String::from);
    let own = own.iter().map(ToString::to_string);
    let mut experiment = resolve(preset, &own.chain(common).collect::<Vec<_>>()).unwrap();
    // The document refuses both, because neither is of use in a run.
    (experiment.optimiser.learning_rate, experiment.learner.metrics_seconds) = (0.0, 0.0);
    experiment
}

fn vmpo() -> Experiment {
    let period = format!("vmpo.target_period={PERIOD}");
    let sizes = ["network.encoder=[16]", "network.value=[16]", "network.mlp.hidden=[16]", "network.latent.size=4"];
    let steps = ["vmpo.gradient_steps=4", "vmpo.minibatch_unrolls=4", &period];
    experiment("tracking-mlp", &[&sizes[..], &steps[..]].concat())
}

fn svg0() -> Experiment {
    let sizes = ["svg0.encoder=[8]", "svg0.core=6", "svg0.policy=5", "svg0.action_value=[8]", "svg0.burn_in=1"];
    // Four gradient steps a batch, so every third update publishes.
    let steps = ["svg0.minibatch_sequences=4", "svg0.publish_period=12", "svg0.target_period=3"];
    let replay = ["replay.max_size=1000", "replay.min_size=40", "replay.samples_per_insert=2"];
    let lockstep = ["unroll.lockstep=true", "unroll.ahead=0"];
    experiment("go-to-target", &[&["algorithm=svg0"][..], &sizes, &steps, &replay, &lockstep].concat())
}

/// The parameters as an actor receives them.
fn received(published: &Published) -> Vec<u8> {
    // gRPC's prefix: a byte that says whether the message is compressed, and four of its length.
    let chunk = |frame: &bytes::Bytes| ParametersChunk::decode(&frame[5..]).unwrap();
    published.frames().iter().flat_map(|frame| chunk(frame).data).collect()
}

/// Observations whose mean and deviation grow with every batch, and noise.
fn observed(layout: &UnrollLayout, sequence: u64) -> UnrollBuffer {
    let mut random = Pcg64::seed_from_u64(sequence);
    let mut unroll = UnrollBuffer::new(layout);
    let batch = (sequence / BATCH) as f32;
    for field in Field::ALL {
        for t in 0..layout.rows(field) {
            match field {
                Field::Clip => unroll.set_clip(t, 0),
                Field::Valid | Field::Discount => unroll.row_mut(field, t).fill(1.0),
                Field::Std => unroll.row_mut(field, t).fill(0.5),
                Field::Proprioception | Field::Task => {
                    unroll.row_mut(field, t).fill_with(|| 0.3 * batch + (1.0 + batch) * random.random_range(-1.0..1.0));
                }
                Field::First | Field::LogWeights | Field::Image => {}
                _ => unroll.row_mut(field, t).fill_with(|| random.random_range(-1.0..1.0)),
            }
        }
    }
    unroll
}

/// Decides on the actions as an actor with these parameters does: one step at a time.
fn act(unroll: &mut UnrollBuffer, parameters: &[u8], spec: &TaskSpec, experiment: &Experiment) {
    let mut store = nn::VarStore::new(Device::Cpu);
    let policy = VmpoPolicy::of(&store.root(), spec, experiment, &vec![0.0; spec.action]).unwrap();
    from_safetensors(&mut store, parameters).unwrap();
    for t in 0..LENGTH {
        let row = |field| Tensor::from_slice(unroll.row(field, t)).unsqueeze(0);
        let (previous, noise) = (row(Field::PreviousLatent), row(Field::LatentNoise));
        let (proprioception, task) = (row(Field::Proprioception), row(Field::Task));
        let (mean, std, _) = tch::no_grad(|| {
            let observation = policy.normalise(&proprioception, &task, None, &Routing::single());
            let state = RecurrentState { state: &proprioception.narrow(1, 0, 0), first: None };
            policy.act(&observation, &previous, &noise, state).action.to_rows()
        });
        for (field, values) in [(Field::Mean, &mean), (Field::Std, &std), (Field::Action, &(&mean + &std * 0.3))] {
            let values: Vec<f32> = values.reshape([-1]).try_into().unwrap();
            unroll.row_mut(field, t).copy_from_slice(&values);
        }
    }
}

/// Trains from the beginning to the end of the budget. `decide` gets every unroll with the newest published parameters. Returns
/// these parameters, once for each version.
fn train(
    run: &Path,
    experiment: &Experiment,
    decide: impl Fn(&mut UnrollBuffer, &[u8], &TaskSpec) + Send + 'static,
) -> Vec<Vec<u8>> {
    tch::set_num_threads(1);
    let experiment = experiment.clone();
    let spec = TaskSpec::new(&experiment, vec!["a".into()]).unwrap();
    let store = Store::open(run, 3).unwrap();
    let epoch = store.begin_epoch().unwrap();
    let ledger = Ledger::new().with_tasks(spec.tasks.iter().map(|task| task.name.clone()));
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(&spec, &experiment)));
    let order = if experiment.unroll.lockstep { BatchOrder::Environment } else { BatchOrder::Arrival };
    let config = Config { unrolls: experiment.unroll.batch, max_staleness: 0, ahead: 0, order };
    let batcher = Batcher::new(layout.clone(), config, Phase::begin(epoch), ledger);
    let publisher = Publisher::new(epoch);
    let service = open_service(run, store.run().unwrap(), &experiment, &spec, &batcher, &publisher);
    let joined = batcher.join(INCARNATION, None).unwrap();
    let parts = TrainerParts {
        pose: vec![0.0; spec.action],
        low_level: None,
        backend: Backend::cpu(),
        world: World::alone(),
        run: run.to_path_buf(),
        epoch,
        resume: None,
        batcher: batcher.clone(),
        publisher: publisher.clone(),
        service: service.trainer(),
        experiment,
        spec: spec.clone(),
    };
    let actor = std::thread::spawn({
        let batcher = batcher.clone();
        move || {
            let (mut versions, mut newest) = (Vec::new(), 0);
            for sequence in 0.. {
                // Batch by batch. The trainer publishes before it gives up a batch.
                while !batcher.is_closed()
                    && (publisher.newest().is_none() || sequence % BATCH == 0 && batcher.accounting().in_flight > 0)
                {
                    std::thread::yield_now();
                }
                let Some(published) = publisher.newest() else { break };
                if published.version > newest {
                    newest = published.version;
                    versions.push(received(&published));
                }
                let mut unroll = observed(&layout, sequence);
                decide(&mut unroll, versions.last().unwrap(), &spec);
                let header = UnrollHeader {
                    actor: joined.actor,
                    incarnation: INCARNATION,
                    sequence,
                    environment: (sequence % BATCH) as u32,
                    learner_epoch: epoch,
                    version: newest,
                    ..UnrollHeader::default()
                };
                match futures::executor::block_on(batcher.insert(&header, unroll.into_bytes())) {
                    Outcome::Taken => {}
                    Outcome::Closed => break,
                    other => panic!("{other:?}"),
                }
            }
            versions
        }
    });
    let ended = Trainer::new(parts).unwrap().run();
    batcher.close();
    let versions = actor.join().unwrap();
    assert_eq!(ended.unwrap(), Ending::Budget);
    versions
}

#[test]
fn at_learning_rate_zero_every_update_sees_the_behaviour_policy() {
    let run = tempfile::tempdir().unwrap();
    let experiment = vmpo();
    let versions = train(run.path(), &experiment.clone(), move |unroll, parameters, spec| {
        act(unroll, parameters, spec, &experiment);
    });
    // The one before the first batch, the one with its scale, and one of every period.
    assert_eq!(versions.len() as u64, 2 + UPDATES / PERIOD);
    assert!(versions.windows(2).all(|pair| pair[0] != pair[1]), "a version has the normaliser of the one before it");
    let lines = std::fs::read_to_string(run.path().join("metrics.jsonl")).unwrap();
    let lines = lines.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let mut seen = 0;
    for line in lines.filter(|line| line["updates"].as_u64().unwrap() > 0) {
        seen = seen.max(line["updates"].as_u64().unwrap());
        for name in ["kl_mean", "kl_std"] {
            let kl = line["losses"][name].as_f64().unwrap();
            assert!(kl.abs() <= 1e-6, "{name} is {kl} in update {seen}, although nothing is learned");
        }
    }
    assert_eq!(seen, UPDATES, "every update was looked at");
}

/// Between two publications, at learning rate 0, the last checkpoint has the online policy that is published, and statistics
/// of more observations than it normalises by.
fn assert_collected_and_not_in_effect(experiment: &Experiment) {
    let run = tempfile::tempdir().unwrap();
    let versions = train(run.path(), experiment, |_, _, _| {});
    let (_, last) = Store::open(run.path(), 3).unwrap().newest().unwrap().unwrap();
    let [online, target] = ["policy.safetensors", "target.safetensors"].map(|part| last.part(part).unwrap());
    assert!(online == target, "the online policy is not the published one");
    assert!(versions.last().unwrap() == target, "actors have other parameters");
    let state = tensors::from_bytes(last.part("learner.safetensors").unwrap()).unwrap();
    let mean =
        |name: &str| state.iter().find(|(found, _)| found == name).unwrap().1.mean(Kind::Double).double_value(&[]);
    let in_effect = mean("policy.normaliser.proprioception_mean");
    let [sum, count] = ["sum", "count"].map(|name| mean(&format!("statistics.proprioception.{name}")));
    assert!(in_effect != 0.0 && sum / count > in_effect + 0.1, "{sum} of {count} rows, normalised by {in_effect}");
}

#[test]
fn vmpo_collects_statistics_that_take_effect_with_the_next_publication() {
    assert_collected_and_not_in_effect(&vmpo());
}

#[test]
fn svg0_collects_statistics_that_take_effect_with_the_next_publication() {
    assert_collected_and_not_in_effect(&svg0());
}
