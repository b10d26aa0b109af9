//! A checkpoint that verifies and cannot be gone on with: whoever starts the learner again would find the same, so it says so
//! by its exit code.

use std::collections::BTreeMap;
use std::fs;

use anyhow::{Context as _, Result, ensure};
use comic_tests::steps::{LIMIT, checkpoint_in, leaves, newest_checkpoint};
use comic_tests::system::{SMALL, System};

#[tokio::test]
async fn starting_again_does_not_help_and_the_exit_code_says_so() -> Result<()> {
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
        // It may serve for a moment: what the trainer needs, the trainer reads.
        let _ = system.start_learner(LIMIT).await;
        let mut learner = system.learner.take().context("no learner")?;
        let status = learner.until_it_ends(LIMIT).await.with_context(|| format!("without {part}"))?;
        let said = learner.log();
        ensure!(status.code() == Some(2), "{part}: {status}: {said}");
        for word in ["cannot be resumed", &format!("`{part}`")] {
            ensure!(said.contains(word), "no `{word}`: {said}");
        }
    }
    fs::write(&manifest, &whole)?;
    system.start_learner(LIMIT).await.context("nothing was lost meanwhile").map(drop)
}
