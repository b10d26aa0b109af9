//! Prometheus's alert rules. promtool, which is in Debian's package `prometheus`, evaluates them on series of our own.

use std::fs;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;
use serde_yaml_ng::Value;

fn text(path: &str) -> Result<String> {
    fs::read_to_string(root().join(path)).with_context(|| format!("cannot read {path}"))
}

/// The rules, each with its fields `alert`, `expr`, `for`, `labels` and `annotations`.
fn rules() -> Result<Vec<Value>> {
    let document: Value = serde_yaml_ng::from_str(&text("deploy/prometheus/rules/comic.yml")?)?;
    let rules = document["groups"][0]["rules"].as_sequence().context("no rules")?;
    ensure!(rules.len() > 10, "{rules:?}");
    Ok(rules.clone())
}

fn word<'a>(rule: &'a Value, place: &[&str]) -> Result<&'a str> {
    let value = place.iter().fold(rule, |value, key| &value[*key]);
    value.as_str().filter(|text| !text.is_empty()).with_context(|| format!("no {place:?} in {rule:?}"))
}

fn promtool(arguments: &[&str]) -> Result<()> {
    let output = Command::new("promtool").args(arguments).current_dir(root()).output();
    let output = output.context("cannot start promtool: install Debian's package prometheus")?;
    let (told, failed) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    ensure!(output.status.success(), "promtool {arguments:?}: {told}{failed}");
    Ok(())
}

#[test]
fn promtool_accepts_the_configuration_and_its_rules() -> Result<()> {
    let check = ["check", "config", "--lint=all", "--lint-fatal"];
    promtool(&[&check[..], &["deploy/prometheus/prometheus.yml", "deploy/prometheus/data-parallel.yml"]].concat())
}

#[test]
fn promtool_sees_each_alert_fire_alone_and_none_while_a_learner_trains() -> Result<()> {
    promtool(&["test", "rules", "deploy/prometheus/tests/comic.yml"])
}

#[test]
fn every_alert_has_a_case_in_which_it_fires() -> Result<()> {
    let cases = text("deploy/prometheus/tests/comic.yml")?;
    for rule in rules()? {
        let alert = word(&rule, &["alert"])?;
        ensure!(
            cases.contains(&format!("{{alertname=\"{alert}\"")),
            "deploy/prometheus/tests/comic.yml: no case of {alert}"
        );
    }
    Ok(())
}

/// `documentation.rs` checks that the links of the page lead somewhere.
#[test]
fn every_alert_waits_says_what_to_do_and_is_documented() -> Result<()> {
    let page = text("docs/monitoring.md")?;
    for rule in rules()? {
        let alert = word(&rule, &["alert"])?;
        for place in [&["for"][..], &["annotations", "summary"], &["annotations", "description"]] {
            word(&rule, place)?;
        }
        let row = page.lines().find(|line| line.starts_with(&format!("| `{alert}` |")));
        let row = row.with_context(|| format!("docs/monitoring.md has no row for {alert}"))?;
        let severity = word(&rule, &["labels", "severity"])?;
        ensure!(["critical", "warning"].contains(&severity) && row.contains(severity), "{severity}: {row}");
        let runbook = word(&rule, &["annotations", "runbook"])?;
        let link = format!("({})", runbook.strip_prefix("docs/").context("a page of docs/")?);
        ensure!(row.contains(&link), "the row of {alert} has no link to {runbook}");
    }
    Ok(())
}
