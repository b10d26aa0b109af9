//! What a person sees while a run goes on: a panel on a terminal, JSON lines elsewhere.

use std::time::{Duration, Instant};

use comic_experiment::Budget;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::{Map, Value};

use super::metrics::Line;
use crate::progress::on_terminal;

/// The panel, or nothing where no terminal is.
pub(super) struct Display {
    panel: Option<ProgressBar>,
    budget: Budget,
    started: Instant,
}

/// Ticks of the budget's bar.
const TICKS: f64 = 1000.0;

impl Display {
    pub(super) fn new(budget: &Budget) -> Self {
        let panel = on_terminal().then(|| {
            let panel = ProgressBar::with_draw_target(Some(TICKS as u64), ProgressDrawTarget::stderr());
            if let Ok(style) = ProgressStyle::with_template("{msg}\n{elapsed_precise} {wide_bar} {percent:>3} %") {
                panel.set_style(style);
            }
            panel.set_message("waiting for the first batch");
            panel.enable_steady_tick(Duration::from_millis(500));
            panel
        });
        Self { panel, budget: budget.clone(), started: Instant::now() }
    }

    /// Something happened that is worth a line.
    pub(super) fn event(&mut self, event: &str, facts: &[(&str, String)]) {
        match &self.panel {
            Some(panel) => {
                let facts: Vec<_> = facts.iter().map(|(name, value)| format!("{name}: {value}")).collect();
                panel.println(format!("{event}  {}", facts.join(", ")));
            }
            None => {
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
        let share = self.share(&line);
        match &self.panel {
            Some(panel) => {
                panel.set_message(panel_text(&line));
                panel.set_position((share * TICKS) as u64);
            }
            None => {
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
        facts.insert("elapsed_seconds".into(), self.started.elapsed().as_secs_f64().into());
        eprintln!("{}", Value::Object(facts));
    }

    /// Leaves the panel standing as it is.
    pub(super) fn finish(&mut self) {
        if let Some(panel) = self.panel.take() {
            panel.abandon();
        }
    }
}

fn panel_text(line: &Line) -> String {
    let number = |value: Option<f64>, decimals: usize| {
        value.map_or_else(|| "–".to_owned(), |value| format!("{value:.decimals$}"))
    };
    let books = line.books.as_ref().map_or_else(String::new, |books| {
        let dropped: u64 = books.dropped.values().sum();
        format!(
            "\nunrolls produced {}   trained {}   dropped {dropped}   in flight {}",
            books.produced, books.trained, books.in_flight
        )
    });
    format!(
        "environment steps {:>10}   steps/s {:>8}   updates {:>7}   unroll age {:>5}\n\
         reward per step {:>7}   episode length {:>6}   return {:>7}   normalised reward {:>6}   survived {:>5}{books}",
        line.environment_steps,
        number(line.steps_per_second, 0),
        line.updates,
        number(line.unroll_age, 1),
        number(line.reward_per_step, 3),
        number(line.episode_length, 1),
        number(line.episode_return, 2),
        number(line.normalised_reward, 3),
        number(line.fraction_survived, 2),
    )
}
