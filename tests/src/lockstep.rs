//! Runs in lockstep: the seed decides every parameter, so the parameters show whether a fault changed anything.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, ensure};

use crate::process::Process;
use crate::steps::LIMIT;
use crate::system::{SMALL, System};

/// All environments: one for each unroll of a batch.
pub const ALL: u32 = 8;
/// Updates of a run.
pub const UPDATES: u64 = 6;
/// At this rate a version of the small policy takes seconds, so a fault can come in the middle of the run.
pub const SLOW_BYTES_PER_SECOND: f64 = 650_000.0;

/// A run in lockstep with a normaliser that is set several times, and updates that publish no new version.
///
/// # Errors
/// When there is no directory or port.
pub fn lockstep(overrides: &[&str]) -> Result<System> {
    lockstep_with(&[], overrides)
}

/// The same run of a learner with these options.
///
/// # Errors
/// When there is no directory or port.
pub fn lockstep_with(options: &[&str], overrides: &[&str]) -> Result<System> {
    let updates = format!("budget.updates={UPDATES}");
    let fields = ["vmpo.target_period=2", "vmpo.gradient_steps=2", "vmpo.minibatch_unrolls=4", updates.as_str()];
    let settings = fields.iter().chain(overrides).flat_map(|field| ["--set", *field]);
    System::new(
        &SMALL.into_iter().chain(["--lockstep"]).chain(options.iter().copied()).chain(settings).collect::<Vec<_>>(),
    )
}

/// Trains with an actor for each number of environments, until the budget is used up.
///
/// # Errors
/// When a program does not end with 0.
pub async fn train(system: &mut System, actors: &[u32]) -> Result<()> {
    system.start_learner(LIMIT).await?;
    let url = system.url();
    let start = |environments: &u32| system.start_actor_of(*environments, &url);
    let mut actors = actors.iter().map(start).collect::<Result<Vec<_>>>()?;
    is_over(system, &mut actors).await?;
    Ok(())
}

/// Waits until the budget is used up and every program has ended. Returns the learner's log.
///
/// # Errors
/// When a program does not end with 0.
pub async fn is_over(system: &mut System, actors: &mut [Process]) -> Result<String> {
    for actor in actors {
        let status = actor.until_it_ends(LIMIT).await?;
        ensure!(status.success(), "an actor ended with {status}: {}", actor.log());
    }
    let mut learner = system.learner.take().context("no learner")?;
    let status = learner.until_it_ends(LIMIT).await?;
    ensure!(status.success(), "the learner ended with {status}: {}", learner.log());
    Ok(learner.log())
}

/// Networks, optimiser and statistics of the run's last checkpoint.
///
/// # Errors
/// When there is no checkpoint.
pub fn final_state(system: &System) -> Result<[Vec<u8>; 3]> {
    final_state_in(&system.run())
}

/// The same for the run in a directory.
///
/// # Errors
/// When there is no checkpoint.
pub fn final_state_in(run: &Path) -> Result<[Vec<u8>; 3]> {
    let checkpoint = run.join(format!("checkpoints/checkpoint-{UPDATES:010}"));
    let part = |name: &str| fs::read(checkpoint.join(name)).with_context(|| format!("no {name}"));
    Ok([part("policy.safetensors")?, part("target.safetensors")?, part("learner.safetensors")?])
}

/// The result of an undisturbed run with one actor for each number of environments.
///
/// # Errors
/// When a program does not end with 0.
pub async fn final_state_of(actors: &[u32], overrides: &[&str]) -> Result<[Vec<u8>; 3]> {
    let mut system = lockstep(overrides)?;
    train(&mut system, actors).await?;
    final_state(&system)
}
