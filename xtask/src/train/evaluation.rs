//! The result of training: the untrained and the trained policy in one table.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Stdio;

use anyhow::{Context, Result, bail};
use comic_setup::Interrupt;

use super::display::Display;
use super::{Job, child};
use crate::evaluations::{ClipEvaluation, Evaluation};
use crate::workspace;

/// The file with the evaluations in a run's directory.
const FILE: &str = "evaluation.json";

/// Evaluates the run's policies without noise and writes the evaluations with the policies' names to `evaluation.json`.
pub(super) fn compare(job: &Job, display: &mut Display, interrupt: &Interrupt) -> Result<Vec<(String, Evaluation)>> {
    let directory = job.path();
    let policies = job.directory.policies();
    if policies.is_empty() {
        bail!("nothing to evaluate: the run in {} ended before its first checkpoint", directory.display());
    }
    let asked_before = interrupt.count();
    let mut evaluations = Vec::new();
    for (name, checkpoint) in policies {
        display.event("evaluating", &[("policy", name.into()), ("checkpoint", checkpoint.display().to_string())]);
        let evaluation = evaluate(&checkpoint, job.episodes, display.stderr(job.directory.log("evaluation"))?);
        if interrupt.count() > asked_before {
            bail!("interrupted during the evaluation; the run is in {}", directory.display());
        }
        evaluations.push((name.to_owned(), evaluation?));
    }
    let path = directory.join(FILE);
    let record: BTreeMap<_, _> = evaluations.iter().cloned().collect();
    fs::write(&path, serde_json::to_vec_pretty(&record)?)
        .with_context(|| format!("cannot write {}", path.display()))?;
    Ok(evaluations)
}

/// The evaluations that [`compare`] wrote for a run, by the policies' names.
pub(crate) fn read(directory: &Path) -> Result<BTreeMap<String, Evaluation>> {
    let path = directory.join(FILE);
    let text = fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_slice(&text).with_context(|| format!("{} is not an evaluation", path.display()))
}

fn evaluate(checkpoint: &Path, episodes: Option<u32>, stderr: Stdio) -> Result<Evaluation> {
    let mut command = child::command(&workspace::program("comic-actor")?);
    command.args(["evaluate", "--deterministic", "--json", "--checkpoint"]).arg(checkpoint);
    if let Some(episodes) = episodes {
        command.arg("--episodes").arg(episodes.to_string());
    }
    let output = command.stdin(Stdio::null()).stderr(stderr).output();
    let output = output.context("cannot start comic-actor")?;
    if !output.status.success() {
        bail!("comic-actor evaluate ended with {}", output.status);
    }
    serde_json::from_slice(&output.stdout)
        .with_context(|| format!("unreadable output of {}", workspace::describe(&command)))
}

/// A block of rows for each clip, a column for each policy.
pub(crate) fn table(columns: &[(String, Evaluation)]) -> String {
    let mut text = String::from("\nEvaluation (policies without noise)\n");
    let Some((_, first)) = columns.first() else { return text };
    // For one clip the overall block would be the same.
    let overall = (first.clips.len() > 1).then_some(&first.overall);
    // For one clip the task's block would be the same.
    let tasks = first.tasks.iter().filter(|_| first.clips.len() > first.tasks.len());
    for clip in first.clips.iter().chain(tasks).chain(overall) {
        let of_clip: Vec<_> = columns.iter().map(|(_, evaluation)| evaluation.of(&clip.clip)).collect();
        text += &format!("\n{:<28}", clip.clip);
        for (name, _) in columns {
            text += &format!("{name:>14}");
        }
        text.push('\n');
        let mut row = |label: &str, value: &dyn Fn(&ClipEvaluation) -> Option<f64>| {
            text += &format!("  {label:<26}");
            for clip in &of_clip {
                text += &clip.and_then(value).map_or_else(|| format!("{:>14}", "–"), |value| format!("{value:>14.3}"));
            }
            text.push('\n');
        };
        row("return", &|clip| Some(clip.return_mean));
        row("episode length", &|clip| Some(clip.length_mean));
        row("normalised reward", &|clip| Some(clip.normalised_reward));
        row("reward per step / most", &|clip| Some(clip.reward_per_step));
        row("fraction survived", &|clip| Some(clip.fraction_survived));
        row("success rate", &|clip| clip.success_rate);
        for measure in clip.measures.keys() {
            row(&format!("{measure}, per episode"), &|clip| clip.measures.get(measure).copied());
        }
        row("position error, mm", &|clip| clip.tracking_error.map(|error| error.position_mm));
        row("the same from the root, mm", &|clip| clip.tracking_error.map(|error| error.local_position_mm));
        row("velocity error, mm/step", &|clip| clip.tracking_error.map(|error| error.velocity_mm_per_step));
        row("head's height, m", &|clip| clip.head_height);
        for term in clip.reward_terms.keys() {
            row(&format!("{term}, per step"), &|clip| clip.reward_terms.get(term).copied());
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of_clip(clip: &str, normalised_reward: f64) -> ClipEvaluation {
        ClipEvaluation {
            clip: clip.into(),
            episodes: 3,
            length_mean: 40.0,
            return_mean: 1.0,
            normalised_reward,
            reward_per_step: 0.5,
            fraction_survived: 0.25,
            success_rate: Some(0.5),
            measures: [("targets".to_owned(), 1.5)].into(),
            tracking_error: None,
            head_height: Some(1.5),
            reward_terms: [("com".to_owned(), 0.01)].into(),
        }
    }

    fn evaluation(clips: &[&str], normalised_reward: f64) -> Evaluation {
        Evaluation {
            deterministic: true,
            clips: clips.iter().map(|clip| of_clip(clip, normalised_reward)).collect(),
            tasks: Vec::new(),
            overall: of_clip("overall", normalised_reward),
        }
    }

    #[test]
    fn the_table_has_a_block_for_each_clip_and_a_column_for_each_policy() {
        let columns = [("untrained", 0.03), ("trained", 0.41)];
        let table = table(&columns.map(|(name, reward)| (name.to_owned(), evaluation(&["CMU_007_01"], reward))));
        assert!(table.contains("CMU_007_01                       untrained       trained\n"), "{table}");
        assert!(table.contains("  normalised reward                  0.030         0.410\n"), "{table}");
        assert!(table.contains("  targets, per episode               1.500         1.500\n"), "{table}");
        assert!(table.contains("  com, per step                      0.010         0.010\n"), "{table}");
        assert!(!table.contains("overall"), "one clip is all clips: {table}");
    }

    #[test]
    fn several_clips_have_an_overall_block() {
        let table = table(&[("trained".to_owned(), evaluation(&["walk", "run"], 0.5))]);
        for block in ["\nwalk ", "\nrun ", "\noverall "] {
            assert!(table.contains(block), "{table}");
        }
    }
}
