//! Compares the pods of every overlay with the rules of a careful cluster: their user, their resources, their volumes.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result, bail, ensure};
use comic_tests::kubernetes::{amount, container, each, option};
use comic_tests::repository::root;
use k8s_openapi::apimachinery::pkg::api::resource::Quantity;

#[test]
fn resources_are_requested_and_limited() -> Result<()> {
    each(|cluster| {
        for pod in cluster.pods()? {
            let resources = container(pod)?.resources.as_ref().context("no resources")?;
            let (requests, limits) = (resources.requests.as_ref(), resources.limits.as_ref());
            for name in ["cpu", "memory"] {
                let request = amount(requests.and_then(|all| all.get(name)).context("nothing is asked for")?)?;
                let limit = amount(limits.and_then(|all| all.get(name)).context("there is no limit")?)?;
                ensure!(request > 0.0 && request <= limit, "{name}: {request} of {limit}");
            }
        }
        Ok(())
    })
}

/// https://kubernetes.io/docs/concepts/security/pod-security-standards, the standard `restricted`, and more.
#[test]
fn pods_are_restricted() -> Result<()> {
    let user = user_of_the_images()?;
    each(|cluster| {
        let labels = cluster.namespace.metadata.labels.as_ref().context("no labels")?;
        ensure!(labels.get("pod-security.kubernetes.io/enforce").is_some_and(|level| level == "restricted"));
        for pod in cluster.pods()? {
            let whole = pod.security_context.as_ref().context("no security context")?;
            ensure!(
                whole.run_as_non_root == Some(true) && whole.run_as_user == Some(user),
                "the pod names no user of its own"
            );
            ensure!(whole.fs_group.is_some() && whole.fs_group == whole.run_as_group, "the pod cannot read its Secret");
            ensure!(
                whole.seccomp_profile.as_ref().is_some_and(|profile| profile.type_ == "RuntimeDefault"),
                "the pod has another seccomp profile"
            );
            ensure!(
                [pod.host_network, pod.host_pid, pod.host_ipc].iter().all(Option::is_none),
                "the pod shares a namespace of the host"
            );
            ensure!(pod.automount_service_account_token == Some(false), "the pod gets a token for the cluster");
            let container = container(pod)?;
            let own = container.security_context.as_ref().context("no security context")?;
            ensure!(
                own.allow_privilege_escalation == Some(false) && own.privileged.is_none(),
                "the container may gain privileges"
            );
            // A container's setting overrides its pod's.
            let overruled = own.run_as_user.is_some() || own.run_as_non_root.is_some() || own.run_as_group.is_some();
            ensure!(!overruled && own.seccomp_profile.is_none(), "the container overrides its pod");
            ensure!(own.read_only_root_filesystem == Some(true), "the container can write into its image");
            let capabilities = own.capabilities.as_ref().context("capabilities")?;
            ensure!(
                capabilities.drop.as_deref() == Some(&["ALL".to_owned()]) && capabilities.add.is_none(),
                "capabilities"
            );
            for volume in pod.volumes.iter().flatten() {
                ensure!(
                    volume.secret.is_some() || volume.empty_dir.is_some() || volume.persistent_volume_claim.is_some(),
                    "volume {} is neither a Secret nor an empty directory nor a claim",
                    volume.name
                );
            }
        }
        Ok(())
    })
}

/// The number of the user of every image with a program.
fn user_of_the_images() -> Result<i64> {
    let dockerfile = fs::read_to_string(root().join("deploy/Dockerfile"))?;
    let stages = dockerfile.split("\nFROM ").filter(|stage| stage.contains("\nENTRYPOINT "));
    let users = stages.map(|stage| {
        let user = stage.lines().find_map(|line| line.strip_prefix("USER ")?.split(':').next());
        Ok(user.with_context(|| format!("no user in FROM {}", stage.lines().next().unwrap_or_default()))?.parse()?)
    });
    let users = users.collect::<Result<Vec<i64>>>()?;
    let [user, others @ ..] = &users[..] else { bail!("no image") };
    ensure!(*user > 0 && others.len() == 3 && others.iter().all(|other| other == user), "{users:?}");
    Ok(*user)
}

#[test]
fn a_run_outlives_its_pod() -> Result<()> {
    each(|cluster| {
        let learner = container(cluster.learner_pod()?)?;
        let run = PathBuf::from(option(learner, "--run")?);
        let mounts = learner.volume_mounts.iter().flatten();
        let mount = mounts.into_iter().find(|mount| run.starts_with(&mount.mount_path)).context("no volume for it")?;
        let volumes = cluster.learner_pod()?.volumes.iter().flatten();
        let volume = volumes.into_iter().find(|volume| volume.name == mount.name).context("no such volume")?;
        let claimed = volume.persistent_volume_claim.as_ref().context("the volume is the pod's own")?;
        ensure!(Some(&claimed.claim_name) == cluster.claim.metadata.name.as_ref(), "{claimed:?}");
        let claim = cluster.claim.spec.as_ref().context("no spec")?;
        // Several pods may be on several nodes.
        let mode = if cluster.ranks()? == 1 { "ReadWriteOnce" } else { "ReadWriteMany" };
        ensure!(claim.access_modes.as_deref() == Some(&[mode.to_owned()]), "{claim:?}");
        let requests = claim.resources.as_ref().and_then(|resources| resources.requests.as_ref());
        ensure!(amount(&requests.context("the claim has no size")?["storage"])? > 0.0, "{requests:?}");
        ensure!(mount.read_only.is_none() && mount.sub_path.is_none(), "{mount:?}");
        Ok(())
    })
}

#[test]
fn a_learner_has_time_for_its_last_checkpoint_and_an_actor_for_its_unrolls() -> Result<()> {
    each(|cluster| {
        ensure!(cluster.learner_pod()?.termination_grace_period_seconds > Some(30));
        ensure!(cluster.actor_pod()?.termination_grace_period_seconds > Some(5));
        Ok(())
    })
}

#[test]
fn a_learner_on_an_accelerator_requests_one_and_tolerates_its_nodes() -> Result<()> {
    each(|cluster| {
        let pod = cluster.learner_pod()?;
        let learner = container(pod)?;
        let limits = learner.resources.as_ref().and_then(|resources| resources.limits.as_ref()).context("no limits")?;
        let taken: Vec<_> = limits.iter().filter(|(name, _)| name.contains('/')).collect();
        let tolerated: Vec<_> = pod.tolerations.iter().flatten().filter_map(|node| node.key.as_deref()).collect();
        match option(learner, "--device").ok() {
            None => ensure!(taken.is_empty() && tolerated.is_empty(), "{taken:?}, but the learner computes on a CPU"),
            Some(device) => {
                let resource = BTreeMap::from([("cuda", "nvidia.com/gpu"), ("xla", "google.com/tpu")])[device];
                let [(name, Quantity(count))] = taken[..] else { bail!("{taken:?}") };
                ensure!(name == resource && count == "1" && tolerated == [resource], "{taken:?} {tolerated:?}");
            }
        }
        Ok(())
    })
}
