//! On an address that others can reach the learner does not start without protection, and says what to do.

use std::process::Command;

use anyhow::{Result, ensure};
use comic_tests::system::program;

#[test]
fn the_learner_does_not_serve_strangers_unless_told() -> Result<()> {
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
