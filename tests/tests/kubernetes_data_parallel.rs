//! The overlay `data-parallel`: two learners of one run. The tests of all overlays check the rest.

use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use comic_tests::kubernetes::{Cluster, container, directory, option, render};
use comic_tests::ranks::Ranks;
use comic_tests::steps::LIMIT;
use comic_tests::system::program;
use serde_json::json;

fn cluster() -> Result<Cluster> {
    Cluster::read(render(&directory().join("overlays/data-parallel"))?)
}

#[test]
fn each_pod_is_a_rank_with_a_name_that_the_others_and_actors_know() -> Result<()> {
    let cluster = cluster()?;
    let (pod, service) = (cluster.learner_pod()?, cluster.service.metadata.name.clone());
    ensure!(pod.subdomain == service, "the pods have no names: {:?}", pod.subdomain);
    let learner = container(pod)?;
    ensure!(option(learner, "--rank")? == "$(JOB_COMPLETION_INDEX)");
    let rendezvous = option(learner, "--rendezvous")?.rsplit_once(':').context("no port")?;
    ensure!(rendezvous.0 == cluster.host()?, "{rendezvous:?}");
    let advertised = option(learner, "--advertise")?;
    ensure!(advertised == "comic-learner-$(JOB_COMPLETION_INDEX).comic-learner:7070", "{advertised}");
    let temporary = learner.volume_mounts.iter().flatten().find(|mount| mount.mount_path == "/tmp");
    ensure!(temporary.is_some_and(|mount| mount.read_only.is_none()), "what actors fetch has no place");
    Ok(())
}

#[test]
fn a_pod_that_lost_another_one_starts_again_and_has_time_to_wait_for_it() -> Result<()> {
    let cluster = cluster()?;
    let job = cluster.learner.spec.as_ref().context("no spec")?;
    let rules = job.pod_failure_policy.iter().flat_map(|policy| &policy.rules);
    let ignored = rules.filter(|rule| rule.action == "Ignore").filter_map(|rule| rule.on_exit_codes.as_ref());
    let codes: Vec<i32> = ignored.flat_map(|codes| codes.values.clone()).collect();
    ensure!(codes == [4, 5], "{codes:?}");
    let probe = container(cluster.learner_pod()?)?.startup_probe.as_ref().context("no probe of the start")?;
    // Ten minutes of waiting for the others, and as long for the start itself.
    ensure!(probe.period_seconds.unwrap_or(10) * probe.failure_threshold.unwrap_or(3) >= 1200, "{probe:?}");
    Ok(())
}

#[test]
fn learners_reach_each_other_and_nobody_else_reaches_their_exchange() -> Result<()> {
    let cluster = cluster()?;
    let policy = cluster.policies.get("comic-ranks").and_then(|policy| policy.spec.as_ref()).context("no policy")?;
    let learners = json!({ "matchLabels": { "app.kubernetes.io/name": "comic-learner" } });
    ensure!(serde_json::to_value(&policy.pod_selector)? == learners, "{policy:?}");
    let peers = json!([{ "podSelector": learners }]);
    let (ingress, egress) = (serde_json::to_value(&policy.ingress)?, serde_json::to_value(&policy.egress)?);
    // gloo chooses its ports.
    ensure!(ingress == json!([{ "from": peers }]), "{ingress}");
    let names = json!([{ "port": 53, "protocol": "UDP" }, { "port": 53, "protocol": "TCP" }]);
    ensure!(egress == json!([{ "to": peers }, { "ports": names }]), "{egress}");
    Ok(())
}

/// Both learners with the arguments of the manifests, but for names of pods, ports and the run's directory.
#[tokio::test]
async fn the_learners_accept_the_arguments_of_the_manifests() -> Result<()> {
    let cluster = cluster()?;
    let access = tempfile::tempdir()?;
    let mut certs = Command::new(program("comic-learner")?);
    certs
        .args(["certs", "--token", "--name", "comic-learner-0.comic-learner", "localhost", "--out"])
        .arg(access.path());
    ensure!(certs.output()?.status.success(), "no certificates");
    let mut told: Vec<String> = container(cluster.learner_pod()?)?.args.clone().unwrap_or_default();
    // `Ranks` names these; the test is on one machine.
    for option in ["--run", "--metrics-port", "--world-size", "--rank", "--rendezvous", "--advertise"] {
        let at = told.iter().position(|word| word == option).with_context(|| format!("no {option}"))?;
        told.drain(at..at + 2);
    }
    let file = |name: &str| access.path().join(name).display().to_string();
    for word in &mut told {
        if let Some(name) = word.strip_prefix("/access/") {
            *word = file(name);
        }
    }
    told.extend(["--token-file".to_owned(), file("token")]);
    let mut ranks = Ranks::new(cluster.ranks()?, &told.iter().map(String::as_str).collect::<Vec<_>>())?;
    let path = |name: &str| Some(PathBuf::from(file(name)));
    let system = &mut ranks.system;
    system.host = "localhost".into();
    (system.access.ca, system.access.token_file) = (path("ca.pem"), path("token"));
    (system.access.cert, system.access.key) = (path("client.pem"), path("client-key.pem"));
    ranks.start().await?;
    let mut actor = ranks.system.start_actor()?;
    actor.until_log_holds("joined the learner", LIMIT).await?;
    Ok(())
}
