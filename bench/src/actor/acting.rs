//! All work of a worker thread: environments, forward passes of the paper's networks, unrolls.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Instant;

use anyhow::{Result, anyhow};
use bytes::Bytes;
use comic_actor::forward_pass::ForwardPass;
use comic_actor::mailbox::Directive;
use comic_actor::policy::TorchPolicy;
use comic_actor::worker::{Progress, Worker};
use comic_clips::Catalogue;
use comic_experiment::seed::derive;
use comic_proto::{UnrollLayout, UnrollShape};
use comic_tasks::raw_physics::RawPhysics;
use comic_tasks::{Environment, Simulated};

use super::tape::Recorded;
use super::{ENVIRONMENTS, Subject};
use crate::busy::Busy;
use crate::figure::{Figure, interleave};

/// Steps/s of one thread, against the physics alone.
pub(super) fn policy(subject: &Subject) -> Result<Figure> {
    let (environments, tapes): (Vec<_>, Vec<_>) = environments(subject, 1)?.into_iter().map(Recorded::new).unzip();
    let mut worker = worker(subject, environments, 1)?;
    let mut floors: Vec<_> = tapes.iter().map(|_| RawPhysics::default()).collect();
    let medians = interleave(subject.budget, || {
        let value = unroll_rate(&mut worker)?;
        let begin = Instant::now();
        let steps: usize = tapes.iter().zip(&mut floors).map(|(tape, floor)| tape.play(floor)).sum();
        Ok::<_, anyhow::Error>((value, steps as f64 / begin.elapsed().as_secs_f64()))
    })?;
    let note = "one thread, 16 environments, the paper's networks, unrolls written; floor: the same controls through \
                6 x mj_step + mj_forward";
    Ok(Figure::new("actor.policy", "steps/s", medians, note))
}

/// Steps/s of one thread with the quickstart's sizes that differentiates the simulation, against one that does not.
pub(super) fn gradient(subject: &Subject) -> Result<Figure> {
    let quickstart = |overrides: &[&str]| {
        let overrides: Vec<String> = overrides.iter().map(|field| (*field).to_owned()).collect();
        let experiment = comic_experiment::resolve("quickstart", &overrides)?;
        let task = comic_tasks::build(&experiment, &Catalogue::open(&experiment.clips)?)?;
        let subject = Subject { experiment, task, budget: subject.budget, beside: subject.beside };
        worker(&subject, environments(&subject, 1)?, 1)
    };
    let (mut with, mut without) = (quickstart(&[])?, quickstart(&["vmpo.action_gradient=0"])?);
    let medians =
        interleave(subject.budget, || Ok::<_, anyhow::Error>((unroll_rate(&mut with)?, unroll_rate(&mut without)?)))?;
    let note =
        "one thread, 16 environments, the quickstart's networks, untrained; floor: the same without the derivative";
    Ok(Figure::new("actor.gradient", "steps/s", medians, note))
}

/// Steps/s of one thread alone, against the same beside busy processes.
pub(super) fn contended(subject: &Subject) -> Result<Figure> {
    let mut worker = worker(subject, environments(subject, 1)?, 1)?;
    let medians = interleave(subject.budget, || {
        let alone = unroll_rate(&mut worker)?;
        let _neighbours = Busy::start(subject.beside)?;
        Ok::<_, anyhow::Error>((alone, unroll_rate(&mut worker)?))
    })?;
    let note = "one thread, 16 environments, the paper's networks; floor: the same beside busy processes of equal priority, \
                one for each core or --beside";
    Ok(Figure::new("actor.contended", "steps/s", medians, note))
}

/// Steps/s of two threads, against one.
pub(super) fn threads(subject: &Subject) -> Result<Figure> {
    let mut one = worker(subject, environments(subject, 1)?, 1)?;
    let mut other = worker(subject, environments(subject, 2)?, 2)?;
    let medians = interleave(subject.budget, || {
        let both = thread::scope(|scope| {
            let second = scope.spawn(|| unroll_rate(&mut other));
            let first = unroll_rate(&mut one);
            Ok::<_, anyhow::Error>(first? + second.join().map_err(|_| anyhow!("the second thread panicked"))??)
        })?;
        Ok::<_, anyhow::Error>((both, unroll_rate(&mut one)?))
    })?;
    let note =
        "two threads of 16 environments with the paper's networks; floor: one such thread, so the best ratio is 2";
    Ok(Figure::new("actor.threads", "steps/s", medians, note))
}

fn environments(subject: &Subject, family: u64) -> Result<Vec<Box<dyn Simulated>>> {
    (0..ENVIRONMENTS as u64).map(|index| subject.environment(derive(family, index))).collect()
}

fn worker<E: Environment>(subject: &Subject, environments: Vec<E>, seed: u64) -> Result<Worker<E, TorchPolicy>> {
    let (spec, experiment) = (subject.task.spec(), &subject.experiment);
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(spec, experiment)));
    let policy = TorchPolicy::untrained(spec, experiment, None, seed, || Ok([0.0; 56]))?;
    let parameters = Bytes::from(policy.to_parameters()?);
    let mut worker = Worker::new(environments, policy, layout, 0, seed)?;
    worker.adopt(&Arc::new(Directive { learner_epoch: 1, version: 1, parameters }))?;
    Ok(worker)
}

/// Steps/s while every environment makes one unroll.
fn unroll_rate<E: Environment, F: ForwardPass>(worker: &mut Worker<E, F>) -> Result<f64> {
    let progress = Progress { steps: AtomicU64::new(0), episodes: AtomicU64::new(0) };
    let begin = Instant::now();
    worker.unroll(&|| false, &progress)?;
    Ok(progress.steps.load(Ordering::Relaxed) as f64 / begin.elapsed().as_secs_f64())
}
