//! Shows a run's progress: a panel on a terminal, a row of the terminal that several runs share, JSON lines elsewhere.

use std::path::PathBuf;
use std::process::Stdio;
use std::time::{Duration, Instant};

use anyhow::Result;
use comic_experiment::Budget;
use comic_setup::on_terminal;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::{Map, Value};

use super::process::append;
use crate::evaluations;
use crate::metrics::Line;

/// The display of one run.
pub(crate) struct Display {
    output: Output,
    /// A panel's text about the newest line of metrics.
    progress: String,
    /// A panel's line about the newest evaluation, after a line break; empty before the first one.
    evaluation: String,
    /// The run's name, if several runs share the terminal.
    name: Option<String>,
    budget: Budget,
    started: Instant,
}

enum Output {
    /// Several lines that are updated, on a terminal of the run's own.
    Panel(ProgressBar),
    /// Plain lines below a finished panel.
    Text,
    /// One line that is updated, on a terminal that several runs share.
    Row(ProgressBar),
    /// JSON lines, where there is no terminal.
    Lines,
}

/// A panel's text before the first line of metrics.
const WAITING: &str = "waiting for the first batch";
/// Ticks of the budget's bar.
const TICKS: f64 = 1000.0;

impl Display {
    /// For a run that has the terminal for itself.
    pub(crate) fn new(budget: &Budget) -> Self {
        let panel = || {
            let panel = ProgressBar::with_draw_target(Some(TICKS as u64), ProgressDrawTarget::stderr());
            if let Ok(style) = ProgressStyle::with_template("{msg}\n{elapsed_precise} {wide_bar} {percent:>3} %") {
                panel.set_style(style);
            }
            panel.set_message(WAITING);
            panel.enable_steady_tick(Duration::from_millis(500));
            panel
        };
        let output = if on_terminal() { Output::Panel(panel()) } else { Output::Lines };
        Self::with(output, None, budget)
    }

    /// For the run `name` among several: in `row` of their terminal, if there is one.
    pub(crate) fn beside_others(name: &str, budget: &Budget, row: Option<ProgressBar>) -> Self {
        let output = row.map_or(Output::Lines, |row| {
            row.set_length(TICKS as u64);
            if let Ok(style) = ProgressStyle::with_template("  {prefix} {bar:16} {percent:>3} %  {wide_msg}") {
                row.set_style(style);
            }
            row.set_prefix(name.to_owned());
            Output::Row(row)
        });
        Self::with(output, Some(name.to_owned()), budget)
    }

    fn with(output: Output, name: Option<String>, budget: &Budget) -> Self {
        let (progress, evaluation) = (WAITING.to_owned(), String::new());
        Self { output, progress, evaluation, name, budget: budget.clone(), started: Instant::now() }
    }

    /// Shows an event with its facts.
    pub(crate) fn event(&mut self, event: &str, facts: &[(&str, String)]) {
        match &self.output {
            Output::Panel(panel) => panel.println(event_text(event, facts)),
            Output::Text => eprintln!("{}", event_text(event, facts)),
            Output::Row(row) => row.set_message(event_text(event, facts).replace('\n', " ")),
            Output::Lines => {
                let facts = facts.iter().map(|(name, value)| ((*name).to_owned(), Value::from(value.as_str())));
                self.line(event, facts.collect());
            }
        }
    }

    /// Shows a line of the learner's log.
    pub(super) fn learner(&mut self, line: &str) {
        // The date and the level are left out.
        let message = line.split_once(" INFO ").map_or(line, |(_, message)| message);
        self.event("learner", &[("message", message.trim().to_owned())]);
    }

    /// Shows a line of metrics.
    pub(super) fn metrics(&mut self, text: &str) {
        let Ok(line) = serde_json::from_str::<Line>(text) else {
            self.event("unreadable metrics", &[("line", text.to_owned())]);
            return;
        };
        let ticks = (line.used(&self.budget) * TICKS) as u64;
        match &self.output {
            Output::Panel(panel) => {
                self.progress = panel_text(&line);
                panel.set_message(format!("{}{}", self.progress, self.evaluation));
                panel.set_position(ticks);
            }
            Output::Row(row) => {
                row.set_message(row_text(&line));
                row.set_position(ticks);
            }
            Output::Text | Output::Lines => {
                let facts = serde_json::from_str::<Map<String, Value>>(text).unwrap_or_default();
                self.line("progress", facts);
            }
        }
    }

    /// Shows a line of `evaluations.jsonl`, unless the evaluation had noise or was started by hand. `best` is the largest
    /// normalised reward of the run.
    pub(super) fn evaluation(&mut self, text: &str, best: Option<f64>) {
        let Some(line) = evaluations::Line::parse(text) else {
            self.event("unreadable evaluation", &[("line", text.to_owned())]);
            return;
        };
        if !line.is_on_curve() {
            return;
        }
        match &self.output {
            Output::Panel(panel) => {
                self.evaluation = format!("\n{}", evaluation_text(&line, best));
                panel.set_message(format!("{}{}", self.progress, self.evaluation));
            }
            // A shared row has no room, and the next line of metrics would replace the text.
            Output::Row(_) => {}
            Output::Text | Output::Lines => self.line("evaluation", evaluation_facts(&line, best)),
        }
    }

    fn line(&self, event: &str, mut facts: Map<String, Value>) {
        facts.insert("event".into(), event.into());
        if let Some(name) = &self.name {
            facts.insert("run".into(), name.as_str().into());
        }
        facts.insert("elapsed_seconds".into(), self.started.elapsed().as_secs_f64().into());
        eprintln!("{}", Value::Object(facts));
    }

    /// Where a child writes its progress: to this terminal, or to `log` if several runs share it.
    pub(super) fn stderr(&self, log: PathBuf) -> Result<Stdio> {
        Ok(if self.name.is_some() { append(&log)?.into() } else { Stdio::inherit() })
    }

    /// Leaves the panel as it is; later events are lines below it.
    pub(crate) fn finish(&mut self) {
        if let Output::Panel(panel) = &self.output {
            panel.abandon();
            self.output = Output::Text;
        }
    }

    /// Replaces the run's row by its last event.
    pub(crate) fn conclude(mut self, event: &str, facts: &[(&str, String)]) {
        match (&self.output, &self.name) {
            (Output::Row(row), Some(name)) => {
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
    // In joint training one line for each task: rewards of different tasks cannot be compared.
    let tasks = line.tasks.iter().map(|(task, own)| {
        format!(
            "\n{task:<12}      {:>6}   survived {:>5}   head {:>5} m   new environment steps {}",
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

fn evaluation_text(line: &evaluations::Line, best: Option<f64>) -> String {
    let means = &line.evaluation.overall;
    format!(
        "evaluation without noise   normalised reward {:.3}   success {}   after {} steps   best {}",
        means.normalised_reward,
        number(means.success_rate, 2),
        line.environment_steps,
        number(best, 3)
    )
}

fn evaluation_facts(line: &evaluations::Line, best: Option<f64>) -> Map<String, Value> {
    let means = &line.evaluation.overall;
    let facts: [(&str, Value); 6] = [
        ("updates", line.updates.into()),
        ("environment_steps", line.environment_steps.into()),
        ("seconds", line.seconds.into()),
        ("normalised_reward", means.normalised_reward.into()),
        ("success_rate", means.success_rate.into()),
        ("best", best.into()),
    ];
    facts.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_evaluation_is_one_line_of_the_panel_and_numbers_elsewhere() {
        let line = evaluations::Line::parse(&evaluations::example(412_000, &[("walk", 0.5)])).unwrap();
        assert_eq!(
            evaluation_text(&line, Some(0.534)),
            "evaluation without noise   normalised reward 0.500   success 0.75   after 412000 steps   best 0.534"
        );
        assert!(evaluation_text(&line, None).ends_with("best –"));
        let facts = Value::Object(evaluation_facts(&line, Some(0.534)));
        let expected = serde_json::json!({
            "updates": 2, "environment_steps": 412_000, "seconds": 24.72, "normalised_reward": 0.5,
            "success_rate": 0.75, "best": 0.534,
        });
        assert_eq!(facts, expected);
    }

    #[test]
    fn the_panel_shows_the_reward_of_every_task() {
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
    fn panel_and_row_show_the_latents_kl_and_the_reward() {
        let line: Line = serde_json::from_str(r#"{"normalised_reward":0.25,"losses":{"latent_kl":12.345}}"#).unwrap();
        for text in [panel_text(&line), row_text(&line)] {
            assert!(text.contains("latent KL") && text.contains("12.3") && text.contains("0.250"), "{text}");
        }
    }
}
