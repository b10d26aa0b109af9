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
    let (plain, tls) = (compose("compose.yaml")?, compose("compose.tls.yaml")?);
    let services =
        |document: &Value| Ok::<_, anyhow::Error>(document["services"].as_mapping().context("no services")?.clone());
    let plain = services(&plain)?;
    // The second file is laid over the first: only services that the first does not have are complete in it.
    let own = services(&tls)?.into_iter().filter(|(name, _)| !plain.contains_key(name));
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
    // Compose does not build the images for accelerators.
    ensure!(asked.remove("ACCELERATOR"), "the Dockerfile has no argument ACCELERATOR");
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
    let used =
        [("compose.yaml", ["learner", "actor", "evaluator"]), ("compose.tls.yaml", ["certs", "learner", "evaluator"])];
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
