//! TensorBoard reads the curves of a run. They equal those of `metrics.jsonl`, also after the learner was killed and
//! restarted.

use std::fs;

use anyhow::{Context, Result, ensure};
use comic_tests::steps::{LIMIT, kill_and_restart_the_learner, trains_on};
use comic_tests::system::{SMALL, System};
use comic_tests::tensorboard::curves;
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
