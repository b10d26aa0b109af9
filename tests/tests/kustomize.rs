//! A user's own overlay on each of ours: images of a registry, as `kustomize edit set image` names them, and another namespace.

use std::fs;
use std::path::Path;

use anyhow::{Result, ensure};
use comic_tests::kubernetes::{applicable, render};
use comic_tests::repository::root;

#[test]
fn an_overlay_sets_other_images_and_another_namespace() -> Result<()> {
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
        for ((kind, name), manifest) in render(overlay.path())? {
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
