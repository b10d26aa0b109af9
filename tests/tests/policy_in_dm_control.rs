//! `comic-learner export` end to end: the exported policy acts in `comic-actor evaluate` as its checkpoint does, and gets
//! the same rewards in dm_control's own environment, which a script of ten statements drives. A policy that sees acts in
//! dm_control's own corridor. As ONNX a policy acts in onnxruntime.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;
use comic_tests::steps::LIMIT;
use comic_tests::system::{SMALL, System, program, python};
use serde_json::Value;

/// Steps of each episode that are compared.
const STEPS: usize = 20;
/// Start frames of the episodes.
const STARTS: [&str; 4] = ["0", "13", "37", "50"];
/// Largest difference of a step's mean reward. Both programs use double precision, the policy single precision.
const TOLERANCE: f64 = 1e-6;
/// Enough for statistics of observations and for a policy that differs from the initial one.
const UPDATES: &str = "budget.updates=20";
/// Environments in lockstep: one for each unroll of a batch.
const ENVIRONMENTS: u32 = 8;

fn succeeds(command: &mut Command) -> Result<Output> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(output)
}

/// A short run of tracking with this low level that has ended. Its parameters are always the same.
async fn trained_run(low_level: &str) -> Result<System> {
    let low_level = format!("network.low_level={low_level}");
    run_to_the_end(&[
        low_level.as_str(),
        // A mixture has none.
        "vmpo.control_variate=0",
        "network.lstm.units=[32]",
        "network.primitives.torso=[32]",
        "network.primitives.hidden=16",
        "network.primitives.gate=[16]",
        // A policy after a few seconds of training falls at once; the comparison needs rewards for longer.
        "tracking.termination_threshold=100",
        UPDATES,
    ])
    .await
}

/// A run in lockstep with these fields that has ended.
async fn run_to_the_end(fields: &[&str]) -> Result<System> {
    let more = fields.iter().flat_map(|field| ["--set", *field]);
    let mut system = System::new(&SMALL.into_iter().chain(["--lockstep"]).chain(more).collect::<Vec<_>>())?;
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor_of(ENVIRONMENTS, &system.url())?;
    for ended in
        [actor.until_it_ends(LIMIT).await?, system.learner.take().context("no learner")?.until_it_ends(LIMIT).await?]
    {
        ensure!(ended.success(), "the actor or the learner ended with {ended}");
    }
    Ok(system)
}

fn export(run: &Path, part: &str, out: &Path) -> Result<Output> {
    let mut command = Command::new(program("comic-learner")?);
    command.args(["export", "--part", part, "--checkpoint"]).arg(run).arg("--out").arg(out);
    succeeds(&mut command)
}

/// The JSON report that an evaluation prints.
fn evaluate(policy: &Path, more: &[&str]) -> Result<Value> {
    let mut command = Command::new(program("comic-actor")?);
    command.args(["evaluate", "--deterministic", "--json", "--policy"]).arg(policy).args(more);
    serde_json::from_slice(&succeeds(&mut command)?.stdout).context("evaluate printed no JSON")
}

/// Rewards of the first steps for every start frame. Each line is an episode.
fn rewards(lines: &str) -> Result<Vec<(String, Vec<f64>)>> {
    let mut episodes = Vec::new();
    for line in lines.lines() {
        let episode: Value = serde_json::from_str(line)?;
        let rewards = episode["rewards"].as_array().context("no rewards")?.iter().filter_map(Value::as_f64);
        episodes.push((episode["start"].to_string(), rewards.take(STEPS).collect()));
    }
    Ok(episodes)
}

/// The same, where each line is a step.
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

/// Exports a policy with this low level, runs it in both environments, and compares the mean reward of each step.
async fn rewards_are_equal(low_level: &str) -> Result<()> {
    let system = trained_run(low_level).await?;
    let directory = tempfile::tempdir()?;
    let file = |name: &str| -> PathBuf { directory.path().join(name) };
    let (whole, script, clips, ours) =
        (file("policy.safetensors"), file("policy.pt"), file("walk.h5"), file("rewards.jsonl"));
    export(&system.run(), "policy", &whole)?;
    export(&system.run(), "policy", &script)?;
    succeeds(Command::new(program("comic-actor")?).args(["clips", "merge", "builtin:walk", "--out"]).arg(&clips))?;

    let report = evaluate(&whole, &["--rewards", &ours.display().to_string()])?;
    ensure!(report == evaluate(&system.run(), &[])?, "the file and its checkpoint get different rewards: {report}");
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
async fn an_exported_mlp_gets_the_same_rewards_in_dm_control() -> Result<()> {
    rewards_are_equal("mlp").await
}

#[tokio::test]
async fn an_exported_lstm_gets_the_same_rewards_in_dm_control() -> Result<()> {
    rewards_are_equal("lstm").await
}

#[tokio::test]
async fn an_exported_mixture_gets_the_same_rewards_in_dm_control() -> Result<()> {
    rewards_are_equal("mixture").await
}

#[tokio::test]
async fn an_exported_product_gets_the_same_rewards_in_dm_control() -> Result<()> {
    rewards_are_equal("product").await
}

/// The inputs of the policy are those of its description, by name and in that order.
#[tokio::test]
async fn opengl_an_exported_policy_sees_in_dm_controls_gaps() -> Result<()> {
    let fields = ["task=gaps", "vmpo.action_gradient=0", "network.initial_pose=mid-range", "budget.updates=3"];
    let system = run_to_the_end(&fields).await?;
    let directory = tempfile::tempdir()?;
    let script = directory.path().join("policy.pt");
    export(&system.run(), "policy", &script)?;
    let mut driver = Command::new(python()?);
    driver.arg(root().join("tests/python/drive_gaps.py")).arg(&script).arg("3");
    let lines = String::from_utf8(succeeds(&mut driver)?.stdout)?;
    let steps: Vec<Value> = lines.lines().map(serde_json::from_str).collect::<Result<_, _>>()?;
    ensure!(steps.len() == 3, "the episode is too short: {lines}");
    for step in &steps {
        let number = |name: &str| step[name].as_f64().with_context(|| format!("no {name}: {step}"));
        ensure!((0.0..=1.0).contains(&number("reward")?), "{step}");
        ensure!((1e-3..=1.0).contains(&number("largest_action")?), "{step}");
        ensure!(number("change_when_blind")? > 1e-4, "the image has no influence: {step}");
    }
    Ok(())
}

/// `run_onnx.py` runs both files on golden observations. The networks' own tests compare all kinds of policies.
#[tokio::test]
async fn an_exported_policy_acts_in_onnxruntime_as_in_pytorch() -> Result<()> {
    let system = trained_run("lstm").await?;
    let directory = tempfile::tempdir()?;
    for name in ["policy.onnx", "policy.pt"] {
        export(&system.run(), "policy", &directory.path().join(name))?;
    }
    let mut script = Command::new(python()?);
    script.arg(root().join("tests/python/run_onnx.py")).arg(directory.path());
    let lines = String::from_utf8(succeeds(&mut script)?.stdout)?;
    let steps: Vec<Value> = lines.lines().map(serde_json::from_str).collect::<Result<_, _>>()?;
    ensure!(steps.len() >= 3, "{} steps", steps.len());
    let rows = |rows: &Value| -> Result<Vec<Vec<f64>>> { Ok(serde_json::from_value(rows.clone())?) };
    for step in &steps {
        let [action, memory] = ["action", "next_recurrent_state"].map(|name| rows(&step["outputs"][name]));
        for ((mut found, memory), expected) in action?.into_iter().zip(memory?).zip(rows(&step["torch"])?) {
            found.extend(memory);
            ensure!(found.len() == expected.len(), "{} numbers, not {}", found.len(), expected.len());
            let largest = found.iter().zip(&expected).map(|(one, other)| (one - other).abs()).fold(0.0, f64::max);
            ensure!(largest < 1e-5, "the outputs differ by {largest}");
        }
    }
    Ok(())
}

#[tokio::test]
async fn a_file_that_is_no_policy_is_refused_and_the_error_names_the_remedy() -> Result<()> {
    let system = trained_run("mlp").await?;
    let directory = tempfile::tempdir()?;
    let low_level = directory.path().join("low-level.safetensors");
    export(&system.run(), "low-level", &low_level)?;
    let refused = evaluate(&low_level, &[]).err().context("a low level was evaluated")?.to_string();
    ensure!(refused.contains("low-level.safetensors") && refused.contains("--part policy"), "{refused}");
    for (part, out, remedy) in [
        ("encoder:gaps", "encoder.safetensors", "tracking"),
        ("low-level", "low-level.pt", "policy:TASK"),
        ("policy", "policy.tflite", ".safetensors"),
    ] {
        let refused = export(&system.run(), part, &directory.path().join(out)).err();
        let refused = refused.context("exported")?.to_string();
        ensure!(refused.contains(remedy), "{part} to {out}: {refused}");
    }
    let absent = export(&directory.path().join("absent"), "policy", &directory.path().join("policy.safetensors"));
    let refused = absent.err().context("exported from nowhere")?.to_string();
    ensure!(refused.contains("name a run's directory"), "{refused}");
    Ok(())
}
