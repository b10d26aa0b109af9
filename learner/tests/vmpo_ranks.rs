//! Several learners that train one run together do what one learner does with all of their unrolls.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod vmpo_support;

use std::net::{SocketAddr, TcpListener};
use std::thread;
use std::time::Duration;

use comic_experiment::{Experiment, Prior, TaskSpec};
use comic_learner::algorithm::Algorithm as _;
use comic_learner::algorithm::error::Error;
use comic_learner::algorithm::loss_report::LossValues;
use comic_learner::vmpo::VmpoLearner;
use comic_learner::world::{self, World};
use tch::{Kind, Tensor};
use vmpo_support::{Numbers, Unrolls, difference, every_low_level, experiment, joint_spec, learner_of, spec, state};

const PATIENCE: Duration = Duration::from_secs(60);
/// How the names of Adam's first moments begin.
const FIRST_MOMENT: &str = "adam.first.";

/// Runs every rank of a world in a thread of its own, and returns what each computes.
fn in_world<R: Send + 'static>(size: usize, rank: impl Fn(World) -> R + Clone + Send + 'static) -> Vec<R> {
    let listener = TcpListener::bind((std::net::Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address: SocketAddr = listener.local_addr().unwrap();
    let mut listener = Some(listener);
    let meet = |index: usize| {
        let (listener, rank) = (listener.take(), rank.clone());
        thread::spawn(move || rank(World::meet(index, size, address, listener, PATIENCE).unwrap()))
    };
    let ranks: Vec<_> = (0..size).map(meet).collect();
    ranks.into_iter().map(|rank| rank.join().unwrap()).collect()
}

/// A learner after a step on each of these unrolls, and what the steps reported.
fn trained(
    spec: &TaskSpec,
    experiment: &Experiment,
    world: &World,
    batches: &[Unrolls],
) -> (VmpoLearner, Vec<LossValues>) {
    let mut learner = learner_of(spec, experiment, 1).in_world(world);
    let step =
        |unrolls: &Unrolls| learner.step(&unrolls.part(world.rank(), world.size()).minibatch()).unwrap().to_values();
    let losses = batches.iter().map(step).collect();
    (learner, losses)
}

/// Batches of this many unrolls, whose advantages, lengths and tasks differ from rank to rank.
fn batches(experiment: &Experiment, spec: &TaskSpec, count: u64, unrolls: usize) -> Vec<Unrolls> {
    let batch = |seed: u64| {
        let mut unrolls = Unrolls::recorded(experiment, spec, seed, unrolls);
        if experiment.vmpo.action_gradient != 0.0 {
            unrolls.action_gradient = Numbers::new(seed + 200).take(unrolls.action.len());
        }
        unrolls
    };
    (0..count).map(batch).collect()
}

/// Compares the ranks of a world with one learner. Returns the largest differences of their states and of their losses.
fn compare(spec: &TaskSpec, experiment: &Experiment, size: usize, steps: u64) -> (f64, f64) {
    let batches = batches(experiment, spec, steps, 12);
    let (alone, expected) = trained(spec, experiment, &World::alone(), &batches);
    let ranks = in_world(size, {
        let (spec, experiment) = (spec.clone(), experiment.clone());
        move |world| trained(&spec, &experiment, &world, &batches)
    });
    let mut differences = (0f64, 0f64);
    for (learner, losses) in &ranks {
        assert_eq!(state(learner), state(&ranks[0].0), "the ranks are not equal, bit for bit");
        assert_eq!(losses, &ranks[0].1);
        differences.0 = differences.0.max(difference(&alone, learner));
        for (found, expected) in losses.iter().zip(&expected) {
            for ((name, found), (_, expected)) in found.entries().iter().zip(expected.entries()) {
                // 1 − a ratio near 1 is known as well as the ratio.
                let least = if *name == "variance_explained" { 1.0 } else { 1e-2 };
                let scale = f64::from(expected.abs()).max(least);
                let difference = f64::from((found - expected).abs()) / scale;
                assert!(difference < 1e-3, "{name} is {found} and {expected}");
                differences.1 = differences.1.max(difference);
            }
        }
    }
    differences
}

/// Every term of the loss.
fn everything(mut experiment: Experiment) -> Experiment {
    experiment.network.latent.prior = Prior::Ar1 { alpha: 0.95 };
    experiment.vmpo.entropy = 0.01;
    experiment.vmpo.control_variate = 0.5;
    experiment.vmpo.action_gradient = 0.2;
    experiment.network.value_lstm = vec![6];
    experiment.vmpo.value_burn_in = 2;
    experiment.optimiser.max_gradient_norm = 1.0;
    experiment
}

/// Every low level, every term of the loss, and joint training with one η for all tasks.
fn every_kind() -> Vec<(&'static str, TaskSpec, Experiment)> {
    let low_levels = every_low_level().into_iter().map(|experiment| ("a low level", spec(), experiment));
    let mut joint = everything(experiment());
    // Joint training has no recurrent value function.
    joint.network.value_lstm.clear();
    joint.vmpo.value_burn_in = 0;
    joint.vmpo.temperature_per_task = false;
    low_levels.chain([("every term", spec(), everything(experiment())), ("joint", joint_spec(), joint)]).collect()
}

#[test]
fn the_gradient_of_two_learners_with_64_unrolls_is_that_of_one_with_128() {
    for (kind, spec, experiment) in every_kind() {
        let batch = batches(&experiment, &spec, 1, 128);
        let (alone, _) = trained(&spec, &experiment, &World::alone(), &batch);
        let ranks = in_world(2, {
            let (spec, experiment) = (spec.clone(), experiment.clone());
            move |world| trained(&spec, &experiment, &world, &batch).0
        });
        let mut compared = 0;
        for ((name, expected), (_, found)) in state(&alone).iter().zip(state(&ranks[1])) {
            // After one step Adam's first moment is the gradient, times a number.
            if name.starts_with(FIRST_MOMENT) {
                let square = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>();
                let apart = square(&mut expected.iter().zip(&found).map(|(expected, found)| expected - found));
                let size = square(&mut expected.iter().copied());
                assert!(apart.sqrt() <= 1e-5 * size.sqrt(), "{kind}: {name}: {apart:e} of {size:e}");
                compared += usize::from(size > 0.0);
            }
        }
        assert!(compared > 10, "{kind}: {compared} tensors have a gradient");
    }
}

#[test]
fn a_gradient_step_of_two_ranks_is_that_of_one_learner() {
    for (kind, spec, experiment) in every_kind() {
        let (state, losses) = compare(&spec, &experiment, 2, 1);
        assert!(state < 1e-5 && losses < 1e-5, "{kind}: {}: {state:e}, {losses:e}", experiment.network.low_level);
    }
}

#[test]
fn each_task_has_its_own_best_half_of_all_ranks() {
    let mut experiment = everything(experiment());
    experiment.vmpo.temperature_per_task = true;
    // Joint training has no recurrent value function.
    experiment.network.value_lstm.clear();
    experiment.vmpo.value_burn_in = 0;
    for steps in 1..=4 {
        let (state, losses) = compare(&joint_spec(), &experiment, 2, steps);
        assert!(state < 1e-5 && losses < 1e-5, "{steps}: {state:e}, {losses:e}");
    }
}

#[test]
fn thirty_updates_of_two_and_of_three_ranks_are_those_of_one_learner() {
    for size in [2, 3] {
        for (kind, spec, experiment) in every_kind() {
            let (state, losses) = compare(&spec, &experiment, size, 30);
            assert!(state < 1e-5 && losses < 1e-5, "{size} ranks: {kind}: {state:e}, {losses:e}");
        }
    }
}

#[test]
fn a_gradient_step_speaks_with_the_other_ranks_twice() {
    let batches = batches(&experiment(), &spec(), 3, 12);
    let operations = in_world(2, move |world| {
        trained(&spec(), &experiment(), &world, &batches);
        world.operations()
    });
    assert_eq!(operations, [6, 6]);
}

#[test]
fn a_rank_without_a_valid_step_adds_nothing() {
    let mut batch = Unrolls::recorded(&experiment(), &spec(), 1, 4);
    let steps = batch.valid.len();
    batch.valid[steps / 2..].fill(0.0);
    let (alone, _) = trained(&spec(), &experiment(), &World::alone(), std::slice::from_ref(&batch));
    let ranks = in_world(2, move |world| trained(&spec(), &experiment(), &world, std::slice::from_ref(&batch)).0);
    for rank in &ranks {
        assert!(difference(&alone, rank) < 1e-5);
    }
}

#[test]
fn a_step_that_is_not_finite_on_one_rank_is_taken_on_none() {
    let batch = Unrolls::recorded(&experiment(), &spec(), 1, 4);
    let ranks = in_world(2, move |world| {
        let mut learner = learner_of(&spec(), &experiment(), 1).in_world(&world);
        let before = state(&learner);
        let mut own = batch.part(world.rank(), 2);
        if world.rank() == 1 {
            own.reward.fill(f32::NAN);
        }
        let losses = learner.step(&own.minibatch()).unwrap().to_values();
        (losses.skipped, state(&learner) == before)
    });
    assert_eq!(ranks, [(1, true), (1, true)]);
}

#[test]
fn a_rank_that_is_gone_ends_the_step_of_the_others_with_an_error_that_says_so() {
    let batch = Unrolls::recorded(&experiment(), &spec(), 1, 4);
    let ranks = in_world(2, move |world| {
        let mut learner = learner_of(&spec(), &experiment(), 1).in_world(&world);
        let own = batch.part(world.rank(), 2).minibatch();
        learner.step(&own).unwrap();
        if world.rank() == 1 {
            return None;
        }
        let before = state(&learner);
        let error = learner.step(&own).unwrap_err();
        assert!(matches!(error, Error::World(world::Error::Lost { rank: 0, .. })), "{error}");
        assert_eq!(state(&learner), before);
        Some(error.to_string())
    });
    let message = ranks[0].as_deref().unwrap();
    for part in ["rank 0 lost another rank", "newest checkpoint"] {
        assert!(message.contains(part), "no `{part}` in {message}");
    }
}

#[test]
fn what_ranks_say_and_send_arrives_in_their_order() {
    let ranks = in_world(3, |world| {
        let said = world.exchange((world.rank(), "x".repeat(world.rank() * 1000))).unwrap();
        let sent = world.broadcast(vec![7 + world.rank() as u8; 5000]).unwrap();
        let mut sums = [Tensor::from_slice(&[1i64 << world.rank(), -1]), Tensor::from(2i64)];
        world.sum(&mut sums).unwrap();
        let own = Tensor::from_slice(&[world.rank() as f32; 2]).reshape([2, 1]);
        let all = world.gather(&own).unwrap();
        assert_eq!(world.own_part(&all), own);
        (
            said,
            sent,
            sums.map(|sum| (sum.size(), Vec::<i64>::try_from(sum.reshape([-1])).unwrap())),
            Vec::<f32>::try_from(all.to_kind(Kind::Float).reshape([-1])).unwrap(),
        )
    });
    for (said, sent, sums, all) in ranks {
        assert_eq!(
            said.iter().map(|(rank, text)| (*rank, text.len())).collect::<Vec<_>>(),
            [(0, 0), (1, 1000), (2, 2000)]
        );
        assert!(sent.iter().all(|byte| *byte == 7), "not that of rank 0");
        assert_eq!(sums, [(vec![2], vec![7, -3]), (vec![], vec![6])]);
        assert_eq!(all, [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]);
    }
}

#[test]
fn ranks_with_other_world_sizes_are_told_so_at_once() {
    let listener = TcpListener::bind((std::net::Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = listener.local_addr().unwrap();
    let first = thread::spawn(move || World::meet(0, 2, address, Some(listener), PATIENCE).map(|_| ()));
    let refused = World::meet(1, 3, address, None, PATIENCE).map(|_| ()).unwrap_err();
    assert!(matches!(refused, world::Error::Sizes { size: 3, of_first: 2, .. }), "{refused}");
    // It may be that of a former run which ends, so a restart can help.
    assert_eq!(comic_learner::error::Error::from(refused).exit_code(), 5);
    // Rank 0 has waited meanwhile, and meets the right one.
    World::meet(1, 2, address, None, PATIENCE).unwrap();
    first.join().unwrap().unwrap();
}
