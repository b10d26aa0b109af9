//! Transfer end to end: a low level is learned, exported, and frozen in another task; actors get it from the learner.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context, Result, ensure};
use comic_tests::steps::LIMIT;
use comic_tests::system::{SMALL, System, program};
use serde_json::Value;

/// Environments in lockstep: one for each unroll of a batch.
const ENVIRONMENTS: u32 = 8;

fn run(command: &mut Command) -> Result<Output> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(output)
}

/// A run in lockstep of two updates with these fields; nothing is started.
fn short(fields: &[&str]) -> Result<System> {
    let fields = ["budget.updates=2"].iter().chain(fields).flat_map(|field| ["--set", *field]);
    System::new(&SMALL.into_iter().chain(["--lockstep"]).chain(fields).collect::<Vec<_>>())
}

/// Trains until the budget is used up.
async fn train(system: &mut System) -> Result<()> {
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor_of(ENVIRONMENTS, &system.url())?;
    let status = actor.until_it_ends(LIMIT).await?;
    ensure!(status.success(), "the actor ended with {status}: {}", actor.log());
    let mut learner = system.learner.take().context("no learner")?;
    let status = learner.until_it_ends(LIMIT).await?;
    ensure!(status.success(), "the learner ended with {status}: {}", learner.log());
    Ok(())
}

/// A learner that ends without serving, with its log.
async fn refused(system: &mut System) -> Result<String> {
    let _ = system.start_learner(LIMIT).await;
    let mut learner = system.learner.take().context("no learner")?;
    let status = learner.until_it_ends(LIMIT).await?;
    ensure!(status.code() == Some(2), "the learner ended with {status}: {}", learner.log());
    Ok(learner.log())
}

fn export(run_directory: &Path, part: &str, out: &Path) -> Result<()> {
    let mut command = Command::new(program("comic-learner")?);
    command.args(["export", "--part", part, "--checkpoint"]).arg(run_directory).arg("--out").arg(out);
    run(&mut command).map(drop)
}

/// A low level that a short run of tracking learned, as a file.
async fn low_level(directory: &Path, name: &str, fields: &[&str]) -> Result<PathBuf> {
    let mut tracking = short(fields)?;
    train(&mut tracking).await?;
    let file = directory.join(name);
    export(&tracking.run(), "low-level", &file)?;
    Ok(file)
}

/// Go-to-target with this frozen low level.
fn transfer(low_level: &Path, fields: &[&str]) -> Result<System> {
    let low_level = format!("transfer.low_level={}", low_level.display());
    let plain = ["task=go-to-target", "vmpo.action_gradient=0", "network.initial_pose=mid-range"];
    short(&[&plain[..], &[low_level.as_str()], fields].concat())
}

fn normalised_reward(policy: &Path) -> Result<Value> {
    let mut command = Command::new(program("comic-actor")?);
    command.args(["evaluate", "--deterministic", "--episodes", "2", "--json", "--policy"]).arg(policy);
    let report: Value = serde_json::from_slice(&run(&mut command)?.stdout)?;
    Ok(report["overall"].clone())
}

#[tokio::test]
async fn a_frozen_low_level_acts_in_another_task_and_stays_as_it_was() -> Result<()> {
    let directory = tempfile::tempdir()?;
    // The kind of the low level and its sizes come from the file.
    for kind in ["mlp", "lstm"] {
        let fields = [format!("network.low_level={kind}"), "network.lstm.units=[12, 8]".into()];
        let fields: Vec<&str> = fields.iter().map(String::as_str).collect();
        let file = low_level(directory.path(), &format!("{kind}.safetensors"), &fields).await?;
        let mut system = transfer(&file, &[])?;
        train(&mut system).await?;
        let checkpoint = system.run().join("checkpoints/checkpoint-0000000002");
        let (frozen, given) = (fs::read(checkpoint.join("low_level.safetensors"))?, fs::read(&file)?);
        ensure!(frozen == given, "the low level changed");
        let experiment = fs::read_to_string(checkpoint.join("experiment.toml"))?;
        ensure!(experiment.contains(&format!("low_level = \"{kind}\"")), "{experiment}");

        // The exported policy holds both, and acts as its checkpoint does.
        let policy = directory.path().join(format!("{kind}-policy.safetensors"));
        export(&system.run(), "policy", &policy)?;
        let (from_file, from_run) = (normalised_reward(&policy)?, normalised_reward(&system.run())?);
        ensure!(from_file == from_run && from_file["episodes"] == 2, "{from_file} and {from_run}");
    }
    Ok(())
}

#[tokio::test]
async fn a_run_keeps_the_low_level_of_another_runs_directory_and_refuses_another_one() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let mut tracking = short(&[])?;
    train(&mut tracking).await?;
    let mut system = transfer(&tracking.run(), &[])?;
    train(&mut system).await?;

    // The run of the low level goes on, and its directory disappears: the transfer's own checkpoint has the low level.
    tracking.set("budget.updates=3");
    train(&mut tracking).await?;
    system.set("budget.updates=3");
    train(&mut system).await?;
    let source = tracking.run();
    drop(tracking);
    ensure!(!source.exists(), "the low level's run is still there");
    system.set("budget.updates=4");
    train(&mut system).await?;

    let other = low_level(directory.path(), "other.safetensors", &["seed=2"]).await?;
    system.set("budget.updates=5");
    system.set(&format!("transfer.low_level={}", other.display()));
    let said = refused(&mut system).await?;
    ensure!(said.contains("transfer.sha256 was"), "{said}");
    // The same low level from another place is the same one.
    let kept = system.run().join("low_level.safetensors");
    system.set(&format!("transfer.low_level={}", kept.display()));
    train(&mut system).await
}

#[tokio::test]
async fn a_low_level_that_cannot_be_used_ends_the_learner_with_2_and_says_why() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let mut tracking = short(&[])?;
    train(&mut tracking).await?;
    let file = |name: &str| directory.path().join(name);
    export(&tracking.run(), "policy", &file("policy.safetensors"))?;
    export(&tracking.run(), "low-level", &file("whole.safetensors"))?;
    let whole = fs::read(file("whole.safetensors"))?;
    fs::write(file("cut.safetensors"), &whole[..whole.len() / 2])?;
    let mixture = ["network.low_level=mixture", "vmpo.control_variate=0"];
    low_level(directory.path(), "mixture.safetensors", &mixture).await?;
    let zeros = format!("transfer.sha256={}", "0".repeat(64));
    for (name, field, reason) in [
        ("absent.safetensors", "seed=1", "No such file"),
        ("cut.safetensors", "seed=1", "not a valid safetensors document"),
        ("policy.safetensors", "seed=1", "--part low-level"),
        ("whole.safetensors", zeros.as_str(), "its SHA-256 is"),
        ("mixture.safetensors", "vmpo.action_gradient=1", "is a mixture"),
    ] {
        let said = refused(&mut transfer(&file(name), &[field])?).await?;
        ensure!(said.contains("transfer.low_level") && said.contains(reason), "{name}: {said}");
    }
    let mut joint = transfer(&file("whole.safetensors"), &[r#"joint=[{task="get-up", probability=0.3}]"#])?;
    let said = refused(&mut joint).await?;
    ensure!(said.contains("must be empty with transfer.low_level"), "{said}");
    Ok(())
}

#[tokio::test]
async fn a_checkpoint_of_a_transfer_is_evaluated_while_it_trains() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let file = low_level(directory.path(), "low_level.safetensors", &[]).await?;
    let mut system = transfer(&file, &["budget.updates=0"])?;
    system.start_learner(LIMIT).await?;
    let _actor = system.start_actor_of(ENVIRONMENTS, &system.url())?;
    let evaluator = system.start("comic-actor", &["evaluate", "--watch", "--nice", "0"])?;
    let evaluations = system.run().join("evaluations.jsonl");
    let read = || fs::read_to_string(&evaluations).ok().filter(|text| text.contains("go-to-target"));
    system.until("a checkpoint is evaluated", LIMIT, |_| read()).await.with_context(|| evaluator.log())?;
    Ok(())
}

/// The rows of `comic-actor assess --json`: the source of latents, and the seconds upright.
fn assessed(low_level: &Path) -> Result<Vec<(String, f64)>> {
    let mut command = Command::new(program("comic-actor")?);
    command.args(["assess", "--json", "--episodes", "3", "--seconds", "0.5", "--low-level"]).arg(low_level);
    let assessment: Value = serde_json::from_slice(&run(&mut command)?.stdout)?;
    let rows = assessment["rows"].as_array().context("no rows")?;
    // Half a second is too short to pass.
    ensure!(assessment["gate"].is_null() || assessment["gate"]["passed"] == false, "{assessment}");
    ensure!(assessment["gate"].is_null() == rows.iter().all(|row| row["latents"] != "p(z | s)"), "{assessment}");
    let row = |row: &Value| Some((row["latents"].as_str()?.to_owned(), row["seconds_upright"].as_f64()?));
    rows.iter().map(|found| row(found).with_context(|| format!("{found}"))).collect()
}

#[tokio::test]
async fn a_prior_is_fitted_to_latents_and_a_policy_deviates_from_it() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let mut tracking = short(&[])?;
    train(&mut tracking).await?;
    let file = |name: &str| directory.path().join(name);
    export(&tracking.run(), "low-level", &file("low_level.safetensors"))?;
    let mut command = Command::new(program("comic-actor")?);
    command.args(["latents", "--count", "2000", "--checkpoint"]).arg(tracking.run());
    run(command.arg("--out").arg(file("latents.safetensors")))?;
    let mut command = Command::new(program("comic-learner")?);
    command.args(["prior", "--steps", "50", "--hidden", "16,16"]);
    command.arg("--low-level").arg(file("low_level.safetensors")).arg("--latents").arg(file("latents.safetensors"));
    run(command.arg("--out").arg(file("with_prior.safetensors")))?;

    let (without, with) = (assessed(&file("low_level.safetensors"))?, assessed(&file("with_prior.safetensors"))?);
    let names = |rows: &[(String, f64)]| rows.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
    ensure!(names(&without) == ["N(0, I)", "z = 0", "untrained, N(0, I)"], "{without:?}");
    ensure!(names(&with)[..2] == ["p(z | s)", "μ(s)"] && with[2..] == without, "{with:?}");
    ensure!(with.iter().all(|(_, seconds)| (0.03..=0.51).contains(seconds)), "{with:?}");

    let said = refused(&mut transfer(&file("low_level.safetensors"), &["transfer.prior=state"])?).await?;
    ensure!(said.contains("comic-learner prior"), "{said}");
    let mut deviates = transfer(&file("with_prior.safetensors"), &["transfer.prior=state"])?;
    train(&mut deviates).await?;
    normalised_reward(&deviates.run())?;
    Ok(())
}

/// Go-to-target with SVG(0) and small networks, which learns from the second batch on; in lockstep.
const SVG0: [&str; 33] = [
    "--lockstep",
    "--preset",
    "go-to-target",
    "--clips",
    "builtin:CMU_007_01",
    "--set",
    "algorithm=svg0",
    "--set",
    "svg0.encoder=[16]",
    "--set",
    "svg0.core=12",
    "--set",
    "svg0.policy=10",
    "--set",
    "svg0.action_value=[16]",
    "--set",
    "svg0.burn_in=2",
    "--set",
    "svg0.minibatch_sequences=8",
    "--set",
    "replay.min_size=128",
    "--set",
    "replay.samples_per_insert=4",
    "--set",
    "network.normaliser_steps=256",
    "--set",
    "unroll.length=8",
    "--set",
    "unroll.batch=8",
    "--set",
    "actor.environments=2",
    "--set",
    "budget.minutes=0",
];

fn svg0(fields: &[&str]) -> Result<System> {
    System::new(&SVG0.into_iter().chain(fields.iter().flat_map(|field| ["--set", *field])).collect::<Vec<_>>())
}

/// The learner's part of the newest checkpoint.
fn learned(system: &System, updates: u64) -> Result<Vec<u8>> {
    let checkpoint = system.run().join(format!("checkpoints/checkpoint-{updates:010}"));
    Ok(fs::read(checkpoint.join("learner.safetensors"))?)
}

#[tokio::test]
async fn svg0_learns_from_its_replay_and_in_lockstep_the_seed_decides_every_parameter() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let file =
        low_level(directory.path(), "low_level.safetensors", &["network.low_level=lstm", "network.lstm.units=[12, 8]"])
            .await?;
    let low_level = format!("transfer.low_level={}", file.display());
    let fields = ["budget.updates=4", low_level.as_str()];
    let mut one = svg0(&fields)?;
    train(&mut one).await?;
    let mut other = svg0(&fields)?;
    train(&mut other).await?;
    ensure!(learned(&one, 4)? == learned(&other, 4)?, "the same seed gave other parameters");
    let metrics = fs::read_to_string(one.run().join("metrics.jsonl"))?;
    ensure!(metrics.contains("retrace_target"), "no gradient step: {metrics}");

    let policy = directory.path().join("policy.safetensors");
    export(&one.run(), "policy", &policy)?;
    let (from_file, from_run) = (normalised_reward(&policy)?, normalised_reward(&one.run())?);
    ensure!(from_file == from_run && from_file["episodes"] == 2, "{from_file} and {from_run}");
    export(&one.run(), "policy", &directory.path().join("policy.pt"))
}

#[tokio::test]
async fn svg0_also_learns_without_a_low_level() -> Result<()> {
    let mut scratch = svg0(&["transfer.mean_scale=1", "budget.updates=3"])?;
    train(&mut scratch).await?;
    normalised_reward(&scratch.run()).map(drop)
}

/// The description of a low level, as `comic-learner low-level --json` prints it.
fn described(low_level: &Path) -> Result<Value> {
    let mut command = Command::new(program("comic-learner")?);
    Ok(serde_json::from_slice(&run(command.args(["low-level", "--json"]).arg(low_level))?.stdout)?)
}

#[tokio::test]
async fn a_transfer_needs_no_file_of_ones_own() -> Result<()> {
    let builtin = Path::new("builtin");
    let mut system = transfer(builtin, &["transfer.prior=state"])?;
    train(&mut system).await?;
    let kept = system.run().join("low_level.safetensors");
    ensure!(described(builtin)? == described(&kept)?, "the run has another low level");
    ensure!(assessed(builtin)? == assessed(&kept)?, "it acts otherwise");
    let mut command = Command::new(program("comic-learner")?);
    let text = String::from_utf8(run(command.arg("low-level").arg(builtin))?.stdout)?;
    ensure!(text.contains("builtin:CMU_007_01") && text.contains("SHA-256"), "{text}");
    Ok(())
}
