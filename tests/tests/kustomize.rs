//! The other tests render the manifests themselves. kustomize gives the same result.

use std::fs;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use comic_tests::kubernetes::{applicable, manifests_in, render};
use comic_tests::repository::root;

#[test]
fn kustomize_renders_the_same() -> Result<()> {
    for directory in applicable()? {
        let theirs = manifests_in(&kustomize(&directory)?)?;
        let ours = render(&directory)?;
        ensure!(ours == theirs, "{}: ours is {ours:#?}, theirs {theirs:#?}", directory.display());
    }
    Ok(())
}

/// A user's own overlay on each of ours: images of a registry, as `kustomize edit set image` names them, and another namespace.
#[test]
fn kustomize_takes_other_images_and_another_namespace() -> Result<()> {
    let target = root().join("target");
    fs::create_dir_all(&target)?;
    for ours in applicable()? {
        let overlay = tempfile::tempdir_in(&target)?;
        let base = Path::new("../..").join(ours.strip_prefix(root())?);
        let images = ["comic-learner", "comic-learner-cuda", "comic-learner-xla", "comic-actor"];
        let images =
            images.map(|name| format!("- {{name: {name}, newName: registry/{name}, newTag: \"2\"}}\n")).concat();
        let text = format!("resources: [{}]\nnamespace: second\nimages:\n{images}", base.display());
        fs::write(overlay.path().join("kustomization.yaml"), text)?;
        for ((kind, name), manifest) in manifests_in(&kustomize(overlay.path())?)? {
            let place =
                if kind == "Namespace" { &manifest["metadata"]["name"] } else { &manifest["metadata"]["namespace"] };
            ensure!(place == "second", "{kind} {name} is in {place}");
            if kind == "Job" {
                let image = manifest["spec"]["template"]["spec"]["containers"][0]["image"].as_str().unwrap_or_default();
                ensure!(image.starts_with("registry/comic-") && image.ends_with(":2"), "{}: {image}", ours.display());
            }
        }
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
