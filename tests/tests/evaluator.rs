//! `comic-actor evaluate --watch` beside a run: it evaluates the newest checkpoints, survives the learner, and is no actor.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use comic_tests::steps::{LIMIT, kill_and_restart_the_learner};
use comic_tests::system::{SMALL, System};
use serde_json::Value;

/// The evaluations of a run, oldest first.
fn evaluations(run: &Path) -> Vec<Value> {
    let text = fs::read_to_string(run.join("evaluations.jsonl")).unwrap_or_default();
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

/// Waits until `enough` holds for the evaluations, and returns them.
async fn until(system: &mut System, what: &str, enough: impl Fn(&[Value]) -> bool) -> Result<Vec<Value>> {
    let run = system.run();
    system.until(what, LIMIT, |_| Some(evaluations(&run)).filter(|found| enough(found))).await
}

#[tokio::test]
async fn the_newest_checkpoints_are_evaluated_while_it_trains_and_best_follows() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.set("learner.checkpoints_kept=1000");
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    let evaluator = system.start("comic-actor", &["evaluate", "--watch", "--nice", "0", "--every", "0"])?;

    let found = until(&mut system, "two checkpoints are evaluated", |found| found.len() >= 2).await?;
    let number = |line: &Value, name: &str| line[name].as_u64().with_context(|| format!("no {name} in {line}"));
    ensure!(number(&found[0], "updates")? < number(&found[1], "updates")?, "{found:?}");
    ensure!(number(&found[1], "environment_steps")? > 0 && found[1]["seconds"].as_f64() > Some(0.0), "{found:?}");
    let report = &found[0]["evaluation"];
    ensure!(report["deterministic"] == true && report["overall"]["episodes"] == 64, "{report}");

    let actors = system.status().await?.actors.context("no actors")?;
    ensure!(actors.alive == 1, "the evaluator counts as an actor: {actors:?}");

    let resumed = kill_and_restart_the_learner(&mut system).await?;
    let of_the_new_epoch = |line: &Value| line["learner_epoch"] == resumed.learner_epoch;
    until(&mut system, "the evaluator continues", |found| found.iter().any(of_the_new_epoch)).await?;

    let best = fs::read_to_string(system.run().join("checkpoints/best.json"))?;
    let best: Value = serde_json::from_str(&best)?;
    ensure!(
        evaluations(&system.run()).iter().any(|line| line["updates"] == best["updates"]
            && line["evaluation"]["overall"]["normalised_reward"] == best["normalised_reward"]),
        "{best} was not evaluated"
    );
    let status = evaluator.terminate(LIMIT).await?;
    ensure!(status.code() == Some(1), "an evaluator after SIGTERM ended with {status}");
    drop(actor);
    Ok(())
}

#[tokio::test]
async fn opengl_every_evaluation_has_a_film() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let _actor = system.start_actor()?;
    let evaluator = system.start("comic-actor", &["evaluate", "--watch", "--nice", "0"])?;
    let found = until(&mut system, "a checkpoint is evaluated", |found| !found.is_empty()).await?;
    let updates = found[0]["updates"].as_u64().context("no updates")?;
    let film = system.run().join(format!("films/{updates:010}.gif"));
    // The line of the evaluation is written first.
    let what = "the film is written";
    let bytes = system.until(what, LIMIT, |_| fs::read(&film).ok().filter(|bytes| bytes.ends_with(b";"))).await?;
    ensure!(bytes.starts_with(b"GIF89a"), "{}", evaluator.log());
    Ok(())
}

#[tokio::test]
async fn an_evaluator_ends_with_0_when_the_run_is_over() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let mut evaluator = system.start("comic-actor", &["evaluate", "--watch", "--nice", "0"])?;
    let actor = system.start_actor()?;
    until(&mut system, "a checkpoint is evaluated", |found| !found.is_empty()).await?;
    // The budget is the only thing that ends a run, and it may change when a run resumes.
    system.learner.take().context("no learner")?.terminate(LIMIT).await?;
    system.set("budget.updates=1");
    system.start_learner(LIMIT).await?;
    let status = evaluator.until_it_ends(LIMIT).await?;
    ensure!(status.success(), "the evaluator ended with {status}: {}", evaluator.log());
    drop(actor);
    Ok(())
}

#[tokio::test]
async fn an_evaluator_with_a_wrong_configuration_ends_with_2_and_says_what_is_wrong() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    let mut evaluator = system.start("comic-actor", &["evaluate", "--watch", "--ca", "/absent.pem"])?;
    let status = evaluator.until_it_ends(LIMIT).await?;
    ensure!(status.code() == Some(2) && evaluator.log().contains("--ca"), "{status}: {}", evaluator.log());
    Ok(())
}

#[tokio::test]
async fn actors_and_evaluators_that_give_up_on_the_learner_end_with_3() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    for command in [&["evaluate", "--watch"][..], &[]] {
        let mut program = system.start("comic-actor", &[command, &["--give-up-after", "1"]].concat())?;
        let status = program.until_it_ends(LIMIT).await?;
        ensure!(status.code() == Some(3) && program.log().contains("has not answered for 1 s"), "{}", program.log());
    }
    Ok(())
}
