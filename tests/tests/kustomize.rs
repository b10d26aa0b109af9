//! The other tests render the manifests themselves. kustomize gives the same result.

use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use comic_tests::kubernetes::{applicable, manifests_in, render};

#[test]
fn kustomize_renders_the_same() -> Result<()> {
    for directory in applicable()? {
        let theirs = manifests_in(&kustomize(&directory)?)?;
        let ours = render(&directory)?;
        ensure!(ours == theirs, "{}: ours is {ours:#?}, theirs {theirs:#?}", directory.display());
    }
    Ok(())
}

/// Renders a directory with kustomize, or with kubectl, which contains it.
fn kustomize(directory: &Path) -> Result<String> {
    let alone = Command::new("kustomize").arg("build").arg(directory).output();
    let output = alone.or_else(|_| Command::new("kubectl").arg("kustomize").arg(directory).output());
    let output = output.context("neither kustomize nor kubectl can be started")?;
    ensure!(output.status.success(), "{}: {}", directory.display(), String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}
