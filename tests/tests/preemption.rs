//! A minute of `cargo xtask bench preemption`: actors are killed at random, and the learner once, while they train.

use std::fs;
use std::process::Command;

use anyhow::{Context as _, Result, ensure};
use comic_tests::accounting::balance_of_json;
use comic_tests::system::{SMALL, program};
use serde_json::Value;

#[test]
fn actors_and_a_learner_that_are_taken_away_lose_no_unroll_uncounted() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let run = directory.path().join("run");
    let mut bench = Command::new(program("xtask")?);
    // Each of three actors is killed every fifteen seconds: twelve kills are expected.
    bench.args(["bench", "preemption", "--", "--actors", "3", "--rate", "400", "--run"]).arg(&run);
    // Without the names of preset and clip, which are the default.
    bench.args(&SMALL[4..]).args(["--set", "budget.minutes=1", "--set", "learner.checkpoint_seconds=5"]);
    // The programs are built already. Another build would compile beside the other tests.
    bench.env("CARGO", "true");
    for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("COMIC_")) {
        bench.env_remove(name);
    }
    let output = bench.output().context("cannot start xtask")?;
    let [said, errors] = [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes));
    ensure!(output.status.success(), "it ended with {}: {said}{errors}", output.status);

    let figures = said.lines().map(serde_json::from_str).collect::<Result<Vec<Value>, _>>()?;
    let figure = |name: &str| {
        let found = figures.iter().find(|figure| figure["figure"] == format!("preemption.{name}"));
        found.with_context(|| format!("no figure {name} in {said}"))
    };
    let kills = figure("kills")?;
    ensure!(kills["value"].as_u64() > Some(0), "no actor was killed: {kills}");
    ensure!(kills["learner"] == 1, "the learner was not killed: {kills}");
    ensure!(kills["minutes"].as_f64() >= Some(1.0), "the run did not come to its end: {kills}");
    let made = figure("made")?;
    ensure!(made["processes"].as_u64() > Some(3), "no actor was replaced: {made}");

    let metrics = fs::read_to_string(run.join("metrics.jsonl"))?;
    ensure!(!metrics.is_empty(), "the learner wrote no metrics");
    for line in metrics.lines() {
        let line: Value = serde_json::from_str(line)?;
        ensure!(balance_of_json(&line["accounting"]), "the accounting does not balance: {line}");
    }
    Ok(())
}
