//! `comic-learner sizes`: how many parameters the networks of the presets have.

use std::collections::BTreeMap;

use comic_experiment::{Experiment, TaskSpec};
use tch::Device;

use crate::algorithm::Parts;
use crate::algorithms;
use crate::document::DocumentArguments;
use crate::error::{Error, Result};
use crate::world::World;

/// The paper's presets.
const PRESETS: [&str; 6] =
    ["tracking-mlp", "tracking-lstm", "tracking-mixture", "tracking-product", "joint-get-up", "joint-ball"];

/// The numbers of trained parameters of the parts `encoder`, `low level` and `value`, each summed over all tasks.
///
/// # Errors
/// When the experiment's networks cannot be built.
pub fn count(experiment: &Experiment) -> Result<BTreeMap<&'static str, usize>> {
    let spec = TaskSpec::new(experiment, vec!["clip".into()])
        .map_err(|name| Error::Defect(format!("no observation `{name}`")))?;
    let pose = vec![0.0; spec.action];
    let learner = algorithms::learner(Parts {
        experiment,
        spec: &spec,
        pose: &pose,
        device: Device::Cpu,
        world: &World::alone(),
    })?;
    let mut counts = BTreeMap::new();
    for (name, count) in learner.parameter_counts() {
        let part = match name.split('.').collect::<Vec<_>>()[..] {
            ["policy", "low_level", ..] => "low level",
            ["policy", ..] => "encoder",
            _ => "value",
        };
        *counts.entry(part).or_default() += count;
    }
    Ok(counts)
}

/// The table of the named experiment, or of the paper's presets, as Markdown.
///
/// # Errors
/// When there is no such experiment, or its networks cannot be built.
pub fn table(document: &DocumentArguments) -> Result<String> {
    let mut table =
        String::from("| experiment | encoder | low level | value | all |\n| --- | --- | --- | --- | --- |\n");
    let named = document.preset.as_deref();
    for preset in named.as_ref().map_or(&PRESETS[..], std::slice::from_ref) {
        let experiment = document.resolve_preset(preset)?;
        let counts = count(&experiment)?;
        let of = |part: &str| counts.get(part).copied().unwrap_or(0);
        let row = [of("encoder"), of("low level"), of("value"), counts.values().sum()].map(thousands).join(" | ");
        table.push_str(&format!("| {} | {row} |\n", experiment.name));
    }
    Ok(table)
}

/// With a comma every three digits.
fn thousands(number: usize) -> String {
    let digits = number.to_string();
    let groups: Vec<&str> =
        digits.as_bytes().rchunks(3).rev().filter_map(|group| std::str::from_utf8(group).ok()).collect();
    groups.join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_are_grouped_by_thousands() {
        assert_eq!([7, 1_000, 1_234_567].map(thousands), ["7", "1,000", "1,234,567"]);
    }

    #[test]
    fn the_counts_of_the_mlp_follow_from_its_layers() {
        let experiment = comic_experiment::resolve("tracking-mlp", &[]).unwrap();
        let counts = count(&experiment).unwrap();
        let layer = |input: usize, output: usize| (input + 1) * output;
        let norm = 2 * 1024;
        // s 205, z 60, a 56; mean and deviation.
        assert_eq!(counts["low level"], layer(205 + 60, 1024) + norm + layer(1024, 1024) + layer(1024, 2 * 56));
        let x = TaskSpec::new(&experiment, Vec::new()).unwrap().task;
        let input = x + 205 + 60;
        let encoder = layer(input, 1024) + norm + layer(1024, 1024) + layer(1024, 120) + input * 120;
        assert_eq!(counts["encoder"], encoder);
    }

    #[test]
    fn joint_training_shares_the_low_level_and_adds_the_rest() {
        let of = |preset: &str| count(&comic_experiment::resolve(preset, &[]).unwrap()).unwrap();
        let (alone, joint) = (of("tracking-mlp"), of("joint-get-up"));
        assert_eq!(alone["low level"], joint["low level"]);
        assert!(joint["encoder"] > alone["encoder"] && joint["value"] > alone["value"]);
    }
}
