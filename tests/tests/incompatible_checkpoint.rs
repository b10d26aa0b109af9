//! A checkpoint that is whole but incompatible: a restart would find the same one, so the learner ends with the exit code
//! for errors that a restart does not repair.

use std::collections::BTreeMap;
use std::fs;

use anyhow::{Context as _, Result, ensure};
use comic_tests::steps::{LIMIT, checkpoint_in, leaves, newest_checkpoint};
use comic_tests::system::{SMALL, System};
use sha2::{Digest as _, Sha256};

#[tokio::test]
async fn an_incompatible_checkpoint_ends_the_learner_with_2() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    newest_checkpoint(&mut system).await?;
    leaves(actor).await?;
    system.learner.take().context("no learner")?.terminate(LIMIT).await?;
    let newest = checkpoint_in(&system.run()).context("no checkpoint")?;
    let manifest = system.run().join(format!("checkpoints/checkpoint-{newest:010}/MANIFEST.json"));
    let whole = fs::read(&manifest)?;
    let parts: BTreeMap<String, String> = serde_json::from_slice(&whole)?;
    for part in ["accounting.json", "progress.json", "task.json", "learner.safetensors", "experiment.toml"] {
        let mut without = parts.clone();
        without.remove(part).context("no such part")?;
        fs::write(&manifest, serde_json::to_vec(&without)?)?;
        // The learner may serve for a moment, until the trainer reads its part of the checkpoint.
        let _ = system.start_learner(LIMIT).await;
        let mut learner = system.learner.take().context("no learner")?;
        let status = learner.until_it_ends(LIMIT).await.with_context(|| format!("without {part}"))?;
        let said = learner.log();
        ensure!(status.code() == Some(2), "{part}: {status}: {said}");
        for word in ["cannot be resumed", &format!("`{part}`")] {
            ensure!(said.contains(word), "no `{word}`: {said}");
        }
    }
    // A checkpoint of the release before: whole, but of another format.
    let file = manifest.with_file_name("progress.json");
    let progress = fs::read(&file)?;
    let mut earlier: serde_json::Value = serde_json::from_slice(&progress)?;
    earlier.as_object_mut().and_then(|fields| fields.remove("format")).context("no format")?;
    let earlier = serde_json::to_vec(&earlier)?;
    let mut parts = parts;
    parts.insert("progress.json".into(), hex::encode(Sha256::digest(&earlier)));
    fs::write(&file, &earlier)?;
    fs::write(&manifest, serde_json::to_vec(&parts)?)?;
    let _ = system.start_learner(LIMIT).await;
    let mut learner = system.learner.take().context("no learner")?;
    let status = learner.until_it_ends(LIMIT).await?;
    let said = learner.log();
    ensure!(
        status.code() == Some(2) && said.contains("has format 1, and this release reads format 2"),
        "{status}: {said}"
    );

    fs::write(&file, &progress)?;
    fs::write(&manifest, &whole)?;
    system.start_learner(LIMIT).await.context("the run does not resume from the whole checkpoint").map(drop)
}
