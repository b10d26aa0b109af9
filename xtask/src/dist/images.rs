//! The images of a release: deploy/Dockerfile's last stages with the directories that the archives contain.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};

use super::{PROGRAMS, VERSION, git};
use crate::workspace::{root, run};

/// Makes the images PROGRAM:VERSION from the programs' directories, and starts each once.
pub(super) fn make(trees: &[PathBuf]) -> Result<()> {
    let files = format!("comic-files:{VERSION}");
    import(trees, &files)?;
    let revision = git(&["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"])?;
    for program in PROGRAMS {
        let image = format!("{program}:{VERSION}");
        let stage = program.trim_start_matches("comic-");
        let mut build = Command::new("docker");
        build.args(["build", "--file", "deploy/Dockerfile", "--target", stage, "--tag", &image]);
        build.args(["--build-arg", &format!("FILES={files}")]);
        build.args(["--label", &format!("org.opencontainers.image.version={VERSION}")]);
        build.args(["--label", &format!("org.opencontainers.image.revision={revision}")]);
        run(build.arg(".").current_dir(root()))?;
        run(Command::new("docker").args(["run", "--rm", "--network=none", "--read-only", &image, "--version"]))
            .context(
                "the programs need a glibc as new as this machine's: make images on Debian 12, or an older system",
            )?;
    }
    Ok(())
}

/// Makes an image of the directories alone, with their programs' names.
fn import(trees: &[PathBuf], image: &str) -> Result<()> {
    let parent = trees.first().and_then(|tree| tree.parent()).unwrap_or(Path::new("."));
    let mut tar = Command::new("tar");
    tar.args(["--create", "--owner=0", "--group=0", "--mode=go+rX,go-w"]).arg("--directory").arg(parent);
    tar.arg(format!("--transform=s/-{VERSION}//")).args(trees.iter().filter_map(|tree| tree.file_name()));
    let mut tar = tar.stdout(Stdio::piped()).spawn().context("cannot start tar")?;
    let pipe = tar.stdout.take().context("a child without standard output")?;
    run(Command::new("docker").args(["import", "-", image]).stdin(pipe))?;
    let ended = tar.wait().context("cannot wait for tar")?;
    ensure!(ended.success(), "tar ended with {ended}");
    Ok(())
}
