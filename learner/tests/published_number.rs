//! `learner.published_number`: how many bytes actors get, and how far they act from the learner's policy.

#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::sync::Arc;

use comic_experiment::{Experiment, TaskSpec, resolve};
use comic_learner::checkpoint::Store;
use comic_learner::device::Backend;
use comic_learner::publish::{Published, Publisher};
use comic_learner::train::parts::{Ending, TrainerParts};
use comic_learner::train::trainer::Trainer;
use comic_learner::world::World;
use comic_networks::{ActionDistribution, Policy as _, RecurrentState, Routing, VmpoPolicy, from_safetensors};
use comic_proto::v1::ParametersChunk;
use comic_proto::{UnrollLayout, UnrollShape};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Phase};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;
use tch::{Device, Kind, Tensor, nn};
use tonic_prost::prost::Message as _;

mod open_service;

use open_service::open_service;

/// Steps over which a KL is averaged.
const STEPS: usize = 256;
/// Nats a step. What is equal in exact arithmetic stays below, and what was rounded to 8 bits comes above.
const EQUAL: f64 = 1e-6;
/// Nats a step. Above are parameters that were rounded to fewer than 6 bits, because a KL grows fourfold with each bit that is lost.
const NEAR: f64 = 1e-3;

/// The first version that a learner publishes, and the learner's own parameters.
struct Learner {
    experiment: Experiment,
    spec: TaskSpec,
    published: Vec<u8>,
    own: Vec<u8>,
}

/// A learner of small networks that was told to stop before its first batch.
fn learner(published_number: &str) -> Learner {
    let number = format!("learner.published_number={published_number}");
    let sizes =
        ["network.encoder=[64, 64]", "network.value=[16]", "network.mlp.hidden=[64, 64]", "network.latent.size=8"];
    let batches = ["unroll.length=5", "unroll.batch=8", "vmpo.minibatch_unrolls=4", &number];
    let overrides = [sizes, batches].concat().into_iter().map(String::from).collect::<Vec<_>>();
    let experiment = resolve("tracking-mlp", &overrides).unwrap();
    let spec = TaskSpec::new(&experiment, vec!["a".into()]).unwrap();
    tch::set_num_threads(1);
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 1).unwrap();
    let epoch = store.begin_epoch().unwrap();
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(&spec, &experiment)));
    let config = Config { unrolls: 8, max_staleness: 0, ahead: 0, order: BatchOrder::Arrival };
    let ledger = Ledger::new().with_tasks(spec.tasks.iter().map(|task| task.name.clone()));
    let batcher = Batcher::new(layout, config, Phase::begin(epoch), ledger);
    let publisher = Publisher::new(epoch);
    let service = open_service(run.path(), store.run().unwrap(), &experiment, &spec, &batcher, &publisher);
    let parts = TrainerParts {
        experiment: experiment.clone(),
        spec: spec.clone(),
        pose: vec![0.0; spec.action],
        low_level: None,
        backend: Backend::cpu(),
        world: World::alone(),
        run: run.path().to_path_buf(),
        epoch,
        resume: None,
        batcher: batcher.clone(),
        publisher: publisher.clone(),
        service: service.trainer(),
    };
    let trainer = Trainer::new(parts).unwrap();
    batcher.close();
    assert_eq!(trainer.run().unwrap(), Ending::Stopped);
    let (_, checkpoint) = store.newest().unwrap().unwrap();
    let own = checkpoint.part("policy.safetensors").unwrap().to_vec();
    Learner { experiment, spec, published: received(&publisher.newest().unwrap()), own }
}

/// The parameters as an actor receives them.
fn received(published: &Published) -> Vec<u8> {
    // gRPC's prefix: a byte that says whether the message is compressed, and four of its length.
    let chunk = |frame: &bytes::Bytes| ParametersChunk::decode(&frame[5..]).unwrap();
    published.frames().iter().flat_map(|frame| chunk(frame).data).collect()
}

impl Learner {
    /// How many bytes are published for each of the learner's own.
    fn share_of_bytes(&self) -> f64 {
        self.published.len() as f64 / self.own.len() as f64
    }

    /// The KL of the learner's policy from an actor's, nats a step, on generated observations.
    fn kl(&self) -> f64 {
        let UnrollShape { proprioception, task, latent, .. } = UnrollShape::new(&self.spec, &self.experiment);
        let mut random = Pcg64::seed_from_u64(1);
        let inputs = [proprioception, task, latent, latent].map(|width| {
            let values: Vec<f32> = (0..STEPS * width).map(|_| random.random_range(-1.0..1.0)).collect();
            Tensor::from_slice(&values).view([STEPS as i64, width as i64])
        });
        let [learner, actor] = [&self.own, &self.published].map(|parameters| self.decide(parameters, &inputs));
        (learner.kl_mean(&actor) + learner.kl_std(&actor)).mean(Kind::Double).double_value(&[])
    }

    /// Loads parameters as an actor does, and decides.
    fn decide(&self, parameters: &[u8], inputs: &[Tensor; 4]) -> ActionDistribution {
        let [proprioception, task, previous, noise] = inputs;
        let mut store = nn::VarStore::new(Device::Cpu);
        let pose = vec![0.0; self.spec.action];
        let policy = VmpoPolicy::of(&store.root(), &self.spec, &self.experiment, &pose).unwrap();
        from_safetensors(&mut store, parameters).unwrap();
        tch::no_grad(|| {
            let observation = policy.normalise(proprioception, task, None, &Routing::single());
            let state = RecurrentState { state: &proprioception.narrow(1, 0, 0), first: None };
            policy.act(&observation, previous, noise, state).action
        })
    }
}

#[test]
fn bfloat16_halves_what_is_published() {
    let share = learner("bfloat16").share_of_bytes();
    assert!((0.5..0.55).contains(&share), "{share} of the bytes");
}

#[test]
fn with_bfloat16_an_actor_acts_nearly_as_the_learner_would() {
    let kl = learner("bfloat16").kl();
    assert!(kl > EQUAL && kl < NEAR, "{kl} nats a step");
}

#[test]
fn with_float32_an_actor_acts_as_the_learner_would() {
    let kl = learner("float32").kl();
    assert!(kl.abs() <= EQUAL, "{kl} nats a step");
}
