//! The images and the compose files, tested with real containers.
//!
//! `cargo xtask test --docker` builds the images first. Without `--docker` it says that these tests are not run.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use comic_tests::compose::{Project, docker};
use serde_json::Value;

/// Long enough for two slow cores. A step ends as soon as its condition holds.
const LIMIT: Duration = Duration::from_secs(180);
/// One actor with half a core makes every unroll.
const HUNDREDS_OF_UPDATES: Duration = Duration::from_secs(600);
/// Docker waits longer and longer between two starts, in all for two minutes, and without a network a name is looked up slowly.
const ELEVEN_STARTS: Duration = Duration::from_secs(900);
/// More unrolls than removed containers can have in flight.
const BEYOND_WHAT_IS_LEFT: u64 = 100;

fn trained(status: &Value) -> u64 {
    status["accounting"]["trained"].as_u64().unwrap_or_default()
}

fn alive(status: &Value) -> u64 {
    status["actors"]["alive"].as_u64().unwrap_or_default()
}

/// Waits for this number of actors, and for more trained unrolls than removed actors can have in flight.
async fn trains_on_with(actors: u64, project: &Project, what: &str) -> Result<Value> {
    let status = project.until(what, LIMIT, |status| alive(status) == actors).await?;
    let before = trained(&status);
    project
        .until(what, LIMIT, |status| alive(status) == actors && trained(status) >= before + BEYOND_WHAT_IS_LEFT)
        .await
}

#[tokio::test]
async fn containers_survive_kills_and_cuts_and_the_accounting_balances() -> Result<()> {
    let mut project = Project::new("faults", &["compose.yaml"]);
    // An evaluator can fetch a checkpoint only until the next one is written.
    project.tell("--set learner.checkpoint_seconds=5");
    project.up(2)?;
    trains_on_with(2, &project, "two actors train").await?;
    check_containers(&project).await?;
    let metrics = get(&project, "learner", "9090", "/metrics")?;
    ensure!(metrics.contains("comic_actors{state=\"alive\"} 2\n"), "Prometheus sees two actors");
    tensorboard_shows_the_curves(&project).await?;
    the_evaluator_films(&project).await?;

    let [killed, kept] = &project.containers("actor")?[..] else { bail!("not two actors") };
    killed.docker(&["kill"])?;
    trains_on_with(1, &project, "one actor trains on when the other is killed").await?;
    ensure!(killed.inspect(".State.ExitCode")? == "137", "the container was not killed");
    project.up(2)?;
    trains_on_with(2, &project, "it is started again").await?;

    let network = project.network();
    docker(&["network", "disconnect", &network, &kept.inspect(".Id")?])?;
    trains_on_with(1, &project, "one actor trains on when the network of the other is cut").await?;
    ensure!(kept.inspect(".State.Running")? == "true", "the actor does not wait for its learner");
    docker(&["network", "connect", &network, &kept.inspect(".Id")?])?;
    kept.until_log_holds("reconnected to the learner", LIMIT).await?;
    trains_on_with(2, &project, "it is back when its network is").await?;

    let learner = project.container("learner")?;
    let before = project.status()?;
    project.compose(&["stop", "learner"])?;
    ensure!(learner.inspect(".State.ExitCode")? == "4", "SIGTERM did not reach the learner: {}", learner.log()?);
    project.compose(&["start", "learner"])?;
    let after = trains_on_with(2, &project, "the learner resumes and the actors find it").await?;
    ensure!(learner.log()?.contains("resuming"), "the learner did not resume: {}", learner.log()?);
    ensure!(after["learner_epoch"].as_u64() > before["learner_epoch"].as_u64(), "the learner epoch did not grow");
    ensure!(trained(&after) > trained(&before), "the count of trained unrolls did not grow");

    project.up(4)?;
    trains_on_with(4, &project, "four actors").await?;
    project.up(1)?;
    trains_on_with(1, &project, "one actor").await?;
    let healthy = project.container("actor")?;
    for container in [&healthy, &learner] {
        container.until_is(".State.Health.Status", "healthy", LIMIT).await?;
    }
    project.compose(&["stop", "actor"])?;
    ensure!(healthy.inspect(".State.ExitCode")? == "1", "an actor that is told to stop must end with 1");
    let last = project.until("no actor is connected", LIMIT, |status| alive(status) == 0).await?;
    ensure!(last["accounting"]["dropped"]["invalid"] == 0, "an actor sent an invalid unroll: {last}");
    Ok(())
}

#[tokio::test]
async fn containers_of_two_learners_survive_the_loss_of_one() -> Result<()> {
    let project = Project::new("ranks", &["compose.yaml", "compose.data-parallel.yaml"]);
    project.up(2)?;
    let before = trains_on_with(1, &project, "each learner trains with an actor of its own").await?;
    let [first, second] = [project.container("learner")?, project.container("learner-1")?];
    second.until_log_holds("actor joined", LIMIT).await?;
    first.until_log_holds("written checkpoint", LIMIT).await?;
    second.docker(&["kill"])?;
    first.until_log_holds("rank 0 lost another rank", LIMIT).await?;
    // Docker starts the first one again. One that was killed by hand it does not.
    project.up(2)?;
    let after = trains_on_with(1, &project, "both resume, and the actors find them").await?;
    ensure!(after["learner_epoch"].as_u64() > before["learner_epoch"].as_u64(), "the learner epoch did not grow");
    ensure!(second.log()?.matches("actor joined").count() == 2, "its actor did not come back: {}", second.log()?);
    for learner in [&first, &second] {
        learner.until_is(".State.Health.Status", "healthy", LIMIT).await?;
    }
    project.compose(&["stop", "learner"])?;
    ensure!(first.inspect(".State.ExitCode")? == "4", "SIGTERM did not reach the learner: {}", first.log()?);
    Ok(())
}

/// Each container runs as a user without privileges, on a read-only file system, with the program as process 1, and healthy.
async fn check_containers(project: &Project) -> Result<()> {
    for (service, program) in [("learner", "comic-learner"), ("actor", "comic-actor"), ("evaluator", "comic-actor")] {
        for container in project.containers(service)? {
            let size = docker(&["image", "inspect", "--format", "{{.Size}}", &container.inspect(".Image")?])?;
            ensure!(size.trim().parse::<u64>()? < 700_000_000, "the image of the {service} has {size} bytes");
            ensure!(container.exec(&["cat", "/proc/1/comm"])?.trim() == program, "process 1 is another program");
            ensure!(container.exec(&["id", "--user"])?.trim() == "10001", "another user");
            ensure!(
                container.exec(&["touch", "/usr/local/bin/file"]).is_err(),
                "the container can write into its image"
            );
            ensure!(container.inspect(".HostConfig.ReadonlyRootfs")? == "true", "root could write into the image");
            if service == "evaluator" {
                ensure!(container.inspect(".State.Health")? == "null", "an evaluator writes no liveness file");
                continue;
            }
            // An actor is healthy after its first steps, some seconds after it joined.
            let begun = Instant::now();
            while let Err(error) = container.exec(&[program, "health"]) {
                ensure!(begun.elapsed() < LIMIT, "{service}: {error:#}");
                tokio::time::sleep(Duration::from_secs(1)).await;
            }
        }
    }
    let actor = project.containers("actor")?.into_iter().next().context("no actor")?;
    ensure!(actor.exec(&["python3", "--version"]).is_err(), "the actor's image holds Python");
    let libraries = project.in_learner(&["find", "/opt/comic", "-name", "libmujoco*"])?;
    ensure!(libraries.is_empty(), "the learner's image holds MuJoCo: {libraries}");
    Ok(())
}

/// The evaluator makes films without a display and on a read-only file system, and the learner keeps them.
async fn the_evaluator_films(project: &Project) -> Result<()> {
    let begun = Instant::now();
    loop {
        match project.in_learner(&["ls", "/runs/default/films"]) {
            Ok(films) if films.contains(".gif") => break,
            answer => {
                let log = project.container("evaluator")?.log()?;
                ensure!(begun.elapsed() < LIMIT, "no film: {answer:?}: {log}");
            }
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    Ok(())
}

/// The profile `tensorboard`: a container that cannot write reads the curves from the learner's volume.
async fn tensorboard_shows_the_curves(project: &Project) -> Result<()> {
    project.compose(&["--profile", "tensorboard", "up", "--detach", "--no-build", "--no-deps", "tensorboard"])?;
    let begun = Instant::now();
    loop {
        match get(project, "tensorboard", "6006", "/data/plugin/scalars/tags") {
            Ok(tags) if tags.contains("normalised_reward") => break,
            answer => ensure!(begun.elapsed() < LIMIT, "TensorBoard shows no curve: {answer:?}"),
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    let container = project.container("tensorboard")?;
    container.until_is(".State.Health.Status", "healthy", LIMIT).await?;
    ensure!(container.exec(&["id", "--user"])?.trim() == "10001", "another user");
    ensure!(container.inspect(".HostConfig.ReadonlyRootfs")? == "true", "root could write into the image");
    ensure!(container.exec(&["touch", "/runs/file"]).is_err(), "the container can write into the runs");
    project.compose(&["--profile", "tensorboard", "rm", "--stop", "--force", "tensorboard"]).map(drop)
}

/// Gets a page from a port that Compose publishes.
fn get(project: &Project, service: &str, port: &str, path: &str) -> Result<String> {
    let address = project.compose(&["--profile", "tensorboard", "port", service, port])?;
    let mut stream = TcpStream::connect(address.trim())?;
    stream.set_read_timeout(Some(Duration::from_secs(10)))?;
    stream.write_all(format!("GET {path} HTTP/1.1\r\nHost: {service}\r\nConnection: close\r\n\r\n").as_bytes())?;
    let mut page = String::new();
    stream.read_to_string(&mut page)?;
    Ok(page)
}

#[tokio::test]
async fn containers_make_their_own_certificates_and_token() -> Result<()> {
    let project = Project::new("tls", &["compose.yaml", "compose.tls.yaml"]);
    project.up(2)?;
    trains_on_with(2, &project, "two actors train").await?;
    project.in_learner(&["comic-learner", "health"])?;
    let shown = project.compose(&["exec", "-T", "actor", "ls", "/access"])?;
    let shown: Vec<_> = shown.split_whitespace().collect();
    ensure!(
        shown == ["ca.pem", "client-key.pem", "client.pem", "token"],
        "an actor has what is not its own: {shown:?}"
    );
    let refused = project.in_learner(&["env", "--unset=COMIC_TOKEN_FILE", "comic-learner", "status"]);
    ensure!(refused.is_err_and(|error| format!("{error:#}").contains("token")), "the learner answers without a token");
    Ok(())
}

/// Compose restarts the container ten times within two minutes, then gives up.
#[tokio::test]
async fn containers_with_a_wrong_configuration_are_restarted_ten_times_only() -> Result<()> {
    let mut project = Project::new("mistake", &["compose.yaml"]);
    project.tell("--set no.such.field=1");
    project.compose(&["up", "--detach", "--no-build", "learner"])?;
    let learner = project.container("learner")?;
    learner.until_is(".RestartCount", "10", LIMIT).await?;
    learner.until_is(".State.Status", "exited", LIMIT).await?;
    ensure!(learner.inspect(".State.ExitCode")? == "2", "{}", learner.log()?);
    Ok(())
}

#[tokio::test]
async fn containers_end_when_the_run_is_over() -> Result<()> {
    let mut project = Project::new("over", &["compose.yaml"]);
    project.tell("--set budget.updates=200");
    // Nobody waits at the end for an actor that has never joined, so everyone has to be connected by then.
    project.up(0)?;
    project.container("evaluator")?.until_log_holds("following the learner's checkpoints", LIMIT).await?;
    project.up(2)?;
    let containers = ["learner", "actor", "evaluator"].map(|service| project.containers(service));
    let containers = containers.into_iter().collect::<Result<Vec<_>>>()?.concat();
    ensure!(containers.len() == 4, "{containers:?}");
    for container in containers {
        container.until_is(".State.Status", "exited", LIMIT).await?;
        ensure!(container.inspect(".State.ExitCode")? == "0", "{}", container.log()?);
    }
    Ok(())
}

#[tokio::test]
async fn containers_end_when_they_missed_the_end_of_the_run() -> Result<()> {
    let mut project = Project::new("missed", &["compose.yaml"]);
    project.patience = 1;
    // An update takes one actor a tenth of a second on a slow machine: time enough to cut the network before the end.
    project.tell("--set budget.updates=400");
    project.up(1)?;
    let [learner, actor] = [project.container("learner")?, project.container("actor")?];
    actor.until_log_holds("joined the learner", LIMIT).await?;
    docker(&["network", "disconnect", &project.network(), &actor.inspect(".Id")?])?;
    // A second actor brings the run to its end.
    project.up(2)?;
    learner.until_is(".State.Status", "exited", HUNDREDS_OF_UPDATES).await?;
    ensure!(learner.inspect(".State.ExitCode")? == "0", "{}", learner.log()?);
    // Docker starts it again ten times.
    actor.until_is(".RestartCount", "10", ELEVEN_STARTS).await?;
    actor.until_is(".State.Status", "exited", LIMIT).await?;
    ensure!(actor.inspect(".State.ExitCode")? == "3", "{}", actor.log()?);
    Ok(())
}
