//! What a person sees while a run goes on: a panel on a terminal, a row of its own where several runs share one, JSON
//! lines elsewhere.

use std::path::PathBuf;
use std::process::Stdio;
use std::time::{Duration, Instant};

use anyhow::Result;
use comic_experiment::Budget;
use comic_setup::on_terminal;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::{Map, Value};

use super::metrics::Line;
use super::process::append;

/// One run as a person sees it.
pub(crate) struct Display {
    sight: Sight,
    /// What the run is called beside others.
    name: Option<String>,
    budget: Budget,
    started: Instant,
}

enum Sight {
    /// Several lines that stay, on a terminal of the run's own.
    Panel(ProgressBar),
    /// Plain lines under a panel that is finished.
    Text,
    /// One line that shows the newest, on a terminal that runs share.
    Row(ProgressBar),
    /// JSON lines, where no terminal is.
    Lines,
}

/// Ticks of the budget's bar.
const TICKS: f64 = 1000.0;

impl Display {
    /// Of a run that has the terminal for itself.
    pub(super) fn new(budget: &Budget) -> Self {
        let panel = || {
            let panel = ProgressBar::with_draw_target(Some(TICKS as u64), ProgressDrawTarget::stderr());
            if let Ok(style) = ProgressStyle::with_template("{msg}\n{elapsed_precise} {wide_bar} {percent:>3} %") {
                panel.set_style(style);
            }
            panel.set_message("waiting for the first batch");
            panel.enable_steady_tick(Duration::from_millis(500));
            panel
        };
        let sight = if on_terminal() { Sight::Panel(panel()) } else { Sight::Lines };
        Self { sight, name: None, budget: budget.clone(), started: Instant::now() }
    }

    /// Of the run `name` beside others: in a row of their terminal, which this styles, if they have one.
    pub(crate) fn beside_others(name: &str, budget: &Budget, row: Option<ProgressBar>) -> Self {
        let sight = row.map_or(Sight::Lines, |row| {
            row.set_length(TICKS as u64);
            if let Ok(style) = ProgressStyle::with_template("  {prefix} {bar:16} {percent:>3} %  {wide_msg}") {
                row.set_style(style);
            }
            row.set_prefix(name.to_owned());
            Sight::Row(row)
        });
        Self { sight, name: Some(name.to_owned()), budget: budget.clone(), started: Instant::now() }
    }

    /// Something happened that is worth a line.
    pub(super) fn event(&mut self, event: &str, facts: &[(&str, String)]) {
        match &self.sight {
            Sight::Panel(panel) => panel.println(event_text(event, facts)),
            Sight::Text => eprintln!("{}", event_text(event, facts)),
            Sight::Row(row) => row.set_message(event_text(event, facts).replace('\n', " ")),
            Sight::Lines => {
                let facts = facts.iter().map(|(name, value)| ((*name).to_owned(), Value::from(value.as_str())));
                self.line(event, facts.collect());
            }
        }
    }

    /// The learner wrote a line into its log.
    pub(super) fn learner(&mut self, line: &str) {
        // Its own date and level say nothing that a panel does not.
        let said = line.split_once(" INFO ").map_or(line, |(_, said)| said);
        self.event("learner", &[("says", said.trim().to_owned())]);
    }

    /// A line of metrics came.
    pub(super) fn metrics(&mut self, text: &str) {
        let Ok(line) = serde_json::from_str::<Line>(text) else {
            self.event("unreadable metrics", &[("line", text.to_owned())]);
            return;
        };
        let ticks = (self.share(&line) * TICKS) as u64;
        match &self.sight {
            Sight::Panel(panel) => {
                panel.set_message(panel_text(&line));
                panel.set_position(ticks);
            }
            Sight::Row(row) => {
                row.set_message(row_text(&line));
                row.set_position(ticks);
            }
            Sight::Text | Sight::Lines => {
                let facts = serde_json::from_str::<Map<String, Value>>(text).unwrap_or_default();
                self.line("progress", facts);
            }
        }
    }

    /// How much of the budget is spent, 0 to 1; whatever limit comes first.
    fn share(&self, line: &Line) -> f64 {
        let of = |spent: f64, limit: f64| if limit > 0.0 { spent / limit } else { 0.0 };
        of(line.seconds, self.budget.minutes * 60.0)
            .max(of(line.environment_steps as f64, self.budget.environment_steps as f64))
            .max(of(line.updates as f64, self.budget.updates as f64))
            .clamp(0.0, 1.0)
    }

    fn line(&self, event: &str, mut facts: Map<String, Value>) {
        facts.insert("event".into(), event.into());
        if let Some(name) = &self.name {
            facts.insert("run".into(), name.as_str().into());
        }
        facts.insert("elapsed_seconds".into(), self.started.elapsed().as_secs_f64().into());
        eprintln!("{}", Value::Object(facts));
    }

    /// Where a child says how far it is: here, or in `log` where runs are beside each other.
    pub(super) fn stderr(&self, log: PathBuf) -> Result<Stdio> {
        Ok(if self.name.is_some() { append(&log)?.into() } else { Stdio::inherit() })
    }

    /// Leaves the panel standing as it is; what comes after it are lines below.
    pub(super) fn finish(&mut self) {
        if let Sight::Panel(panel) = &self.sight {
            panel.abandon();
            self.sight = Sight::Text;
        }
    }

    /// The run beside others is over: its last event takes the place of its row.
    pub(crate) fn conclude(mut self, event: &str, facts: &[(&str, String)]) {
        match (&self.sight, &self.name) {
            (Sight::Row(row), Some(name)) => {
                row.println(format!("{name}  {}", event_text(event, facts)));
                row.finish_and_clear();
            }
            _ => self.event(event, facts),
        }
    }
}

fn event_text(event: &str, facts: &[(&str, String)]) -> String {
    let facts: Vec<_> = facts.iter().map(|(name, value)| format!("{name}: {value}")).collect();
    format!("{event}  {}", facts.join(", "))
}

fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{value:.decimals$}"))
}

fn panel_text(line: &Line) -> String {
    let accounting = line.accounting.as_ref().map_or_else(String::new, |accounting| {
        let dropped: u64 = accounting.dropped.values().sum();
        format!(
            "\nunrolls produced {}   trained {}   dropped {dropped}   in flight {}",
            accounting.produced, accounting.trained, accounting.in_flight
        )
    });
    // In joint training a line for each task: their rewards have nothing to do with one another.
    let tasks = line.tasks.iter().map(|(task, own)| {
        format!(
            "\n{task:<12}      {:>6}   survived {:>5}   head {:>5} m   environment steps lately {}",
            number(own.normalised_reward, 3),
            number(own.fraction_survived, 2),
            number(own.head_height, 2),
            own.environment_steps
        )
    });
    let tasks: String = tasks.collect();
    format!(
        "environment steps {:>10}   steps/s {:>8}   updates {:>7}   unroll age {:>5}\n\
         reward per step {:>7}   latent KL {:>7} nats/step   episode length {:>6}   return {:>7}\n\
         normalised reward {:>6}   survived {:>5}{tasks}{accounting}",
        line.environment_steps,
        number(line.steps_per_second, 0),
        line.updates,
        number(line.unroll_age, 1),
        number(line.reward_per_step, 3),
        number(line.latent_kl(), 2),
        number(line.episode_length, 1),
        number(line.episode_return, 2),
        number(line.normalised_reward, 3),
        number(line.fraction_survived, 2),
    )
}

fn row_text(line: &Line) -> String {
    format!(
        "normalised reward {}   latent KL {} nats/step   environment steps {}",
        number(line.normalised_reward, 3),
        number(line.latent_kl(), 2),
        line.environment_steps
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_panel_shows_every_tasks_own_reward() {
        let line: Line = serde_json::from_str(
            r#"{"normalised_reward":0.25,"tasks":{"tracking":{"normalised_reward":0.125},
                "get-up":{"normalised_reward":0.5,"head_height":1.25,"environment_steps":77}}}"#,
        )
        .unwrap();
        let text = panel_text(&line);
        let of = |task: &str| text.lines().find(|line| line.starts_with(task)).map(str::to_owned).unwrap_or_default();
        assert!(of("tracking").contains("0.125"), "{text}");
        assert!(["0.500", "1.25 m", "77"].iter().all(|part| of("get-up").contains(part)), "{text}");
    }

    #[test]
    fn panel_and_row_show_the_latents_kl_beside_the_reward() {
        let line: Line = serde_json::from_str(r#"{"normalised_reward":0.25,"losses":{"latent_kl":12.345}}"#).unwrap();
        for text in [panel_text(&line), row_text(&line)] {
            assert!(text.contains("latent KL") && text.contains("12.3") && text.contains("0.250"), "{text}");
        }
    }
}
