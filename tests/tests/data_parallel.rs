//! Two learners train one run, as real processes: each serves its actors, a rank is killed, and the run survives.

use std::fs;

use anyhow::{Context, Result, ensure};
use comic_proto::v1::Accounting;
use comic_tests::accounting::balance_of_json;
use comic_tests::ranks::{Ranks, accounting_of_all};
use comic_tests::steps::{LIMIT, checkpoint_in, newest_checkpoint};
use comic_tests::system::{Answered, SMALL, metric};
use serde_json::Value;

/// More unrolls than can be in flight.
const MANY: u64 = 300;

#[tokio::test]
async fn two_learners_train_one_run_and_survive_the_loss_of_one() -> Result<()> {
    let mut ranks = Ranks::new(2, &[&SMALL[..], &["--metrics-port", "0"]].concat())?;
    let first = ranks.start().await?;

    // Both actors know the address of rank 0 only. One of them is sent to rank 1.
    let mut actors = [ranks.system.start_actor()?, ranks.system.start_actor()?];
    for actor in &mut actors {
        actor.until_log_holds("joined the learner", LIMIT).await?;
    }
    ranks.others[0].until_log_holds("actor joined", LIMIT).await?;
    let before = trains(&mut ranks).await?;
    // The alert on missing checkpoints asks only rank 0.
    for (rank, learner) in ranks.system.learner.iter().chain(&ranks.others).enumerate() {
        let page = learner.metrics_page()?;
        ensure!(page.contains(&format!("\ncomic_rank {rank}\n")), "not rank {rank}: {page}");
    }
    ensure!(
        metric(&ranks.system.status().await?, "updates") * 8.0 >= before.trained as f64,
        "an unroll is counted twice"
    );

    // A rank that dies ends the step of the other one, which says so.
    newest_checkpoint(&mut ranks.system).await?;
    ranks.others.remove(0).kill()?;
    let mut survivor = ranks.system.learner.take().context("no learner")?;
    let ended = survivor.until_it_ends(LIMIT).await?;
    let log = survivor.log();
    ensure!(ended.code() == Some(5) && log.contains("rank 0 lost another rank"), "{ended}: {log}");

    // All ranks are started again. The actors find their learners.
    let resumed = ranks.start().await?;
    ensure!(resumed.learner_epoch > first.learner_epoch, "a restarted learner must begin a new epoch");
    for actor in &mut actors {
        actor.until_log_holds(&format!("learner_epoch={}", resumed.learner_epoch), LIMIT).await?;
    }
    trains(&mut ranks).await?;

    // A signal to any rank stops all of them, with a checkpoint.
    ranks.others[0].ask_to_end()?;
    stopped(&mut ranks, 4).await?;
    let updates = checkpoint_in(&ranks.system.run()).context("no checkpoint")?;
    let checkpoint = ranks.system.run().join(format!("checkpoints/checkpoint-{updates:010}"));
    let saved: Value = serde_json::from_slice(&fs::read(checkpoint.join("accounting.json"))?)?;
    ensure!(balance_of_json(&saved["accounting"]), "{saved}");
    ensure!(saved["accounts"].as_array().is_some_and(|accounts| accounts.len() == 2), "{saved}");

    // The end of the run ends everyone.
    ranks.system.set(&format!("budget.updates={}", updates + 100));
    ranks.start().await?;
    let logs = stopped(&mut ranks, 0).await?;
    for actor in &mut actors {
        let ended = actor.until_it_ends(LIMIT).await?;
        ensure!(ended.success(), "an actor ended with {ended}: {}", actor.log());
    }
    let lines = fs::read_to_string(ranks.system.run().join("metrics.jsonl"))?;
    let lines = lines.lines().map(serde_json::from_str).collect::<Result<Vec<Value>, _>>()?;
    ensure!(lines.iter().all(|line| balance_of_json(&line["accounting"])), "a line does not balance");
    let last = lines.last().context("no metrics")?;
    let Answered { unrolls, .. } = ranks.system.answered()?;
    // A rank serves its actors for some seconds after the last line.
    let produced = logs.iter().map(|log| last_produced(log)).sum::<Result<u64>>()?;
    ensure!(unrolls <= produced, "{unrolls} unrolls were acknowledged, and {produced} were counted: {last}");
    ensure!(last["updates"] == updates + 100, "{last}");
    Ok(())
}

#[tokio::test]
async fn actors_get_the_frozen_low_level_of_a_transfer_from_every_rank() -> Result<()> {
    let mut ranks = Ranks::new(2, &SMALL)?;
    for field in ["task=go-to-target", "vmpo.action_gradient=0", "network.initial_pose=mid-range"] {
        ranks.system.set(field);
    }
    ranks.system.set("transfer.low_level=builtin");
    ranks.system.set("budget.updates=20");
    ranks.start().await?;
    let mut actors = [ranks.system.start_actor()?, ranks.system.start_actor()?];
    stopped(&mut ranks, 0).await?;
    for actor in &mut actors {
        let ended = actor.until_it_ends(LIMIT).await?;
        ensure!(ended.success(), "an actor ended with {ended}: {}", actor.log());
    }
    Ok(())
}

#[tokio::test]
async fn a_rank_with_another_experiment_is_refused_with_the_fields_that_differ() -> Result<()> {
    let mut ranks = Ranks::new(2, &SMALL)?;
    let mut other = ranks.start_rank(1, &["--set", "optimiser.beta1=0.5"])?;
    let mut first = ranks.start_rank(0, &[])?;
    let ended = other.until_it_ends(LIMIT).await?;
    ensure!(ended.code() == Some(2), "{ended}: {}", other.log());
    ensure!(other.log().contains("optimiser.beta1 is 0.9 there and 0.5 here"), "{}", other.log());
    let ended = first.until_it_ends(LIMIT).await?;
    ensure!(ended.code() == Some(5), "{ended}: {}", first.log());
    Ok(())
}

/// Waits until many more unrolls are trained on, and returns the accounting of all ranks.
async fn trains(ranks: &mut Ranks) -> Result<Accounting> {
    let trained = |accounting: &Accounting| accounting.trained;
    let before = ranks.system.until("metrics", LIMIT, |status| accounting_of_all(status).ok()).await?;
    let more = |status: &_| accounting_of_all(status).ok().filter(|now| trained(now) >= trained(&before) + MANY);
    ranks.system.until("both ranks train", LIMIT, more).await
}

/// Waits until every rank has ended with this code, and returns their logs.
async fn stopped(ranks: &mut Ranks, code: i32) -> Result<Vec<String>> {
    let first = ranks.system.learner.take().context("no learner")?;
    let mut logs = Vec::new();
    for mut rank in std::mem::take(&mut ranks.others).into_iter().chain([first]) {
        let ended = rank.until_it_ends(LIMIT).await?;
        ensure!(ended.code() == Some(code), "a rank ended with {ended}: {}", rank.log());
        logs.push(rank.log());
    }
    Ok(logs)
}

/// The unrolls that a rank has counted in all, from its last line.
fn last_produced(log: &str) -> Result<u64> {
    let (_, rest) = log.rsplit_once("Accounting { produced: ").context("no accounting")?;
    Ok(rest.split(',').next().unwrap_or_default().parse()?)
}
