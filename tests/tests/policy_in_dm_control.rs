//! `comic-learner export` end to end: what a run has learnt acts in `comic-actor evaluate` as the checkpoint does, and in
//! dm_control's own environment, driven by a script of a few lines, as it does here.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;
use comic_tests::steps::LIMIT;
use comic_tests::system::{SMALL, System, metric, program, python};
use serde_json::Value;

/// Steps of each episode that are compared.
const STEPS: usize = 20;
/// Frames of the clip at which they start.
const STARTS: [&str; 4] = ["0", "13", "37", "65"];
/// Difference of a step's mean reward: two programs in double precision, a policy in single.
const TOLERANCE: f64 = 1e-6;
/// Enough for statistics of observations, and a policy that is not what it began as.
const UPDATES: f64 = 20.0;

fn succeeds(command: &mut Command) -> Result<Output> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(output)
}

/// A run that learnt for so many updates, and has ended.
async fn learnt(low_level: &str, updates: f64) -> Result<System> {
    let low_level = format!("network.low_level={low_level}");
    let sizes = ["--set", "network.lstm.units=[32]", "--set", &low_level];
    let mut system = System::new(&[&SMALL[..], &sizes].concat())?;
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    system.until("a little is learnt", LIMIT, |status| (metric(status, "updates") >= updates).then_some(())).await?;
    drop(actor);
    let status = system.learner.take().context("no learner")?.terminate(LIMIT).await?;
    ensure!(status.success(), "the learner leaves with {status}");
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

/// Rewards of the first steps, start by start.
fn rewards(lines: &str) -> Result<Vec<(String, Vec<f64>)>> {
    let mut episodes = Vec::new();
    for line in lines.lines() {
        let episode: Value = serde_json::from_str(line)?;
        let rewards = episode["rewards"].as_array().context("no rewards")?.iter().filter_map(Value::as_f64);
        episodes.push((episode["start"].to_string(), rewards.take(STEPS).collect()));
    }
    Ok(episodes)
}

#[tokio::test]
async fn dm_control_pays_an_exported_policy_what_we_pay_it() -> Result<()> {
    for low_level in ["mlp", "lstm"] {
        let system = learnt(low_level, UPDATES).await?;
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
        driver.arg(root().join("docs/drive_policy.py")).args([&script, &clips]).arg("--starts").args(STARTS);
        let theirs = rewards(&String::from_utf8(succeeds(&mut driver)?.stdout)?)?;
        let mut ours = rewards(&std::fs::read_to_string(&ours)?)?;
        ours.retain(|(start, _)| STARTS.contains(&start.as_str()));

        ensure!(ours.len() == STARTS.len() && theirs.len() == STARTS.len(), "{ours:?}, {theirs:?}");
        let shortest = ours.iter().map(|(_, rewards)| rewards.len()).min().unwrap_or(0);
        ensure!(shortest >= 5, "the episodes are too short to compare anything: {ours:?}");
        for (mine, other) in ours.iter().zip(&theirs) {
            ensure!(mine.0 == other.0 && mine.1.len() == other.1.len(), "{low_level}: {mine:?}, {other:?}");
        }
        for step in 0..shortest {
            let mean = |episodes: &[(String, Vec<f64>)]| {
                episodes.iter().map(|(_, rewards)| rewards[step]).sum::<f64>() / episodes.len() as f64
            };
            let (mine, other) = (mean(&ours), mean(&theirs));
            ensure!((mine - other).abs() < TOLERANCE, "{low_level}, step {step}: {mine} here, {other} in dm_control");
        }
    }
    Ok(())
}

#[tokio::test]
async fn what_is_no_policy_is_refused_with_its_remedy() -> Result<()> {
    let system = learnt("mlp", 0.0).await?;
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
