//! The learner does not start without protection on an address that other machines can reach. Its error names the remedy.

use std::process::Command;

use anyhow::{Result, ensure};
use comic_tests::system::program;

#[test]
fn the_learner_serves_other_machines_without_protection_only_when_told() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let mut command = Command::new(program("comic-learner")?);
    command.args(["--preset", "quickstart", "--address", "0.0.0.0", "--port", "0", "--run"]).arg(directory.path());
    let output = command.env_remove("COMIC_TOKEN").env_remove("COMIC_TOKEN_FILE").output()?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(2), "{}: {said}", output.status);
    for remedy in ["--token-file", "--cert", "--insecure"] {
        ensure!(said.contains(remedy), "{remedy} is not named: {said}");
    }
    Ok(())
}
