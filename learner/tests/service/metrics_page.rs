//! The pages for Prometheus and a kubelet. The documentation and the dashboard name the same metrics.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::support::World;
use comic_learner::observe::probes;
use comic_learner::observe::prometheus::Prometheus;
use comic_proto::v1::Verdict;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};

/// An answer's status and body.
async fn get(address: &str, request: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).await.unwrap();
    stream.write_all(format!("{request} HTTP/1.1\r\nHost: test\r\n\r\n").as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head.split(' ').nth(1).unwrap().parse().unwrap(), body.to_owned())
}

async fn observed(world: &World) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    tokio::spawn(probes::serve(listener, world.service.probed()));
    address
}

fn value(page: &str, name: &str) -> f64 {
    let line = page.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    line.unwrap_or_else(|| panic!("no {name} in {page}")).parse().unwrap()
}

#[tokio::test]
async fn the_metrics_count_what_happens() {
    let world = World::start().await;
    let address = observed(&world).await;
    let mut actor = world.actor(70).await;
    let _watch = actor.watch().await;
    let mut unrolls = actor.stream().await;
    assert_eq!(unrolls.verdict(actor.unroll(0)).await, Verdict::Taken);
    assert_eq!(unrolls.verdict(actor.unroll_with(1, |header| header.layout_hash.clear())).await, Verdict::Invalid);
    let (status, page) = get(&address, "GET /metrics").await;
    assert_eq!(status, 200);
    for (name, expected) in [
        ("comic_unrolls_produced_total", 2.0),
        ("comic_unrolls_dropped_total{reason=\"invalid\"}", 1.0),
        ("comic_unrolls_in_flight", 1.0),
        ("comic_unroll_bytes_count", 2.0),
        ("comic_joins_total{result=\"joined\"}", 1.0),
        ("comic_actors{state=\"alive\"}", 1.0),
        ("comic_actors{state=\"lost\"}", 0.0),
        ("comic_connections", 1.0),
        ("comic_requests", 2.0),
        ("comic_ingest_bytes", 0.0),
        ("comic_unrolls_late_total", 0.0),
        ("comic_updates_total", 0.0),
        ("comic_learner_epoch", 3.0),
    ] {
        assert_eq!(value(&page, name), expected, "{name}");
    }
    assert!(value(&page, "process_resident_memory_bytes") > 1e6);
    assert!(page.ends_with("# EOF\n"));
}

#[tokio::test]
async fn probes_say_whether_the_learner_lives_and_whether_it_accepts_actors() {
    let mut world = World::start().await;
    let address = observed(&world).await;
    assert_eq!(get(&address, "GET /healthz").await, (200, "ok\n".into()));
    assert_eq!(get(&address, "GET /readyz").await, (200, "ready\n".into()));
    assert_eq!(get(&address, "GET /").await.0, 404);
    assert_eq!(get(&address, "DELETE /metrics").await.0, 405);
    world.begin_shutdown();
    world.ended().await.unwrap();
    assert_eq!(get(&address, "GET /readyz").await.0, 503);
    assert_eq!(get(&address, "GET /healthz").await.0, 200);
}

#[tokio::test]
async fn a_silent_peer_does_not_block_the_metrics() {
    let world = World::start().await;
    let address = observed(&world).await;
    let _silent = TcpStream::connect(&address).await.unwrap();
    assert_eq!(get(&address, "GET /metrics").await.0, 200);
}

fn repository(path: &str) -> String {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..");
    std::fs::read_to_string(root.join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

#[test]
fn the_reference_agrees_with_the_code() {
    let reference = Prometheus::default().reference();
    assert!(
        repository("docs/metrics.md") == reference,
        "docs/metrics.md is not up to date: run `comic-learner metrics > docs/metrics.md`"
    );
}

/// Whether a letter can be in the name of a metric.
fn in_name(letter: char) -> bool {
    letter.is_ascii_alphanumeric() || letter == '_'
}

/// How often the text names a metric. Each of them must exist.
fn metrics_that_exist(text: &str) -> usize {
    let known: BTreeSet<String> = Prometheus::default().names().into_iter().collect();
    let words = text.split(|letter| !in_name(letter));
    let names: Vec<_> = words.filter(|word| word.starts_with("comic_") || word.starts_with("process_")).collect();
    for name in &names {
        assert!(known.contains(*name), "{text}: no metric is called {name}");
    }
    names.len()
}

#[test]
fn the_dashboard_shows_metrics_that_exist() {
    let dashboard: serde_json::Value = serde_json::from_str(&repository("deploy/grafana/comic.json")).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let targets = panels.iter().flat_map(|panel| panel["targets"].as_array().into_iter().flatten());
    let expressions: Vec<&str> = targets.map(|target| target["expr"].as_str().unwrap()).collect();
    assert!(expressions.len() > 10, "{expressions:?}");
    for expression in expressions {
        // Prometheus itself makes ALERTS.
        assert!(metrics_that_exist(expression) > 0 || expression.contains("(ALERTS{"), "{expression}");
    }
}

#[test]
fn the_alert_rules_ask_for_metrics_labels_and_values_that_exist() {
    let rules = repository("deploy/prometheus/rules/comic.yml");
    assert!(metrics_that_exist(&rules) > 10);
    let reference = Prometheus::default().reference();
    let mut selections = 0;
    for (name, rest) in rules.split("comic_").filter_map(|text| text.split_once('{')) {
        let Some((selection, _)) = rest.split_once('}').filter(|_| name.chars().all(in_name)) else { continue };
        let (label, values) = selection.split_once('=').unwrap();
        let row = reference.lines().find(|row| row.starts_with(&format!("| `comic_{name}` |"))).unwrap();
        let (_, allowed) = row.split_once(&format!("`{label}`: ")).unwrap_or_else(|| panic!("{row}: no label {label}"));
        let allowed: Vec<_> = allowed.split(" |").next().unwrap().split(", ").collect();
        for value in values.trim_matches(['~', '"']).split('|') {
            assert!(allowed.contains(&value), "comic_{name}: {label} is never {value}");
        }
        selections += 1;
    }
    assert!(selections > 5, "{selections}");
}
