//! A checkpoint that verifies and cannot be gone on with: whoever starts the learner again would find the same, so it says so
//! by its exit code.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use comic_tests::steps::{LIMIT, checkpoint_in, leaves, newest_checkpoint};
use comic_tests::system::{SMALL, System, program};
use serde_json::Value;

#[tokio::test]
async fn starting_again_does_not_help_and_the_exit_code_says_so() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    newest_checkpoint(&mut system).await?;
    leaves(actor).await?;
    system.learner.take().context("no learner")?.terminate(LIMIT).await?;
    let newest = checkpoint_in(&system.run()).context("no checkpoint")?;
    let checkpoint = system.run().join(format!("checkpoints/checkpoint-{newest:010}"));
    let manifest: BTreeMap<String, String> = serde_json::from_slice(&fs::read(checkpoint.join("MANIFEST.json"))?)?;
    for part in ["books.json", "progress.json", "task.json", "learner.safetensors", "experiment.toml"] {
        let mut without = manifest.clone();
        without.remove(part).context("no such part")?;
        fs::write(checkpoint.join("MANIFEST.json"), serde_json::to_vec(&without)?)?;
        is_refused(&system.run(), part)?;
    }
    let last: Value = serde_json::from_slice(&fs::read(checkpoint.join("books.json"))?)?;
    ensure!(last.is_object(), "nothing was lost meanwhile: {last}");
    Ok(())
}

fn is_refused(run: &Path, part: &str) -> Result<()> {
    let mut learner = std::process::Command::new(program("comic-learner")?);
    let output = learner.args(SMALL).args(["--port", "0", "--run"]).arg(run).output().context("cannot start")?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(2), "{part}: {}: {said}", output.status);
    ensure!(said.contains(&format!("`{part}`")) && said.contains("cannot be resumed"), "{part}: {said}");
    Ok(())
}
