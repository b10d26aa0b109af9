//! The Kubernetes manifests of every overlay: they are read strictly, and compared with the rules of a careful cluster and
//! with the programs.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use comic_proto::Access;
use comic_tests::kubernetes::{
    Cluster, amount, applicable, container, each, environment, manifests_in, option, render, strictly,
};
use comic_tests::repository::root;
use comic_tests::system::{System, help, program};
use k8s_openapi::api::batch::v1::JobSpec;
use k8s_openapi::api::core::v1::{Container, Probe};
use k8s_openapi::api::networking::v1::{
    NetworkPolicyEgressRule, NetworkPolicyIngressRule, NetworkPolicyPeer, NetworkPolicyPort, NetworkPolicySpec,
};
use k8s_openapi::apimachinery::pkg::util::intstr::IntOrString;
use serde_json::{Value, json};

const LIMIT: Duration = Duration::from_secs(120);

#[test]
fn a_field_that_kubernetes_does_not_know_is_refused() -> Result<()> {
    let manifest = |field: &str| {
        json!({
            "apiVersion": "v1", "kind": "Service", "metadata": { "name": "a" },
            "spec": { "ports": [{ "port": 1, field: "grpc" }] },
        })
    };
    strictly::<k8s_openapi::api::core::v1::Service>(manifest("name"))?;
    let refused = strictly::<k8s_openapi::api::core::v1::Service>(manifest("nmae"));
    let refused = refused.err().context("it is taken")?.to_string();
    ensure!(refused.contains(".spec.ports[0].nmae"), "{refused}");
    Ok(())
}

#[test]
fn a_field_that_is_given_twice_is_refused() -> Result<()> {
    let service = "kind: Service\nmetadata: {name: a}\n";
    ensure!(manifests_in(service)?.len() == 1);
    for twice in [format!("{service}---\n{service}"), format!("{service}metadata: {{name: b}}\n")] {
        ensure!(manifests_in(&twice).is_err(), "accepted: {twice}");
    }
    Ok(())
}

#[test]
fn probes_use_ports_and_commands_that_exist() -> Result<()> {
    each(|cluster| {
        let learner = container(cluster.learner_pod()?)?;
        for (probe, path) in [
            (&learner.startup_probe, "/healthz"),
            (&learner.liveness_probe, "/healthz"),
            (&learner.readiness_probe, "/readyz"),
        ] {
            let asked = probe.as_ref().and_then(|probe| probe.http_get.as_ref()).context("no probe over HTTP")?;
            ensure!(asked.path.as_deref() == Some(path) && asked.scheme.is_none(), "{asked:?}");
            ensure!(asked.port == IntOrString::String("metrics".into()), "{asked:?}");
        }
        let startup = learner.startup_probe.as_ref().context("no probe of the start")?;
        // libtpu asks for a machine's metadata for up to eight minutes before the learner serves.
        ensure!(startup.period_seconds.unwrap_or(10) * startup.failure_threshold.unwrap_or(3) > 480, "{startup:?}");
        let actor = container(cluster.actor_pod()?)?;
        let asked = actor.readiness_probe.as_ref().and_then(|probe: &Probe| probe.exec.as_ref()?.command.as_deref());
        ensure!(asked == Some(&["comic-actor".to_owned(), "health".to_owned()]), "{asked:?}");
        ensure!(actor.liveness_probe.is_none(), "an actor that waits for its learner would be restarted");
        let (startup, patience) = (actor.startup_probe.as_ref().context("no probe of the start")?, environment(actor));
        let waits = startup.period_seconds.unwrap_or(10) * startup.failure_threshold.unwrap_or(3);
        ensure!(
            waits > patience["COMIC_GIVE_UP_AFTER"].parse::<i32>()?,
            "an actor is killed while it waits for its learner"
        );
        can_write_to(actor, "COMIC_LIVENESS")
    })
}

/// Checks that a container can write to the path in this variable of its image.
fn can_write_to(container: &Container, variable: &str) -> Result<()> {
    let dockerfile = dockerfile()?;
    let path = dockerfile.split_whitespace().find_map(|word| word.strip_prefix(variable)?.strip_prefix('='));
    let path = Path::new(path.with_context(|| format!("the image does not set {variable}"))?);
    let mut mounts = container.volume_mounts.iter().flatten().filter(|mount| mount.read_only != Some(true));
    ensure!(mounts.any(|mount| path.starts_with(&mount.mount_path)), "{} cannot be written", path.display());
    Ok(())
}

#[test]
fn names_and_ports_agree_with_each_other_and_with_the_programs() -> Result<()> {
    let grpc = default_of("--port <PORT>", &help("comic-learner", &[])?)?;
    each(|cluster| {
        let learner = container(cluster.learner_pod()?)?;
        let metrics: i32 = option(learner, "--metrics-port")?.parse()?;
        let ports =
            learner.ports.iter().flatten().map(|port| (port.name.as_deref().unwrap_or_default(), port.container_port));
        ensure!(
            ports.collect::<BTreeMap<_, _>>() == BTreeMap::from([("grpc", grpc), ("metrics", metrics)]),
            "{:?}",
            learner.ports
        );
        ensure!(dockerfile()?.contains(&format!("\nEXPOSE {grpc} {metrics}\n")), "the image exposes other ports");

        let service = cluster.service.spec.as_ref().context("no spec")?;
        let ports = service.ports.iter().flatten();
        let ports = ports.map(|port| (port.name.as_deref().unwrap_or_default(), (port.port, port.target_port.clone())));
        let named = |name: &str| Some(IntOrString::String(name.to_owned()));
        let expected = [("grpc", (grpc, named("grpc"))), ("metrics", (metrics, named("metrics")))];
        ensure!(ports.collect::<BTreeMap<_, _>>() == BTreeMap::from(expected), "{:?}", service.ports);
        ensure!(service.cluster_ip.as_deref() == Some("None"), "one learner needs no virtual address");
        ensure!(service.publish_not_ready_addresses == Some(true), "an actor must reach a learner that drains");
        let job = cluster.learner.spec.as_ref().context("no spec")?;
        let labels = job.template.metadata.as_ref().and_then(|metadata| metadata.labels.as_ref());
        ensure!(labels == service.selector.as_ref(), "the learner is not behind its Service: {labels:?}");

        let url = format!("https://{}:{grpc}", cluster.host()?);
        let variables = environment(container(cluster.actor_pod()?)?);
        ensure!(variables["COMIC_LEARNER"] == url, "{variables:?}");
        let evaluator = container(cluster.evaluator_pod()?)?;
        ensure!(option(evaluator, "--learner")? == url, "{:?}", evaluator.args);
        ensure!(environment(learner)["COMIC_LEARNER"] == format!("https://localhost:{grpc}"));
        Ok(())
    })
}

/// The default of an option, from the `--help` text.
fn default_of(option: &str, help: &str) -> Result<i32> {
    let behind = help.split(option).nth(1).with_context(|| format!("no {option}"))?;
    let default = behind.split("[default: ").nth(1).and_then(|text| text.split(']').next());
    Ok(default.context("no default")?.parse()?)
}

#[test]
fn images_are_pinned_to_this_version_everywhere() -> Result<()> {
    let programs = ["comic-learner", "comic-learner-cuda", "comic-learner-xla", "comic-actor", "comic-tensorboard"];
    let expected = programs.map(|name| format!("{name}:{}", env!("CARGO_PKG_VERSION")));
    each(|cluster| {
        let learner = container(cluster.learner_pod()?)?;
        let device = option(learner, "--device").ok();
        let image = programs.iter().position(|name| *name == suffixed("comic-learner", device));
        ensure!(
            image.is_some_and(|at| learner.image.as_ref() == Some(&expected[at])),
            "{device:?}: {:?}",
            learner.image
        );
        for pod in [cluster.actor_pod()?, cluster.evaluator_pod()?] {
            let image = &container(pod)?.image;
            ensure!(image.as_ref() == Some(&expected[3]), "{image:?}");
        }
        Ok(())
    })?;
    for file in ["compose.yaml", "compose.tls.yaml", "compose.data-parallel.yaml", "Dockerfile", "README.md"] {
        let text = fs::read_to_string(root().join("deploy").join(file))?;
        let named = text.split([' ', '\n', '=', '`', '/']).filter(|word| word.contains(':'));
        let ours: Vec<_> =
            named.filter(|word| programs.iter().any(|name| word.starts_with(&format!("{name}:")))).collect();
        ensure!(!ours.is_empty(), "{file} names no image");
        ensure!(ours.iter().all(|image| expected.iter().any(|expected| expected == image)), "{file}: {ours:?}");
    }
    Ok(())
}

fn suffixed(name: &str, device: Option<&str>) -> String {
    device.map_or_else(|| name.to_owned(), |device| format!("{name}-{device}"))
}

#[test]
fn the_learner_is_a_job_that_starts_again_until_the_run_is_over() -> Result<()> {
    each(|cluster| {
        let job = cluster.learner.spec.as_ref().context("no spec")?;
        cluster.ranks()?;
        let after = |code| action_after(job, code);
        ensure!([after(1)?, after(2)?, after(4)?] == [None, Some("FailJob"), Some("Ignore")]);
        ensure!(job.pod_replacement_policy.as_deref() == Some("Failed"), "two learners may have the run at a time");
        for job in [&cluster.learner, &cluster.actors, &cluster.evaluator] {
            let kept = job.spec.as_ref().and_then(|spec| spec.ttl_seconds_after_finished);
            ensure!(kept > Some(0), "a finished Job stays for ever");
        }
        Ok(())
    })
}

#[test]
fn actors_are_an_indexed_job_that_follows_their_exit_codes() -> Result<()> {
    each(|cluster| {
        let job = cluster.actors.spec.as_ref().context("no spec")?;
        ensure!(job.completion_mode.as_deref() == Some("Indexed"), "only an indexed Job grows");
        let parallelism = job.parallelism.context("no parallelism")?;
        ensure!(job.completions == Some(parallelism), "{parallelism} at once of {:?}", job.completions);
        let pod = cluster.actor_pod()?;
        let name = option(container(pod)?, "--name")?;
        ensure!(name.contains("$(JOB_COMPLETION_INDEX)"), "{name}: each pod would replace the others");
        let actions = [action_after(job, 1)?, action_after(job, 2)?, action_after(job, 3)?];
        ensure!(actions == [Some("Ignore"), Some("FailJob"), Some("FailIndex")], "{actions:?}");
        ensure!(job.backoff_limit.is_none() && job.backoff_limit_per_index.is_some(), "one index delays the others");

        let budget = cluster.budget.spec.as_ref().context("no spec")?;
        ensure!(
            matches!(budget.min_available, Some(IntOrString::Int(kept)) if 0 < kept && kept < parallelism),
            "{budget:?}"
        );
        ensure!(
            budget.unhealthy_pod_eviction_policy.as_deref() == Some("AlwaysAllow"),
            "an absent learner would block the draining of nodes"
        );
        let labels = job.template.metadata.as_ref().and_then(|metadata| metadata.labels.as_ref());
        ensure!(budget.selector.as_ref().and_then(|selector| selector.match_labels.as_ref()) == labels);
        let spread = pod.topology_spread_constraints.iter().flatten().next().context("they are not spread")?;
        ensure!(spread.label_selector.as_ref().and_then(|selector| selector.match_labels.as_ref()) == labels);
        // Pods spread as evenly as possible. A small cluster still runs all of them.
        let (over, skew, otherwise) = (&*spread.topology_key, spread.max_skew, &*spread.when_unsatisfiable);
        ensure!((over, skew, otherwise) == ("kubernetes.io/hostname", 1, "ScheduleAnyway"), "{spread:?}");
        let allowed: i32 = option(container(cluster.learner_pod()?)?, "--max-actors")?.parse()?;
        ensure!(parallelism <= allowed, "{parallelism} actors, but the learner accepts {allowed}");
        Ok(())
    })
}

/// What a Job does after a pod that ended with this code. It replaces pods of drained nodes.
fn action_after(job: &JobSpec, code: i32) -> Result<Option<&str>> {
    let pod = job.template.spec.as_ref().context("no pod")?;
    ensure!(pod.restart_policy.as_deref() == Some("Never"), "a pod failure policy needs this restart policy");
    let name = container(pod)?.name.as_str();
    let rules = &job.pod_failure_policy.as_ref().context("no policy for failures")?.rules;
    let first = rules.first().and_then(|rule| Some((rule.action.as_str(), rule.on_pod_conditions.as_deref()?)));
    ensure!(first.is_some_and(|(action, conditions)| action == "Ignore" && conditions[0].type_ == "DisruptionTarget"));
    let mut found = rules.iter().filter(|rule| {
        let codes = rule.on_exit_codes.as_ref();
        codes.is_some_and(|codes| {
            codes.container_name.as_deref() == Some(name) && codes.operator == "In" && codes.values.contains(&code)
        })
    });
    Ok(found.next().map(|rule| rule.action.as_str()))
}

#[test]
fn the_evaluator_is_a_small_job_with_the_access_of_actors() -> Result<()> {
    each(|cluster| {
        let job = cluster.evaluator.spec.as_ref().context("no spec")?;
        ensure!(job.parallelism.is_none() && job.completions.is_none(), "more than one evaluator");
        let actions = [action_after(job, 1)?, action_after(job, 2)?, action_after(job, 3)?];
        ensure!(actions == [None, Some("FailJob"), Some("FailJob")], "{actions:?}");
        let evaluator = container(cluster.evaluator_pod()?)?;
        let args = evaluator.args.as_deref().unwrap_or_default();
        ensure!(args.starts_with(&["evaluate".to_owned(), "--watch".to_owned()]), "{args:?}");
        let mut access = environment(container(cluster.actor_pod()?)?);
        access.remove("COMIC_LEARNER");
        ensure!(access.contains_key("COMIC_GIVE_UP_AFTER"), "an actor waits for ever: {access:?}");
        ensure!(environment(evaluator) == access, "{:?}", evaluator.env);
        let limits = evaluator.resources.as_ref().and_then(|resources| resources.limits.as_ref());
        ensure!(amount(&limits.context("no limits")?["cpu"])? < 1.0, "{limits:?}");
        ensure!(
            evaluator.readiness_probe.is_none() && evaluator.liveness_probe.is_none(),
            "an evaluator writes no liveness file"
        );
        // Films are made there.
        can_write_to(evaluator, "TMPDIR")
    })
}

#[test]
fn only_actors_and_the_evaluator_reach_the_learners_port() -> Result<()> {
    each(|cluster| {
        let everybody = cluster.policies["comic"].spec.as_ref().context("no spec")?;
        let chosen = everybody.pod_selector.as_ref().context("no pods")?;
        ensure!(
            chosen.match_labels.is_none() && chosen.match_expressions.is_none(),
            "the policy does not choose every pod"
        );
        ensure!(
            everybody.policy_types.as_deref() == Some(&["Ingress".to_owned(), "Egress".to_owned()]),
            "the policy covers only one direction"
        );
        ensure!(everybody.ingress.is_none() && everybody.egress.is_none(), "the policy lets traffic through");
        let learner = cluster.learner.spec.as_ref().and_then(|spec| spec.template.metadata.as_ref());
        let learner = learner.and_then(|metadata| metadata.labels.as_ref());
        let learner = json!({ "matchLabels": learner });
        let label = "app.kubernetes.io/name";
        let names = [&cluster.actors, &cluster.evaluator].map(|job| {
            let metadata = job.spec.as_ref().and_then(|spec| spec.template.metadata.as_ref());
            metadata.and_then(|metadata| metadata.labels.as_ref()?.get(label))
        });
        ensure!(names[0] != names[1], "what selects actors also selects the evaluator: {names:?}");
        let clients = json!({ "matchExpressions": [{ "key": label, "operator": "In", "values": names }] });
        let monitoring = json!({ "matchLabels": { "kubernetes.io/metadata.name": "monitoring" } });
        let ports = container(cluster.learner_pod()?)?.ports.iter().flatten();
        let ports: BTreeMap<_, _> = ports
            .map(|port| (port.name.as_deref().unwrap_or_default(), format!("TCP {}", port.container_port)))
            .collect();
        let port = |name: &str| vec![ports[name].clone()];
        // Every other policy allows some traffic. These are all of them.
        let ways = allowed(cluster, "comic-learner", &learner, |policy| {
            policy.ingress.iter().flatten().map(ingress).collect()
        })?;
        let from_clients = (clients.clone(), json!(null), port("grpc"));
        let from_monitoring = (json!(null), monitoring, port("metrics"));
        ensure!(ways == [from_clients, from_monitoring], "{ways:?}");
        let ways =
            allowed(cluster, "comic-clients", &clients, |policy| policy.egress.iter().flatten().map(egress).collect())?;
        let to_learner = (learner, json!(null), port("grpc"));
        let names = (json!(null), json!(null), vec!["UDP 53".to_owned(), "TCP 53".to_owned()]);
        ensure!(ways == [to_learner, names], "{ways:?}");
        // That of several learners has a test of its own.
        let others = usize::from(cluster.ranks()? > 1);
        ensure!(cluster.policies.len() == 3 + others, "{:?}", cluster.policies.keys());
        Ok(())
    })
}

/// The selectors of pods and of namespaces, and the ports.
type Way = (Value, Value, Vec<String>);

/// The traffic that this policy allows. It must choose its pods by this selector.
fn allowed(
    cluster: &Cluster,
    name: &str,
    pods: &Value,
    ways: impl Fn(&NetworkPolicySpec) -> Result<Vec<Way>>,
) -> Result<Vec<Way>> {
    let policy = cluster.policies.get(name).and_then(|policy| policy.spec.as_ref()).context("no such policy")?;
    let chosen = serde_json::to_value(&policy.pod_selector)?;
    ensure!(chosen == *pods, "{chosen}");
    ways(policy)
}

fn ingress(rule: &NetworkPolicyIngressRule) -> Result<Way> {
    way(rule.from.as_deref(), rule.ports.as_deref())
}

fn egress(rule: &NetworkPolicyEgressRule) -> Result<Way> {
    way(rule.to.as_deref(), rule.ports.as_deref())
}

fn way(peers: Option<&[NetworkPolicyPeer]>, ports: Option<&[NetworkPolicyPort]>) -> Result<Way> {
    let ports = ports.context("all ports")?.iter().map(|port| match port.port {
        Some(IntOrString::Int(number)) if port.end_port.is_none() => {
            Ok(format!("{} {number}", port.protocol.as_deref().unwrap_or("TCP")))
        }
        _ => bail!("not one number: {port:?}"),
    });
    let ports = ports.collect::<Result<_>>()?;
    match peers {
        None => Ok((Value::Null, Value::Null, ports)),
        Some([peer]) => {
            ensure!(peer.ip_block.is_none(), "{peer:?}");
            Ok((serde_json::to_value(&peer.pod_selector)?, serde_json::to_value(&peer.namespace_selector)?, ports))
        }
        Some(several) => bail!("not one peer: {several:?}"),
    }
}

/// Users make the Secrets. The commands in deploy/README.md put every file there that the programs read.
#[test]
fn secrets_hold_what_the_programs_read() -> Result<()> {
    let readme = fs::read_to_string(root().join("deploy/README.md"))?.replace("\\\n", "");
    each(|cluster| {
        for pod in cluster.pods()? {
            let container = container(pod)?;
            let volume = pod.volumes.iter().flatten().find(|volume| volume.name == "access").context("no volume")?;
            let secret =
                volume.secret.as_ref().and_then(|secret| secret.secret_name.as_deref()).context("no Secret")?;
            let command = readme.lines().find(|line| line.contains(&format!("create secret generic {secret} ")));
            let made: BTreeSet<_> = command
                .with_context(|| format!("no command makes the Secret {secret}"))?
                .split_whitespace()
                .filter_map(|word| word.strip_prefix("--from-file=access/"))
                .collect();
            let read: BTreeSet<_> = container
                .args
                .iter()
                .flatten()
                .map(String::as_str)
                .chain(environment(container).into_values())
                .collect();
            let read: BTreeSet<_> = read.into_iter().filter_map(|word| word.strip_prefix("/access/")).collect();
            ensure!(read == made, "the programs read {read:?}, the commands make {made:?}");
        }
        Ok(())
    })
}

/// Runs the real programs with the arguments of the manifests: the learner serves, an actor joins it, and the evaluator
/// waits for a checkpoint.
#[tokio::test]
async fn the_programs_accept_the_arguments_of_the_manifests() -> Result<()> {
    let access = tempfile::tempdir()?;
    let mut certs = std::process::Command::new(program("comic-learner")?);
    certs.args(["certs", "--token", "--name", "comic-learner", "localhost", "--out"]).arg(access.path());
    ensure!(certs.output()?.status.success(), "no certificates");
    // The low level that the overlay `transfer` has on a volume is here the built-in one's file.
    let data = root().join("networks/data");
    let place = |word: &str| {
        let access = word.strip_prefix("/access/").map(|file| access.path().join(file).display().to_string());
        access.unwrap_or_else(|| word.replace("=/low-level/", &format!("={}/", data.display())))
    };
    for directory in applicable()? {
        let cluster = Cluster::read(render(&directory)?)?;
        if cluster.ranks()? > 1 {
            continue; // `kubernetes_data_parallel.rs` starts them.
        }
        let (learner, actor) = (container(cluster.learner_pod()?)?, container(cluster.actor_pod()?)?);
        let mut told: Vec<String> = learner.args.iter().flatten().map(|word| place(word)).collect();
        // The test chooses the run's directory and free ports.
        let run = told.iter().position(|word| word == "--run").context("no --run")?;
        told.drain(run..run + 2);
        let port = told.iter().position(|word| word == "--metrics-port").context("no --metrics-port")?;
        "0".clone_into(&mut told[port + 1]);
        let token = environment(learner).get("COMIC_TOKEN_FILE").map(|file| place(file)).context("no token")?;
        told.extend(["--token-file".to_owned(), token]);
        // This learner was built for a CPU. It parses the device, names it in its error, and runs without the option.
        if let Some(device) = told.iter().position(|word| word == "--device") {
            let words: Vec<String> = told.drain(device..device + 2).collect();
            let run = tempfile::tempdir()?;
            let mut refused = std::process::Command::new(program("comic-learner")?);
            let output = refused.args(&words).arg("--run").arg(run.path()).output()?;
            let said = String::from_utf8_lossy(&output.stderr);
            ensure!(output.status.code() == Some(2) && said.contains(&words[1]), "{words:?}: {said}");
        }
        let mut system = System::new(&told.iter().map(String::as_str).collect::<Vec<_>>())?;
        system.host = "localhost".into();
        let variables = environment(actor);
        let file = |name: &str| Some(PathBuf::from(place(variables.get(name)?)));
        system.access = Access {
            ca: file("COMIC_CA"),
            cert: file("COMIC_CERT"),
            key: file("COMIC_KEY"),
            token_file: file("COMIC_TOKEN_FILE"),
        };
        system.start_learner(LIMIT).await.with_context(|| directory.display().to_string())?;
        let evaluator = container(cluster.evaluator_pod()?)?;
        let mut told: Vec<&str> = evaluator.args.iter().flatten().map(String::as_str).collect();
        // The test names its own learner.
        let at = told.iter().position(|word| *word == "--learner").context("no --learner")?;
        told.drain(at..at + 2);
        let mut evaluator = system.start("comic-actor", &told)?;
        let access = system.access.clone();
        let mut actor = system.start_actor_with(&access, |command| {
            command.args(actor.args.iter().flatten());
        })?;
        actor.until_log_holds("joined the learner", LIMIT).await?;
        evaluator.until_log_holds("following the learner's checkpoints", LIMIT).await?;
    }
    Ok(())
}

fn dockerfile() -> Result<String> {
    Ok(fs::read_to_string(root().join("deploy/Dockerfile"))?)
}
