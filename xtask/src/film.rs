//! `cargo xtask film`: the film of the README.

use std::path::PathBuf;
use std::process::Command;

use anyhow::Result;

use crate::{train, workspace};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// A run's directory, its `checkpoints`, or one checkpoint
    #[arg(long, value_name = "DIR")]
    checkpoint: PathBuf,
    /// The film
    #[arg(long, value_name = "FILE", default_value = "docs/walk.gif")]
    out: PathBuf,
}

/// Sets up, builds, and renders the policy beside its reference.
pub(crate) fn run(options: &Options) -> Result<()> {
    train::prepare()?;
    workspace::run(&mut render(options)?)
}

/// The command that docs/rendering.md gives for the film.
fn render(options: &Options) -> Result<Command> {
    let mut command = Command::new(workspace::program("comic-actor")?);
    command.args(["render", "--task", "tracking", "--checkpoint"]).arg(&options.checkpoint);
    command.args(["--deterministic", "--ghost=beside", "--size", "320x240", "--fps", "12", "--seconds", "2.6"]);
    command.arg("--out").arg(&options.out);
    Ok(command)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documentation_has_the_films_command() {
        let options = Options { checkpoint: "runs/NAME".into(), out: "docs/walk.gif".into() };
        let command = format!("`target/release/{}`", workspace::describe(&render(&options).unwrap()));
        let page = std::fs::read_to_string(workspace::root().join("docs/rendering.md")).unwrap();
        assert!(page.contains(&command), "docs/rendering.md lacks {command}");
    }
}
