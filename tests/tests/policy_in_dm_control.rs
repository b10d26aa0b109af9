//! `comic-learner export` end to end: what a run has learnt acts in `comic-actor evaluate` as the checkpoint does, and in
//! dm_control's own environment, driven by a script of ten statements, as it does here.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;
use comic_tests::steps::LIMIT;
use comic_tests::system::{SMALL, System, program, python};
use serde_json::Value;

/// Steps of each episode that are compared.
const STEPS: usize = 20;
/// Frames of the clip at which they start.
const STARTS: [&str; 4] = ["0", "13", "37", "50"];
/// Difference of a step's mean reward: two programs in double precision, a policy in single.
const TOLERANCE: f64 = 1e-6;
/// Enough for statistics of observations, and a policy that is not what it began as.
const UPDATES: &str = "budget.updates=20";
/// In lockstep, one for each unroll of a batch.
const ENVIRONMENTS: u32 = 8;

fn succeeds(command: &mut Command) -> Result<Output> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(output)
}

/// A run that learnt a little and has ended; always the same.
async fn learnt(low_level: &str) -> Result<System> {
    let low_level = format!("network.low_level={low_level}");
    let more = [
        low_level.as_str(),
        "network.lstm.units=[32]",
        "network.primitives.torso=[32]",
        "network.primitives.hidden=16",
        "network.primitives.gate=[16]",
        // Who learnt for a few seconds falls at once, and is to be paid for a while all the same.
        "tracking.termination_threshold=100",
        UPDATES,
    ];
    let more = more.iter().flat_map(|field| ["--set", *field]);
    let mut system = System::new(&SMALL.into_iter().chain(["--lockstep"]).chain(more).collect::<Vec<_>>())?;
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor_of(ENVIRONMENTS, &system.url())?;
    for ended in
        [actor.until_it_ends(LIMIT).await?, system.learner.take().context("no learner")?.until_it_ends(LIMIT).await?]
    {
        ensure!(ended.success(), "one of the two ends with {ended}");
    }
    Ok(system)
}

fn export(run: &Path, part: &str, out: &Path) -> Result<Output> {
    let mut command = Command::new(program("comic-learner")?);
    command.args(["export", "--part", part, "--checkpoint"]).arg(run).arg("--out").arg(out);
    succeeds(&mut command)
}

/// The report of an evaluation, as it is printed.
fn evaluate(policy: &Path, more: &[&str]) -> Result<Value> {
    let mut command = Command::new(program("comic-actor")?);
    command.args(["evaluate", "--deterministic", "--json", "--policy"]).arg(policy).args(more);
    serde_json::from_slice(&succeeds(&mut command)?.stdout).context("evaluate printed no JSON")
}

/// Rewards of the first steps, start by start: of lines that are episodes.
fn rewards(lines: &str) -> Result<Vec<(String, Vec<f64>)>> {
    let mut episodes = Vec::new();
    for line in lines.lines() {
        let episode: Value = serde_json::from_str(line)?;
        let rewards = episode["rewards"].as_array().context("no rewards")?.iter().filter_map(Value::as_f64);
        episodes.push((episode["start"].to_string(), rewards.take(STEPS).collect()));
    }
    Ok(episodes)
}

/// The same of lines that are steps.
fn rewards_by_step(lines: &str) -> Result<Vec<(String, Vec<f64>)>> {
    let mut episodes: Vec<(String, Vec<f64>)> = Vec::new();
    for line in lines.lines() {
        let step: Value = serde_json::from_str(line)?;
        let (start, reward) = (step["start"].to_string(), step["reward"].as_f64().context("no reward")?);
        match episodes.last_mut().filter(|(begun, _)| *begun == start) {
            Some((_, rewards)) if rewards.len() == STEPS => {}
            Some((_, rewards)) => rewards.push(reward),
            None => episodes.push((start, vec![reward])),
        }
    }
    Ok(episodes)
}

/// Exports what a low level has learnt, lets it act here and there, and compares the mean reward of each step.
async fn dm_control_pays_what_we_pay(low_level: &str) -> Result<()> {
    let system = learnt(low_level).await?;
    let directory = tempfile::tempdir()?;
    let file = |name: &str| -> PathBuf { directory.path().join(name) };
    let (whole, script, clips, ours) =
        (file("policy.safetensors"), file("policy.pt"), file("walk.h5"), file("rewards.jsonl"));
    export(&system.run(), "policy", &whole)?;
    export(&system.run(), "policy", &script)?;
    succeeds(Command::new(program("comic-actor")?).args(["clips", "merge", "builtin:walk", "--out"]).arg(&clips))?;

    let report = evaluate(&whole, &["--rewards", &ours.display().to_string()])?;
    ensure!(report == evaluate(&system.run(), &[])?, "the file and its checkpoint are paid differently: {report}");
    let mut driver = Command::new(python()?);
    driver.arg(root().join("docs/drive_policy.py")).args([&script, &clips]).args(STARTS);
    let theirs = rewards_by_step(&String::from_utf8(succeeds(&mut driver)?.stdout)?)?;
    let mut ours = rewards(&std::fs::read_to_string(&ours)?)?;
    ours.retain(|(start, _)| STARTS.contains(&start.as_str()));

    for episodes in [&ours, &theirs] {
        let starts: Vec<&str> = episodes.iter().map(|(start, _)| start.as_str()).collect();
        ensure!(starts == STARTS, "{starts:?}");
        ensure!(episodes.iter().all(|(_, rewards)| rewards.len() == STEPS), "an episode is too short: {episodes:?}");
    }
    for step in 0..STEPS {
        let mean = |episodes: &[(String, Vec<f64>)]| {
            episodes.iter().map(|(_, rewards)| rewards[step]).sum::<f64>() / episodes.len() as f64
        };
        let (mine, other) = (mean(&ours), mean(&theirs));
        ensure!((mine - other).abs() < TOLERANCE, "step {step}: {mine} here, {other} in dm_control");
    }
    Ok(())
}

#[tokio::test]
async fn dm_control_pays_an_exported_mlp_what_we_pay_it() -> Result<()> {
    dm_control_pays_what_we_pay("mlp").await
}

#[tokio::test]
async fn dm_control_pays_an_exported_lstm_what_we_pay_it() -> Result<()> {
    dm_control_pays_what_we_pay("lstm").await
}

#[tokio::test]
async fn dm_control_pays_an_exported_mixture_what_we_pay_it() -> Result<()> {
    dm_control_pays_what_we_pay("mixture").await
}

#[tokio::test]
async fn dm_control_pays_an_exported_product_what_we_pay_it() -> Result<()> {
    dm_control_pays_what_we_pay("product").await
}

#[tokio::test]
async fn what_is_no_policy_is_refused_with_its_remedy() -> Result<()> {
    let system = learnt("mlp").await?;
    let directory = tempfile::tempdir()?;
    let low_level = directory.path().join("low-level.safetensors");
    export(&system.run(), "low-level", &low_level)?;
    let refused = evaluate(&low_level, &[]).err().context("a low level was evaluated")?.to_string();
    ensure!(refused.contains("low-level.safetensors") && refused.contains("--part policy"), "{refused}");
    for (part, out, remedy) in [
        ("encoder:gaps", "encoder.safetensors", "tracking"),
        ("low-level", "low-level.pt", "policy:TASK"),
        ("policy", "policy.onnx", ".safetensors"),
    ] {
        let refused = export(&system.run(), part, &directory.path().join(out)).err();
        let refused = refused.context("exported")?.to_string();
        ensure!(refused.contains(remedy), "{part} to {out}: {refused}");
    }
    Ok(())
}
