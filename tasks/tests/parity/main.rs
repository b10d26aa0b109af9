//! Compares the tasks that dm_control publishes with its own rollouts.
//!
//! `COMIC_GOLDEN_DIR` names a folder of rollouts: `tracking_*.npz`, `tracking2019_*.npz` and the `.h5` files of their
//! clips, `go_to_target_*.npz`, `gaps*_rollout.npz` and `walls*_rollout.npz` with the `*_arena.json` of the same name.
//! The default is `tests/fixtures/golden`. The tests compare every number of every row.

#![allow(clippy::unwrap_used, reason = "a helper of tests may fail like a test")]

mod first_pose;
mod model;
mod model_arrays;
mod npz;
mod recording;
mod rules;
mod tracking;
mod vision;

use npz::{Array, Values};
use recording::{Rollout, folder, rollouts};

/// A kind of rollout: the prefix and suffix of its files' names, and the function that compares one.
struct Kind {
    prefix: &'static str,
    suffix: &'static str,
    compare: fn(&Rollout) -> Result<(), String>,
}

const KINDS: [Kind; 5] = [
    Kind { prefix: "tracking_", suffix: "", compare: tracking::compare },
    Kind { prefix: "tracking2019_", suffix: "", compare: tracking::compare },
    Kind { prefix: "go_to_target_", suffix: "", compare: rules::compare_go_to_target },
    Kind { prefix: "gaps", suffix: "_rollout", compare: rules::compare_corridor },
    Kind { prefix: "walls", suffix: "_rollout", compare: rules::compare_corridor },
];

fn compare(rollout: &Rollout) -> Result<(), String> {
    let kind = KINDS.iter().find(|kind| rollout.file.starts_with(kind.prefix)).unwrap();
    (kind.compare)(rollout)
}

fn all_rollouts() -> Vec<Rollout> {
    let folder = folder();
    let mut all = Vec::new();
    for Kind { prefix, suffix, .. } in KINDS {
        let found = rollouts(&folder, (prefix, suffix)).unwrap();
        if found.is_empty() {
            assert!(std::env::var_os("COMIC_GOLDEN_DIR").is_some(), "{}: no {prefix}*{suffix}.npz", folder.display());
            eprintln!("{} has no rollouts {prefix}*{suffix}.npz: they are not compared", folder.display());
        }
        all.extend(found);
    }
    assert!(
        !all.is_empty(),
        "{}: no rollouts at all; set COMIC_GOLDEN_DIR to a folder that has some",
        folder.display()
    );
    all
}

#[test]
fn parity_of_every_rollout() {
    let all = all_rollouts();
    let differences: Vec<String> = all.iter().filter_map(|rollout| compare(rollout).err()).collect();
    assert!(
        differences.is_empty(),
        "{} of {} rollouts differ:\n{}",
        differences.len(),
        all.len(),
        differences.join("\n")
    );
    eprintln!("{} rollouts equal, {} rows", all.len(), all.iter().map(Rollout::rows).sum::<usize>());
}

/// The smallest change that a comparison must detect: one unit in the last place if it is exact, else 1e-9.
fn altered(name: &str, value: f64) -> f64 {
    match name {
        _ if value.is_nan() => 0.25,
        "qpos" | "qvel" | "act" | "time" | "qacc_warmstart_after_reset" => value.next_up(),
        "clip" | "start" | "ncon" | "mocap_step" | "truncate" | "end_mocap" | "step_type" | "discount" | "counter"
        | "disallowed" => value + 1.0,
        // Controls are clipped to their range, so the change is towards 0.
        "actions" => value * 0.5 + if value == 0.0 { 0.5 } else { 0.0 },
        _ => value + 1e-9,
    }
}

fn alter(rollout: &Rollout, name: &str, index: usize) -> Rollout {
    let mut copy = rollout.clone();
    if let Some(Array { values: Values::Numbers(numbers), .. }) = copy.arrays.get_mut(name) {
        numbers[index] = altered(name, numbers[index]);
    }
    copy
}

#[test]
fn parity_fails_when_any_quantity_is_altered() {
    let all = all_rollouts();
    for kind in KINDS {
        let Some(rollout) = all.iter().find(|rollout| rollout.file.starts_with(kind.prefix)) else { continue };
        let rollout = rollout.clone().head(3);
        compare(&rollout).unwrap();
        let names: Vec<String> = rollout.arrays.keys().cloned().collect();
        for name in &names {
            let length = match &rollout.arrays[name].values {
                Values::Numbers(numbers) => numbers.len(),
                Values::Text(_) => continue,
            };
            for index in [0, length / 2, length.saturating_sub(1)].into_iter().take(length) {
                // At a reset these two flags still belong to the previous episode.
                if index == 0 && ["truncate", "end_mocap"].contains(&name.as_str()) {
                    continue;
                }
                let outcome = compare(&alter(&rollout, name, index));
                assert!(outcome.is_err(), "{}: a change of {name}[{index}] was not detected", rollout.file);
            }
        }
    }
}

#[test]
fn parity_fails_when_any_observation_is_altered() {
    for rollout in all_rollouts().into_iter().take(1) {
        let rollout = rollout.head(1);
        let layout = rollout.layout().unwrap();
        let width: usize = layout.iter().map(|(_, size)| size).sum();
        let mut place = 0;
        for (name, size) in layout {
            if size > 0 {
                for row in 0..2 {
                    let difference = compare(&alter(&rollout, "obs", row * width + place)).unwrap_err();
                    assert!(difference.contains(&format!("row {row}: {name}[0]")), "{difference}");
                }
            }
            place += size;
        }
    }
}

#[test]
fn parity_fails_when_names_are_altered() {
    let all = all_rollouts();
    for kind in KINDS {
        let Some(rollout) = all.iter().find(|rollout| rollout.file.starts_with(kind.prefix)) else { continue };
        let rollout = rollout.clone().head(1);
        compare(&rollout).unwrap();
        // Each rollout names its observations; one of tracking also its clip and its reward terms.
        let is_text = |name: &&String| matches!(rollout.arrays[*name].values, Values::Text(_));
        let names: Vec<&String> = rollout.arrays.keys().filter(is_text).collect();
        assert!(!names.is_empty(), "{}: no names", rollout.file);
        for name in names {
            let mut copy = rollout.clone();
            let Some(Array { values: Values::Text(text), .. }) = copy.arrays.get_mut(name) else { unreachable!() };
            text[0] = renamed(&text[0]);
            assert!(compare(&copy).is_err(), "{}: a change of {name} was not detected", rollout.file);
        }
    }
}

/// The text with its first letter in the other case.
fn renamed(text: &str) -> String {
    let place = text.find(|letter: char| letter.is_ascii_alphabetic()).unwrap();
    let letter = text[place..=place].chars().next().unwrap();
    let other = if letter.is_ascii_uppercase() { letter.to_ascii_lowercase() } else { letter.to_ascii_uppercase() };
    format!("{}{other}{}", &text[..place], &text[place + 1..])
}
