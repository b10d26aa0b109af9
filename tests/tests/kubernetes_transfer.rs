//! The overlay `transfer`: a low level from a volume, which the user fills before the learner starts.

use std::fs;

use anyhow::{Context, Result, ensure};
use comic_tests::kubernetes::{Cluster, container, directory, manifests_in, render, strictly};
use comic_tests::repository::root;
use k8s_openapi::api::core::v1::{PersistentVolumeClaim, Pod, PodSpec};
use serde_json::Value;

/// The claim of the volume at `/low-level` in a pod, and whether the pod only reads it; `None` without such a volume.
fn mounted(pod: &PodSpec) -> Result<Option<(&str, bool)>> {
    let mut mounts = container(pod)?.volume_mounts.iter().flatten();
    let Some(mount) = mounts.find(|mount| mount.mount_path == "/low-level") else { return Ok(None) };
    let volume = pod.volumes.iter().flatten().find(|volume| volume.name == mount.name).context("no such volume")?;
    let claim = volume.persistent_volume_claim.as_ref().context("it is the pod's own")?;
    Ok(Some((claim.claim_name.as_str(), mount.read_only == Some(true))))
}

#[test]
fn the_learner_alone_mounts_the_low_level_and_reads_it() -> Result<()> {
    let cluster = Cluster::read(render(&directory().join("overlays/transfer"))?)?;
    let pod = cluster.learner_pod()?;
    ensure!(mounted(pod)? == Some(("comic-low-level", true)), "{:?}", mounted(pod)?);
    for other in [cluster.actor_pod()?, cluster.evaluator_pod()?] {
        ensure!(mounted(other)?.is_none(), "actors get the file from the learner");
    }
    let args = container(pod)?.args.as_deref().unwrap_or_default();
    let set: Vec<_> = args.windows(2).filter(|pair| pair[0] == "--set").map(|pair| pair[1].as_str()).collect();
    let expected = ["transfer.low_level=/low-level/low_level.safetensors", "budget.minutes=0", "learner.threads=4"];
    ensure!(set == expected, "{set:?}");
    // The volume of runs may hold the run of another overlay.
    ensure!(args.windows(2).any(|pair| pair == ["--run", "/runs/transfer"]), "{args:?}");
    let preset = root().join(format!("experiment/presets/{}.toml", args[1]));
    ensure!(args[0] == "--preset" && fs::read_to_string(preset)?.contains("[transfer]"), "{args:?}");
    Ok(())
}

/// The commands in deploy/README.md copy the file to where the learner reads it.
#[test]
fn a_pod_of_its_own_fills_the_volume() -> Result<()> {
    let file = "deploy/kubernetes/overlays/transfer/low-level.yaml";
    let mut manifests = manifests_in(&fs::read_to_string(root().join(file))?)?;
    let mut take = |kind: &str| -> Result<Value> {
        manifests.remove(&(kind.to_owned(), "comic-low-level".to_owned())).with_context(|| format!("no {kind}"))
    };
    strictly::<PersistentVolumeClaim>(take("PersistentVolumeClaim")?)?;
    let pod = strictly::<Pod>(take("Pod")?)?.spec.context("no spec")?;
    ensure!(manifests.is_empty(), "no test reads {:?}", manifests.keys());
    ensure!(mounted(&pod)? == Some(("comic-low-level", false)), "{:?}", mounted(&pod)?);

    // The namespace takes only restricted pods, and the learner must be able to read the file.
    let cluster = Cluster::read(render(&directory().join("overlays/transfer"))?)?;
    let learner = cluster.learner_pod()?;
    let user = |pod: &PodSpec| {
        let context = pod.security_context.clone().context("no security context")?;
        Ok::<_, anyhow::Error>((
            context.run_as_user,
            context.run_as_non_root,
            context.fs_group,
            context.seccomp_profile,
        ))
    };
    ensure!(user(&pod)? == user(learner)?, "{:?}", user(&pod)?);
    ensure!(container(&pod)?.security_context == container(learner)?.security_context);
    ensure!(container(&pod)?.image == container(learner)?.image);

    let readme = fs::read_to_string(root().join("deploy/README.md"))?;
    for part in [file, "'cat > /low-level/low_level.safetensors'", "overlays/transfer\n", "delete pod comic-low-level"]
    {
        ensure!(readme.contains(part), "deploy/README.md lacks {part}");
    }
    Ok(())
}
