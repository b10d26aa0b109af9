//! The compose files and the Dockerfile agree with each other and with the programs. These tests need no Docker engine.

use std::collections::BTreeSet;
use std::fs;

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;
use serde_yaml_ng::Value;

/// Reads a file of `deploy` and resolves its anchors and merges.
fn compose(file: &str) -> Result<Value> {
    let mut document: Value = serde_yaml_ng::from_str(&text(file)?)?;
    document.apply_merge()?;
    Ok(document)
}

fn text(file: &str) -> Result<String> {
    let path = root().join("deploy").join(file);
    fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))
}

/// The words of a service's command.
fn command(file: &str, service: &str) -> Result<Vec<String>> {
    let document = compose(file)?;
    let command = document["services"][service]["command"].as_str().context("no command")?.to_owned();
    Ok(command.split_whitespace().map(str::to_owned).collect())
}

#[test]
fn every_container_is_limited_and_writes_where_it_is_told() -> Result<()> {
    let plain = compose("compose.yaml")?;
    let overlays = [compose("compose.tls.yaml")?, compose("compose.data-parallel.yaml")?];
    let services =
        |document: &Value| Ok::<_, anyhow::Error>(document["services"].as_mapping().context("no services")?.clone());
    let plain = services(&plain)?;
    // The other files are laid over the first: only services that the first does not have are complete in them.
    let own = overlays.iter().map(services).collect::<Result<Vec<_>>>()?;
    let own = own.into_iter().flatten().filter(|(name, _)| !plain.contains_key(name));
    for (name, service) in plain.iter().map(|(name, service)| (name.clone(), service.clone())).chain(own) {
        ensure!(service["read_only"] == true && service["cap_drop"][0] == "ALL", "{name:?}: {service:?}");
        ensure!(service["security_opt"][0] == "no-new-privileges:true", "{name:?}: {service:?}");
        ensure!(!service["cpus"].is_null() && !service["mem_limit"].is_null(), "{name:?}: {service:?}");
        if name == "certs" {
            ensure!(service["restart"].is_null() && service["network_mode"] == "none", "{service:?}");
            continue;
        }
        let restart = service["restart"].as_str().unwrap_or_default();
        ensure!(
            restart.starts_with("on-failure:"),
            "{restart}: after 0 there is nothing to do, after 2 nothing to gain"
        );
    }
    Ok(())
}

#[test]
fn each_container_has_more_time_to_stop_than_its_program_takes() -> Result<()> {
    let document = compose("compose.yaml")?;
    for (service, seconds) in [("learner", 30), ("actor", 5)] {
        let period = document["services"][service]["stop_grace_period"].as_str().unwrap_or_default().strip_suffix('s');
        ensure!(period.context("no period")?.parse::<u32>()? > seconds, "{service}: {period:?}");
    }
    Ok(())
}

/// A file that is laid over another replaces its command, so both files list the other options.
#[test]
fn with_tls_the_learner_has_the_same_options_except_for_access() -> Result<()> {
    let plain = command("compose.yaml", "learner")?;
    let tls = command("compose.tls.yaml", "learner")?;
    let at = tls.iter().position(|word| word == "--cert").context("no --cert")?;
    ensure!(plain.split_last() == Some((&"--insecure".to_owned(), &tls[..at])), "{plain:?} and {tls:?}");
    let options: Vec<_> = tls[at..].iter().map(String::as_str).collect();
    let certificates =
        ["--cert", "/access/server.pem", "--key", "/access/server-key.pem", "--client-ca", "/access/ca.pem"];
    ensure!(options == certificates, "{options:?}");
    Ok(())
}

#[test]
fn two_learners_have_the_options_of_one_and_are_two_ranks_of_one_run() -> Result<()> {
    for (file, one, advertises) in [
        ("compose.data-parallel.yaml", "compose.yaml", false),
        ("compose.data-parallel.tls.yaml", "compose.tls.yaml", true),
    ] {
        let plain = command(one, "learner")?;
        let run = plain.iter().position(|word| word == "--run").context("no --run")?;
        // Rank 0 has the run's directory.
        let ranks = [("learner", plain.clone()), ("learner-1", [&plain[..run], &plain[run + 2..]].concat())];
        for (rank, (service, options)) in ranks.into_iter().enumerate() {
            let words = command(file, service)?;
            let mut world = format!("--world-size 2 --rank {rank} --rendezvous learner:7071");
            if advertises {
                // A certificate has names, and not the address that a container happens to have.
                world += &format!(" --advertise {service}:7070");
            }
            let expected = options.iter().map(String::as_str).chain(world.split(' '));
            ensure!(words.iter().map(String::as_str).eq(expected), "{file}: {words:?}");
        }
    }
    Ok(())
}

#[test]
fn with_tls_the_second_learner_has_what_the_first_has_and_both_names_are_certified() -> Result<()> {
    let (one, two) = (compose("compose.tls.yaml")?, compose("compose.data-parallel.tls.yaml")?);
    let (first, second) = (&one["services"]["learner"], &two["services"]["learner-1"]);
    for field in ["environment", "volumes"] {
        ensure!(first[field] == second[field], "{field}: {second:?}");
    }
    ensure!(second["depends_on"]["certs"] == first["depends_on"]["certs"], "{second:?}");
    let names = |document: &Value| -> Vec<String> {
        words(&document["services"]["certs"]["command"])
            .skip_while(|word| *word != "--name")
            .map(str::to_owned)
            .collect()
    };
    ensure!(names(&one) == ["--name", "learner", "localhost"], "{one:?}");
    ensure!(names(&two) == ["--name", "learner", "learner-1", "localhost"], "{two:?}");
    Ok(())
}

/// It uses their image, their cache and their credentials. It writes no liveness file.
#[test]
fn the_evaluator_has_what_actors_have_and_no_health_check() -> Result<()> {
    let (plain, tls) = (compose("compose.yaml")?, compose("compose.tls.yaml")?);
    let (actor, evaluator) = (&plain["services"]["actor"], &plain["services"]["evaluator"]);
    for field in ["image", "build", "tmpfs", "depends_on", "stop_grace_period"] {
        ensure!(!actor[field].is_null() && actor[field] == evaluator[field], "{field}: {evaluator:?}");
    }
    ensure!(evaluator["healthcheck"]["disable"] == true && evaluator["scale"].is_null(), "{evaluator:?}");
    let (actor, evaluator) = (&tls["services"]["actor"], &tls["services"]["evaluator"]);
    ensure!(actor["volumes"] == evaluator["volumes"], "{evaluator:?}");
    let mut access = actor["environment"].as_mapping().context("no environment")?.clone();
    access.remove("COMIC_LEARNER");
    ensure!(evaluator["environment"].as_mapping() == Some(&access), "{evaluator:?}");

    let told = command("compose.yaml", "evaluator")?;
    ensure!(told.starts_with(&["evaluate".to_owned(), "--watch".to_owned()]), "{told:?}");
    let secured = told.iter().map(|word| word.replace("http://", "https://")).collect::<Vec<_>>();
    ensure!(secured != told && secured == command("compose.tls.yaml", "evaluator")?, "{told:?} and {secured:?}");
    Ok(())
}

fn arguments_of(dockerfile: &str) -> BTreeSet<String> {
    let name = |line: &str| Some(line.strip_prefix("ARG ")?.split('=').next()?.to_owned());
    dockerfile.lines().filter_map(name).collect()
}

#[test]
fn every_argument_of_the_dockerfile_can_be_given_to_compose() -> Result<()> {
    let dockerfile = text("Dockerfile")?;
    let mut asked = arguments_of(&dockerfile);
    // Compose builds the programs itself, and not for accelerators.
    for argument in ["ACCELERATOR", "FILES"] {
        ensure!(asked.remove(argument), "the Dockerfile has no argument {argument}");
    }
    let given_to = |service: &str| -> Result<(Value, BTreeSet<String>)> {
        let build = compose("compose.yaml")?["services"][service]["build"].clone();
        let given = build["args"].as_mapping().context("no arguments")?;
        let given = given.keys().filter_map(Value::as_str).map(str::to_owned).collect();
        Ok((build, given))
    };
    let (build, given) = given_to("tensorboard")?;
    let file = build["dockerfile"].as_str().context("no file")?;
    let own = arguments_of(&text(file.trim_start_matches("deploy/"))?);
    ensure!(given == own, "tensorboard: {given:?} for {own:?}");
    for (service, target) in [("learner", "learner"), ("actor", "actor"), ("evaluator", "actor")] {
        let (build, given) = given_to(service)?;
        ensure!(given == asked, "{service}: {given:?} for {asked:?}");
        ensure!(dockerfile.contains(&format!(" AS {target}\n")) && build["target"] == target, "{service}: {build:?}");
    }
    Ok(())
}

#[test]
fn images_are_built_with_the_workspaces_own_rust() -> Result<()> {
    let manifest = fs::read_to_string(root().join("Cargo.toml"))?;
    let version = manifest.lines().find_map(|line| line.strip_prefix("rust-version = \"")?.strip_suffix('"'));
    let image = format!("rust:{}-bookworm", version.context("no rust-version")?);
    for file in ["Dockerfile", "compose.yaml", "../xtask/src/images.rs"] {
        ensure!(text(file)?.contains(&image), "{file} names no {image}");
    }
    Ok(())
}

/// The learner's run, and nothing else, is worth keeping.
#[test]
fn what_is_in_volumes_is_where_the_image_lets_it_be_written() -> Result<()> {
    let prepared = text("Dockerfile")?;
    let prepared =
        prepared.lines().find(|line| line.contains("install --directory --owner comic")).context("no directories")?;
    let prepared: BTreeSet<_> = prepared.split_whitespace().filter(|word| word.starts_with('/')).collect();
    let used = [
        ("compose.yaml", &["learner", "actor", "evaluator"][..]),
        ("compose.tls.yaml", &["certs", "learner", "evaluator"]),
        ("compose.data-parallel.tls.yaml", &["learner-1"]),
    ];
    for (file, services) in used {
        for service in services {
            let service = &compose(file)?["services"][service];
            let volumes = [&service["volumes"], &service["tmpfs"]].into_iter().filter_map(Value::as_sequence).flatten();
            for volume in volumes {
                let volume = volume.as_str().context("a volume in words")?;
                let place = volume.split(':').rfind(|part| part.starts_with('/')).unwrap_or(volume);
                ensure!(prepared.contains(place), "{place} is not comic's");
            }
        }
    }
    Ok(())
}

/// A service of the profile `monitoring`. Its image is another project's.
fn monitoring(service: &str) -> Result<Value> {
    let service = compose("compose.yaml")?["services"][service].clone();
    ensure!(service["profiles"] == Value::from(vec!["monitoring"]), "{service:?}");
    Ok(service)
}

/// The strings of a list.
fn words(list: &Value) -> impl Iterator<Item = &str> {
    list.as_sequence().into_iter().flatten().filter_map(Value::as_str)
}

#[test]
fn monitoring_is_pinned_not_root_and_reachable_from_this_machine_only() -> Result<()> {
    for name in ["prometheus", "grafana"] {
        let service = monitoring(name)?;
        let image = service["image"].as_str().and_then(|image| image.split_once(":-")).context("no default image")?.1;
        let (_, tag) = image.trim_end_matches('}').split_once(':').context("no tag")?;
        let version: Vec<_> = tag.trim_start_matches('v').split('.').map(str::parse::<u32>).collect();
        ensure!(version.len() == 3 && version.iter().all(Result::is_ok), "{image} is not one release");
        let user = service["user"].as_str().context("no user")?;
        ensure!(user.split(':').all(|number| number.parse::<u32>().is_ok_and(|number| number > 0)), "{user}");
        ensure!(!service["healthcheck"]["test"].is_null(), "{service:?}");
        let ports: Vec<_> = words(&service["ports"]).collect();
        ensure!(matches!(ports[..], [port] if port.starts_with("127.0.0.1:")), "{ports:?}");
    }
    Ok(())
}

#[test]
fn monitoring_mounts_files_of_the_repository_and_cannot_change_them() -> Result<()> {
    for name in ["prometheus", "grafana"] {
        let service = monitoring(name)?;
        let mut ours = words(&service["volumes"]).filter(|volume| volume.starts_with('.')).peekable();
        ensure!(ours.peek().is_some(), "{name} is not configured");
        for volume in ours {
            let file = volume.split(':').next().unwrap_or_default();
            ensure!(volume.ends_with(":ro") && root().join("deploy").join(file).exists(), "{volume}");
        }
    }
    Ok(())
}

#[test]
fn prometheus_keeps_a_bounded_volume() -> Result<()> {
    for file in ["compose.yaml", "compose.data-parallel.yaml"] {
        let command = command(file, "prometheus")?;
        for bound in ["--storage.tsdb.retention.time=30d", "--storage.tsdb.retention.size=1GB"] {
            ensure!(command.iter().any(|option| option == bound), "{file}: {command:?} lacks {bound}");
        }
    }
    Ok(())
}

#[test]
fn prometheus_asks_each_of_two_learners_as_it_asks_one() -> Result<()> {
    let config = |name: &str| -> Result<Value> { Ok(serde_yaml_ng::from_str(&text(&format!("prometheus/{name}"))?)?) };
    let (mut two, mut one) = (config("data-parallel.yml")?, config("prometheus.yml")?);
    let targets = |config: &mut Value| std::mem::take(&mut config["scrape_configs"][0]["static_configs"][0]["targets"]);
    let (of_two, _) = (targets(&mut two), targets(&mut one));
    ensure!(two == one, "{two:?} and {one:?}");
    let services = ["learner", "learner-1"];
    for service in services {
        let options = command("compose.data-parallel.yaml", service)?;
        ensure!(options.windows(2).any(|pair| pair == ["--metrics-port", "9090"]), "{options:?}");
    }
    ensure!(words(&of_two).eq(services.map(|service| format!("{service}:9090"))), "{of_two:?}");
    let command = command("compose.data-parallel.yaml", "prometheus")?;
    ensure!(command[0] == "--config.file=/etc/prometheus/data-parallel.yml", "{command:?}");
    Ok(())
}

/// Prometheus finds the learner, Grafana finds Prometheus, and the dashboard.
#[test]
fn monitoring_finds_the_learner_by_the_names_and_ports_of_the_compose_files() -> Result<()> {
    let prometheus: Value = serde_yaml_ng::from_str(&text("prometheus/prometheus.yml")?)?;
    let scraped = &prometheus["scrape_configs"][0];
    for file in ["compose.yaml", "compose.tls.yaml"] {
        let options = command(file, "learner")?;
        let port = options.iter().skip_while(|option| *option != "--metrics-port").nth(1).context("no port")?;
        let targets: Vec<_> = words(&scraped["static_configs"][0]["targets"]).collect();
        ensure!(targets == [format!("learner:{port}")], "{file}: {targets:?}");
    }
    let job = scraped["job_name"].as_str().context("no job")?;
    ensure!(text("prometheus/rules/comic.yml")?.contains(&format!("up{{job=\"{job}\"}}")), "no rule knows {job}");

    let sources: Value = serde_yaml_ng::from_str(&text("grafana/provisioning/datasources/prometheus.yml")?)?;
    let source = &sources["datasources"][0];
    ensure!(source["url"] == "http://prometheus:9090" && source["type"] == "prometheus", "{source:?}");
    ensure!(source["jsonData"]["timeInterval"] == prometheus["global"]["scrape_interval"], "{source:?}");
    let providers: Value = serde_yaml_ng::from_str(&text("grafana/provisioning/dashboards/comic.yml")?)?;
    let folder = providers["providers"][0]["options"]["path"].as_str().context("no folder")?;
    let grafana = monitoring("grafana")?;
    let dashboard = format!("{folder}/comic.json");
    ensure!(
        words(&grafana["volumes"]).any(|volume| volume == format!("./grafana/comic.json:{dashboard}:ro")),
        "{folder}"
    );
    let home = &grafana["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"];
    ensure!(*home == dashboard.as_str(), "{home:?}");
    Ok(())
}

#[test]
fn whoever_opens_grafana_may_look_and_nobody_can_log_in() -> Result<()> {
    let settings = monitoring("grafana")?["environment"].clone();
    for (setting, value) in [
        ("GF_AUTH_ANONYMOUS_ENABLED", "true"),
        ("GF_AUTH_ANONYMOUS_ORG_ROLE", "Viewer"),
        ("GF_SECURITY_DISABLE_INITIAL_ADMIN_CREATION", "true"),
    ] {
        ensure!(settings[setting] == value, "{setting}: {:?}", settings[setting]);
    }
    Ok(())
}
