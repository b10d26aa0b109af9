//! TensorBoard reads the curves of a run. They equal those of `metrics.jsonl`, also after the learner was killed and
//! restarted. Several runs are a table.

use std::fs;

use anyhow::{Context, Result, ensure};
use comic_tests::steps::{LIMIT, kill_and_restart_the_learner, trains_on};
use comic_tests::system::{SMALL, System};
use comic_tests::tensorboard::{curves, read};
use serde_json::Value;

#[tokio::test]
async fn tensorboard_reads_the_curves_of_a_run_that_was_killed_once() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let _actor = system.start_actor()?;
    trains_on(&mut system, "the learner trains").await?;
    kill_and_restart_the_learner(&mut system).await?;
    trains_on(&mut system, "training continues after the restart").await?;
    let status = system.learner.take().context("no learner")?.terminate(LIMIT).await?;
    ensure!(status.code() == Some(4), "the learner ended with {status}");

    let curves = curves(&system.run().join("tensorboard"))?;
    let text = fs::read_to_string(system.run().join("metrics.jsonl"))?;
    let lines = text.lines().map(serde_json::from_str).collect::<Result<Vec<Value>, _>>()?;

    let epoch = lines.last().context("no line of metrics")?["learner_epoch"].clone();
    let (before, after): (Vec<&Value>, Vec<&Value>) = lines.iter().partition(|line| line["learner_epoch"] != epoch);
    ensure!(!before.is_empty() && !after.is_empty(), "the run had no two learner epochs");
    for (tag, pointer) in [("updates", "/updates"), ("losses/latent_kl", "/losses/latent_kl")] {
        let curve = curves.get(tag).with_context(|| format!("no curve of {tag}"))?;
        let points = |lines: &[&Value]| -> Vec<(u64, f32)> {
            let point =
                |line: &&Value| Some((line["environment_steps"].as_u64()?, line.pointer(pointer)?.as_f64()? as f32));
            lines.iter().filter_map(point).collect()
        };
        let curve: Vec<_> = curve.iter().map(|(step, value)| (*step, *value as f32)).collect();
        let own = points(&after);
        ensure!(curve.ends_with(&own), "{tag} of the last epoch: {own:?} is not the end of {curve:?}");
        let earlier = &curve[..curve.len() - own.len()];
        ensure!(points(&before).starts_with(earlier), "{tag} of the first epoch: {earlier:?}");
        ensure!(curve.is_sorted_by_key(|(step, _)| *step), "{tag} goes back: {curve:?}");
    }
    Ok(())
}

#[tokio::test]
async fn several_runs_are_a_table_with_their_experiments_and_the_newest_evaluations() -> Result<()> {
    let runs = tempfile::tempdir()?;
    let mut reward = None;
    for (name, eta) in [("low", 0.125), ("high", 0.5)] {
        let mut system = System::new(&SMALL)?;
        system.set(&format!("vmpo.epsilon_eta={eta}"));
        system.start_learner(LIMIT).await?;
        let _actor = system.start_actor()?;
        let run = system.run();
        if name == "high" {
            // Without noise and without films, which would need OpenGL.
            let _evaluator = system.start("comic-actor", &["evaluate", "--watch", "--nice", "0", "--every", "0"])?;
            let line = || fs::read_to_string(run.join("evaluations.jsonl")).ok().filter(|text| text.ends_with('\n'));
            system.until("a checkpoint is evaluated", LIMIT, |_| line()).await?;
        }
        let status = system.learner.take().context("no learner")?.terminate(LIMIT).await?;
        ensure!(status.code() == Some(4), "the learner ended with {status}");
        if let Ok(text) = fs::read_to_string(run.join("evaluations.jsonl")) {
            let line: Value = serde_json::from_str(text.lines().last().context("no evaluation")?)?;
            reward = line["evaluation"]["overall"]["normalised_reward"].as_f64();
        }
        fs::create_dir(runs.path().join(name))?;
        for file in fs::read_dir(run.join("tensorboard"))? {
            fs::copy(file?.path(), runs.path().join(name).join("events.out.tfevents.1"))?;
        }
    }
    let table = read(runs.path())?;
    ensure!(table.metrics == ["evaluation/normalised_reward"], "{:?}", table.metrics);
    let types = ["vmpo.epsilon_eta", "unroll.lockstep", "network.encoder"].map(|name| table.columns[name].as_str());
    ensure!(types == ["float64", "bool", "string"], "{types:?}");
    let [low, high] = ["low", "high"].map(|name| &table.rows[name]);
    ensure!((&low.fields["vmpo.epsilon_eta"], &high.fields["vmpo.epsilon_eta"]) == (&0.125.into(), &0.5.into()));
    ensure!(high.fields["network.encoder"] == "[32]", "{:?}", high.fields);
    ensure!(low.metrics.is_empty(), "{:?}", low.metrics);
    let found = high.metrics.get("evaluation/normalised_reward").map(|reward| *reward as f32);
    ensure!(found == reward.map(|reward| reward as f32), "{found:?} instead of {reward:?}");
    let texts = read(&runs.path().join("high"))?.texts;
    ensure!(texts["experiment"].contains("    epsilon_eta = 0.5\n"), "{texts:?}");
    Ok(())
}
