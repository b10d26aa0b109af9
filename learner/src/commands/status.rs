//! `comic-learner status`: the state of a running learner, as text or JSON.

use std::fmt::{self, Write as _};
use std::io::{IsTerminal as _, Write as _};
use std::time::Duration;

use clap::Args;
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{self, StatusRequest};
use comic_proto::{Access, chain, distrusted, no_connection};
use serde_json::{Value, json};
use tonic::Code;

use crate::error::{Error, Result};

/// The interval of `--watch`.
const INTERVAL: Duration = Duration::from_secs(2);
/// The time within which a learner must answer.
const TIME_LIMIT: Duration = Duration::from_secs(10);

/// Prints run, speed, queue, ages, accounting and actors of a running learner.
#[derive(Clone, Debug, Args)]
pub struct Status {
    /// The learner's address.
    #[arg(long, value_name = "URL", env = "COMIC_LEARNER", default_value = "http://127.0.0.1:7070")]
    pub learner: String,
    /// One JSON object on one line.
    #[arg(long)]
    pub json: bool,
    /// Repeat every two seconds on the same screen, also while the learner does not answer.
    #[arg(long)]
    pub watch: bool,
    /// How to reach it.
    #[command(flatten)]
    pub access: Access,
}

impl Status {
    /// Asks, and prints the answer.
    ///
    /// # Errors
    /// A learner that does not answer; [`Error::Configuration`] if the token or a certificate is not accepted.
    pub fn run(&self) -> Result<()> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(Error::system("cannot start tokio"))?;
        runtime.block_on(async {
            if !self.watch {
                return print(&self.render(&self.ask().await?));
            }
            loop {
                match self.ask().await {
                    Ok(status) => self.show(&self.render(&status))?,
                    Err(error @ Error::Configuration(_)) => return Err(error),
                    Err(error) => self.show(&format!("{}\n", chain(&error)))?,
                }
                tokio::select! {
                    () = tokio::time::sleep(INTERVAL) => {}
                    _ = tokio::signal::ctrl_c() => return Ok(()),
                }
            }
        })
    }

    async fn ask(&self) -> Result<v1::Status> {
        let (endpoint, bearer) = (self.access.endpoint(&self.learner)?, self.access.bearer()?);
        let call = async {
            let channel = endpoint.connect().await;
            let channel = channel.map_err(|error| self.classify(&error, &no_connection(&error), false))?;
            let mut client = LearnerClient::with_interceptor(channel, bearer);
            let answer = client.get_status(StatusRequest {}).await;
            answer.map_err(|status| {
                let refused = status.code() == Code::Unauthenticated;
                self.classify(&status, &chain(&status), refused)
            })
        };
        let answer = tokio::time::timeout(TIME_LIMIT, call).await;
        let late = |_| {
            let remedy = "is the address right, and is the learner overloaded?";
            Error::NoAnswer(format!("{} does not answer within {TIME_LIMIT:?}; {remedy}", self.learner))
        };
        Ok(answer.map_err(late)??.into_inner())
    }

    /// An error of a call, and its reason. A `refused` token and a certificate that is not trusted are wrong configurations.
    fn classify(&self, error: &(dyn std::error::Error + 'static), reason: &str, refused: bool) -> Error {
        let message = format!("{}: {reason}", self.learner);
        if refused || distrusted(error) { Error::Configuration(message) } else { Error::NoAnswer(message) }
    }

    fn render(&self, status: &v1::Status) -> String {
        if self.json { format!("{}\n", to_json(status)) } else { Text(status).to_string() }
    }

    /// Prints a state. On a terminal it replaces the one before.
    fn show(&self, text: &str) -> Result<()> {
        let clear = if std::io::stdout().is_terminal() && !self.json { "\x1b[H\x1b[2J" } else { "" };
        print(&format!("{clear}{text}"))
    }
}

fn print(text: &str) -> Result<()> {
    let mut stdout = std::io::stdout();
    stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()).map_err(Error::system("cannot write to stdout"))
}

fn metrics(status: &v1::Status) -> Value {
    serde_json::from_str(&status.metrics_json).unwrap_or_default()
}

fn to_json(status: &v1::Status) -> Value {
    let accounting = status.accounting.unwrap_or_default();
    let queue = status.queue.unwrap_or_default();
    let ages = status.ages.unwrap_or_default();
    let actors = status.actors.unwrap_or_default();
    json!({
        "run": status.run,
        "experiment": status.experiment,
        "learner_epoch": status.learner_epoch,
        "uptime_seconds": status.uptime_seconds,
        "metrics": metrics(status),
        "queue": { "unrolls": queue.unrolls, "capacity": queue.capacity, "waiting": queue.waiting },
        "ages": { "median": ages.median, "p99": ages.p99, "max": ages.max },
        "accounting": {
            "produced": accounting.produced,
            "trained": accounting.trained,
            "dropped": {
                "stale": accounting.dropped_stale,
                "invalid": accounting.dropped_invalid,
                "superseded": accounting.dropped_superseded,
                "lost_at_restart": accounting.dropped_lost_at_restart,
            },
            "in_flight": accounting.in_flight,
            "duplicates": accounting.duplicates,
            "unattributed": accounting.unattributed,
        },
        "actors": { "alive": actors.alive, "slow": actors.slow, "lost": actors.lost },
    })
}

/// The state as text.
struct Text<'a>(&'a v1::Status);

impl fmt::Display for Text<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let status = self.0;
        let metrics = metrics(status);
        let whole = |name: &str| grouped(count(&metrics[name]));
        let rate = |name: &str| metrics[name].as_f64().unwrap_or_default();
        let seconds = status.uptime_seconds as u64;
        let (hours, minutes, seconds) = (seconds / 3600, seconds / 60 % 60, seconds % 60);
        writeln!(f, "run         {} ({}), up {hours}:{minutes:02}:{seconds:02}", status.run, status.experiment)?;
        writeln!(f, "            learner epoch {}, version {}", status.learner_epoch, whole("version"))?;
        let (updates, steps) = (rate("updates_per_second"), rate("steps_per_second"));
        writeln!(f, "training    {updates:.2} updates/s, {} environment steps/s", grouped(steps.round() as u64))?;
        writeln!(f, "            {} updates, {} environment steps", whole("updates"), whole("environment_steps"))?;
        let queue = status.queue.unwrap_or_default();
        writeln!(f, "queue       {} of {} unrolls, {} waiting", queue.unrolls, queue.capacity, queue.waiting)?;
        let ages = status.ages.unwrap_or_default();
        writeln!(f, "ages        median {}, p99 {}, at most {} versions", ages.median, ages.p99, ages.max)?;
        let v1::Accounting { produced, trained, in_flight, duplicates, unattributed, .. } =
            status.accounting.unwrap_or_default();
        let accounting = status.accounting.unwrap_or_default();
        let dropped = [
            ("stale", accounting.dropped_stale),
            ("invalid", accounting.dropped_invalid),
            ("superseded", accounting.dropped_superseded),
            ("lost at restart", accounting.dropped_lost_at_restart),
        ];
        let sum = grouped(dropped.iter().map(|(_, count)| count).sum());
        let (produced, trained) = (grouped(produced), grouped(trained));
        writeln!(f, "accounting  produced {produced} = trained {trained} + dropped {sum} + in flight {in_flight}")?;
        let reasons: Vec<_> = dropped.iter().map(|(reason, count)| format!("{reason} {}", grouped(*count))).collect();
        writeln!(f, "            dropped: {}", reasons.join(", "))?;
        writeln!(f, "            beside them: duplicates {duplicates}, unattributed {unattributed}")?;
        for (name, task) in metrics["tasks"].as_object().into_iter().flatten() {
            let [produced, trained, in_flight] =
                ["produced", "trained", "in_flight"].map(|part| count(&task["accounting"][part]));
            let dropped =
                task["accounting"]["dropped"].as_object().into_iter().flatten().map(|(_, part)| count(part)).sum();
            let [produced, trained, dropped, in_flight] = [produced, trained, dropped, in_flight].map(grouped);
            let sum = format!("trained {trained} + dropped {dropped} + in flight {in_flight}");
            writeln!(f, "            {name}: produced {produced} = {sum}")?;
        }
        let actors = status.actors.unwrap_or_default();
        writeln!(f, "actors      {} alive, {} slow, {} lost", actors.alive, actors.slow, actors.lost)
    }
}

/// A count; 0 if it is absent.
fn count(number: &Value) -> u64 {
    number.as_u64().unwrap_or_default()
}

/// `1234567` as `1,234,567`.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push(',');
        }
        // Writing to a string cannot fail.
        let _ = text.write_char(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_learner_the_error_names_the_address_and_the_remedy() {
        // No server listens at port 1.
        let learner = String::from("http://127.0.0.1:1");
        let error = Status { learner, json: false, watch: false, access: Access::default() }.run().unwrap_err();
        assert_eq!(error.exit_code(), 1, "the learner may come: {error}");
        let said = error.to_string();
        assert!(said.contains("http://127.0.0.1:1: nothing answers; is the learner running"), "{said}");
    }

    #[test]
    fn numbers_are_grouped() {
        let shown: Vec<_> = [0, 999, 1000, 1_234_567].map(grouped).into();
        assert_eq!(shown, ["0", "999", "1,000", "1,234,567"]);
    }

    #[test]
    fn joint_training_shows_the_accounting_of_every_task() {
        let accounting =
            json!({ "produced": 1234, "trained": 1000, "dropped": { "stale": 200, "invalid": 30 }, "in_flight": 4 });
        let metrics_json = json!({ "tasks": { "get-up": { "accounting": accounting }, "tracking": {} } }).to_string();
        let text = Text(&v1::Status { metrics_json, ..v1::Status::default() }).to_string();
        assert!(text.contains("get-up: produced 1,234 = trained 1,000 + dropped 230 + in flight 4\n"), "{text}");
        assert!(text.contains("tracking: produced 0 = trained 0 + dropped 0 + in flight 0\n"), "{text}");
    }

    #[test]
    fn the_state_of_a_learner_without_metrics_is_shown() {
        let text = Text(&v1::Status::default()).to_string();
        assert!(text.contains("0.00 updates/s") && text.contains("0 alive"), "{text}");
        assert_eq!(to_json(&v1::Status::default())["accounting"]["trained"], 0);
    }
}
