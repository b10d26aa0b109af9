//! Environments without a policy.

use std::convert::Infallible;
use std::time::Instant;

use anyhow::Result;
use comic_tasks::raw_physics::{PhysicsState, RawPhysics};
use comic_tasks::{Environment as _, Outcome};
use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;

use super::Subject;
use super::tape::Recorded;
use crate::figure::{Figure, Medians, interleave};

/// Control steps of a segment: a fifth of a second of computing. A corridor is replaced after as many.
const STEPS: usize = 512;
/// Resets of a segment.
const RESETS: usize = 32;

/// One environment under uniformly random actions, observations and resets included.
pub(super) fn environment(subject: &Subject) -> Result<Figure> {
    let spec = subject.task.spec();
    let (mut environment, tape) = Recorded::new(subject.environment(1)?);
    let mut floor = RawPhysics::default();
    let mut rng = Pcg64::seed_from_u64(1);
    let mut actions = vec![0.0_f32; STEPS * spec.action];
    let (mut proprioception, mut task) = (vec![0.0; spec.proprioception], vec![0.0; spec.task]);
    environment.reset();
    let medians = infallible(interleave(subject.budget, || {
        actions.fill_with(|| rng.random_range(-1.0..1.0));
        let begin = Instant::now();
        for action in actions.chunks_exact(spec.action) {
            let step = environment.step(action);
            environment.observe(&mut proprioception, &mut task);
            if step.outcome != Outcome::Running {
                environment.reset();
                environment.observe(&mut proprioception, &mut task);
            }
        }
        let value = STEPS as f64 / begin.elapsed().as_secs_f64();
        let begin = Instant::now();
        let steps = tape.play(&mut floor);
        Ok((value, steps as f64 / begin.elapsed().as_secs_f64()))
    }));
    let note = "one thread, random actions, resets and observations included; floor: 6 x mj_step + mj_forward";
    Ok(Figure::new("actor.env", "steps/s", medians, note))
}

/// A reset with its first observation, against `mj_resetData` and `mj_forward`.
pub(super) fn reset(subject: &Subject) -> Result<Figure> {
    let spec = subject.task.spec();
    let mut environment = subject.environment(1)?;
    let mut floor = RawPhysics::default();
    let (mut proprioception, mut task) = (vec![0.0; spec.proprioception], vec![0.0; spec.task]);
    let mut states = Vec::with_capacity(RESETS);
    let medians = infallible(interleave(subject.budget, || {
        states.clear();
        let begin = Instant::now();
        for _ in 0..RESETS {
            environment.reset();
            environment.observe(&mut proprioception, &mut task);
            states.push(PhysicsState::of(environment.as_ref()));
        }
        let value = begin.elapsed().as_secs_f64();
        let begin = Instant::now();
        for state in &states {
            floor.reset_to(state);
            floor.forward();
        }
        let milliseconds = 1000.0 / RESETS as f64;
        Ok((value * milliseconds, begin.elapsed().as_secs_f64() * milliseconds))
    }));
    let note = "a reset with its first observation; floor: mj_resetData + mj_forward";
    Ok(Figure::new("actor.reset", "ms", medians, note))
}

fn infallible(medians: Result<Medians, Infallible>) -> Medians {
    match medians {
        Ok(medians) => medians,
        Err(never) => match never {},
    }
}
