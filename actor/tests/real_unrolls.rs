//! Checks unrolls of the tracking task under a real policy as a learner receives them.

#![allow(clippy::unwrap_used, reason = "tests")]

use std::sync::Arc;

use bytes::Bytes;
use comic_actor::forward_pass::{ActingBatch, ForwardPass as _};
use comic_actor::mailbox::Directive;
use comic_actor::policy::TorchPolicy;
use comic_actor::worker::{FinishedUnroll, Progress, Worker};
use comic_clips::Catalogue;
use comic_experiment::{Experiment, resolve};
use comic_proto::v1::UnrollHeader;
use comic_proto::{Expected, Field, UnrollBuffer, UnrollLayout, UnrollShape, validate};
use comic_tasks::Task;

const ENVIRONMENTS: usize = 3;

struct Setup {
    experiment: Experiment,
    task: Arc<dyn Task>,
    layout: Arc<UnrollLayout>,
    policy: TorchPolicy,
}

fn setup() -> Setup {
    let experiment = resolve("quickstart", &[]).unwrap();
    let catalogue = Catalogue::open(&experiment.clips).unwrap();
    let task = comic_tasks::build(&experiment, &catalogue).unwrap();
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(task.spec(), &experiment)));
    let policy = TorchPolicy::untrained(task.spec(), &experiment, None, 5, || Ok(catalogue.mean_action()?)).unwrap();
    Setup { experiment, task, layout, policy }
}

/// Two rounds of unrolls, `[round][environment]`.
fn record(setup: &Setup) -> Vec<Vec<FinishedUnroll>> {
    let environments =
        (0..ENVIRONMENTS as u64).map(|seed| Arc::clone(&setup.task).environment(seed).unwrap()).collect();
    let policy = TorchPolicy::untrained(setup.task.spec(), &setup.experiment, None, 6, || Ok([0.0; 56])).unwrap();
    let mut worker = Worker::new(environments, policy, Arc::clone(&setup.layout), 0, 9).unwrap();
    let parameters = Bytes::from(setup.policy.to_parameters().unwrap());
    worker.adopt(&Arc::new(Directive { learner_epoch: 2, version: 4, parameters })).unwrap();
    (0..2).map(|_| worker.unroll(&|| false, &Progress::default()).unwrap().unwrap()).collect()
}

#[test]
fn unrolls_pass_the_learners_validation() {
    let setup = setup();
    for unroll in record(&setup).into_iter().flatten() {
        let header = UnrollHeader {
            learner_epoch: unroll.learner_epoch,
            version: unroll.version,
            layout_hash: setup.layout.hash().to_vec(),
            episodes: unroll.episodes,
            task: unroll.task,
            ..UnrollHeader::default()
        };
        let expected = Expected { clips: &[setup.task.spec().clips.len()], epoch: 2, newest_version: 4 };
        validate(&setup.layout, &header, &unroll.payload.clone().into(), &expected).unwrap();
    }
}

#[test]
fn the_behaviour_policy_follows_from_the_recorded_fields() {
    let mut setup = setup();
    for round in record(&setup) {
        let mut unrolls: Vec<_> =
            round.iter().map(|unroll| UnrollBuffer::from_payload(&setup.layout, &unroll.payload).unwrap()).collect();
        let mut batch = ActingBatch::new(ENVIRONMENTS, setup.layout.shape(), None);
        for t in 0..setup.layout.shape().length {
            for (index, unroll) in unrolls.iter().enumerate() {
                let mut row = batch.row(index);
                for field in [Field::Proprioception, Field::Task, Field::PreviousLatent, Field::LatentNoise] {
                    row[field].copy_from_slice(unroll.row(field, t));
                }
            }
            setup.policy.forward(&mut batch).unwrap();
            for (index, unroll) in unrolls.iter_mut().enumerate() {
                let row = batch.row(index);
                // Equal batch shapes give equal numbers, bit for bit.
                assert_eq!(row[Field::Mean], *unroll.row(Field::Mean, t));
                assert_eq!(row[Field::Std], *unroll.row(Field::Std, t));
            }
        }
    }
}

#[test]
fn rewards_are_the_tracking_tasks() {
    let setup = setup();
    let mut best = 0.0_f32;
    for unroll in record(&setup).into_iter().flatten() {
        let buffer = UnrollBuffer::from_payload(&setup.layout, &unroll.payload).unwrap();
        for t in 0..setup.layout.shape().length {
            let reward: f32 = buffer.row(Field::Reward, t).iter().sum();
            // At a failure, beyond the threshold, the termination term is negative.
            assert!(reward <= 1.45 && (reward >= 0.0 || buffer.row(Field::Discount, t) == [0.0]), "{reward}");
            best = best.max(reward);
        }
    }
    assert!(best > 0.3, "an episode begins at its reference: {best}");
}

#[test]
fn every_transition_has_the_derivative_of_its_action() {
    let setup = setup();
    let mut transitions = 0;
    for unroll in record(&setup).into_iter().flatten() {
        let buffer = UnrollBuffer::from_payload(&setup.layout, &unroll.payload).unwrap();
        for t in 0..setup.layout.shape().length {
            let is_transition = buffer.row(Field::Valid, t) == [1.0];
            let has_one = buffer.row(Field::ActionGradient, t).iter().any(|value| *value != 0.0);
            assert_eq!(has_one, is_transition, "row {t}");
            transitions += usize::from(is_transition);
        }
    }
    assert!(transitions > 100, "{transitions}");
}
