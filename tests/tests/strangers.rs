//! An actor goes on training while strangers flood the learner with connections, with calls without a token, and with probes.

use std::net::SocketAddr;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use comic_proto::Access;
use comic_proto::v1::StatusRequest;
use comic_proto::v1::learner_client::LearnerClient;
use comic_tests::steps::{LIMIT, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System};
use tokio::net::{TcpSocket, TcpStream};
use tokio::task::JoinSet;

/// More than one address may have, and more than the probes have.
const CONNECTIONS: usize = 200;
const OPTIONS: [&str; 4] = ["--max-connections-per-address", "50", "--authentication-timeout", "2"];

#[tokio::test]
async fn an_actor_goes_on_training_through_floods_of_strangers() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let token = directory.path().join("token");
    std::fs::write(&token, "open-sesame\n")?;
    let file = token.display().to_string();
    let mut system = System::new(&[&SMALL[..], &OPTIONS, &["--token-file", &file, "--metrics-port", "0"]].concat())?;
    system.access = Access { token_file: Some(token), ..Access::default() };
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;

    let mut floods = JoinSet::new();
    floods.spawn(silent_connections(system.address().parse()?));
    floods.spawn(silent_connections(system.metrics_address()?.parse()?));
    floods.spawn(calls_without_a_token(system.url()));
    for _ in 0..3 {
        trains_on(&mut system, "the actor's unrolls are trained on during the floods").await?;
        ensure!(system.metrics_page()?.contains("comic_updates_total"), "the probes answer");
    }
    let page = system.metrics_page()?;
    for refused in [
        "comic_connections_refused_total{reason=\"per_address\"}",
        "comic_requests_refused_total{reason=\"unauthenticated\"}",
    ] {
        let count = page.lines().find_map(|line| line.strip_prefix(refused)?.trim().parse::<f64>().ok());
        ensure!(count.with_context(|| format!("no {refused}"))? > 0.0, "no flood came: {refused} is 0");
    }
    ensure!(floods.try_join_next().is_none(), "a flood ended early");
    floods.shutdown().await;

    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}

/// Keeps many connections of another address that say nothing, and replaces each that the learner closes.
async fn silent_connections(to: SocketAddr) -> Result<()> {
    let mut connections = JoinSet::new();
    loop {
        while connections.len() < CONNECTIONS {
            connections.spawn(silent_connection(to));
        }
        connections.join_next().await;
    }
}

async fn silent_connection(to: SocketAddr) -> Result<()> {
    // The two cores of this machine also train.
    tokio::time::sleep(Duration::from_millis(20)).await;
    let socket = TcpSocket::new_v4()?;
    socket.bind(SocketAddr::from(([127, 0, 0, 2], 0)))?;
    let connection: TcpStream = socket.connect(to).await?;
    let mut said = [0; 1024];
    loop {
        connection.readable().await?;
        match connection.try_read(&mut said) {
            Ok(0) => break,
            Err(error) if error.kind() != std::io::ErrorKind::WouldBlock => break,
            _ => {}
        }
    }
    Ok(())
}

async fn calls_without_a_token(url: String) -> Result<()> {
    let mut client = LearnerClient::new(Access::default().endpoint(&url)?.connect().await?);
    loop {
        if client.get_status(StatusRequest {}).await.is_ok() {
            anyhow::bail!("a call without a token was answered");
        }
        if let Ok(channel) = Access::default().endpoint(&url)?.connect().await {
            client = LearnerClient::new(channel);
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}
