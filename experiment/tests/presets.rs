//! The presets as a set: what twins share, and that each of them is documented.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

use std::collections::BTreeSet;
use std::path::Path;

use comic_experiment::{AlgorithmName, Experiment, InitialPose, TransferPrior, presets, resolve};

/// Tasks that have a preset with a frozen low level, `transfer-NAME`, and a twin from zero, `NAME`.
const TWINS: [&str; 6] = ["corridor", "go-to-target", "gaps", "walls", "get-up", "ball-catch"];

fn preset(name: &str) -> Experiment {
    resolve(name, &[]).unwrap()
}

/// The fields in which a preset with a frozen low level differs from its twin.
fn differing(name: &str) -> BTreeSet<String> {
    let (zero, transfer) = (preset(name), preset(&format!("transfer-{name}")));
    zero.differences(&transfer).unwrap().into_iter().map(|difference| difference.field).collect()
}

#[test]
fn twins_differ_only_in_the_frozen_low_level_and_in_where_the_policy_begins() {
    for name in TWINS {
        let mut expected = vec!["name", "network.initial_std", "transfer.low_level", "transfer.prior"];
        // Without the derivative getting up from zero has learned nothing. With a low level no weight of it was tried yet.
        expected.push(if name == "get-up" { "vmpo.action_gradient" } else { "network.initial_pose" });
        assert_eq!(differing(name), expected.into_iter().map(str::to_owned).collect(), "{name}");
    }
}

#[test]
fn every_preset_with_the_built_in_low_level_starts_from_the_clips_that_it_was_learned_from() {
    let clips = preset("low-level").clips;
    assert_eq!(clips.len(), 7);
    let transfers = presets::ALL.iter().map(|(name, _)| preset(name)).filter(|preset| preset.transfer.is_on());
    let names: Vec<String> = transfers
        .map(|transfer| {
            assert_eq!(
                (transfer.transfer.low_level.as_str(), &transfer.clips),
                ("builtin", &clips),
                "{}",
                transfer.name
            );
            transfer.name
        })
        .collect();
    let twins = TWINS.map(|name| format!("transfer-{name}"));
    let others = ["transfer-corridor-svg0", "transfer-paper"].map(str::to_owned);
    let expected: BTreeSet<String> = twins.into_iter().chain(others).collect();
    assert_eq!(names.into_iter().collect::<BTreeSet<_>>(), expected);
}

#[test]
fn the_papers_transfer_is_the_defaults_but_for_the_low_level_and_the_clips() {
    let paper = preset("transfer-paper");
    let fields = Experiment::default().differences(&paper).unwrap().into_iter().map(|difference| difference.field);
    let changed: BTreeSet<String> = fields.filter(|field| !field.starts_with("clips")).collect();
    let expected = ["algorithm", "name", "task", "transfer.low_level"].map(str::to_owned);
    assert_eq!(changed, expected.into_iter().collect());
    assert_eq!((paper.algorithm, paper.transfer.prior), (AlgorithmName::Svg0, TransferPrior::Standard));
}

/// SVG(0) begins where the algorithm's own fields say, whatever the twin does.
#[test]
fn the_corridor_for_svg0_is_the_corridor_for_vmpo() {
    let (vmpo, svg0) = (preset("transfer-corridor"), preset("transfer-corridor-svg0"));
    assert_eq!((&svg0.gaps, svg0.task, &svg0.clips), (&vmpo.gaps, vmpo.task, &vmpo.clips));
    assert_eq!((&svg0.transfer, &svg0.budget), (&vmpo.transfer, &vmpo.budget));
    assert_eq!(svg0.network.normaliser_steps, vmpo.network.normaliser_steps);
    assert_eq!(svg0.network.initial_pose, InitialPose::MidRange);
}

#[test]
fn every_preset_is_in_the_list_of_the_documentation() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/experiments.md");
    let text = std::fs::read_to_string(page).unwrap();
    let list = text.split("## Presets").nth(1).unwrap().split("\n## ").next().unwrap();
    let missing: Vec<_> =
        presets::ALL.iter().map(|(name, _)| name).filter(|name| !list.contains(&format!("`{name}`"))).collect();
    assert!(missing.is_empty(), "docs/experiments.md lacks {missing:?}");
}

/// docs/capacity.md, "How old an unroll may be", has the measured ages.
#[test]
fn every_preset_limits_the_age_of_unrolls_as_docs_capacity_says() {
    for (name, _) in presets::ALL {
        let preset = preset(name);
        let (updates, versions) = match (preset.algorithm, preset.vmpo.target_period) {
            (AlgorithmName::Vmpo, 1) => (32, 32),
            (AlgorithmName::Vmpo, 100) => (400, 4),
            (AlgorithmName::Svg0, _) => (400, u64::MAX),
            other => panic!("{name}: no age was measured for {other:?}"),
        };
        assert_eq!((preset.unroll.max_staleness, preset.max_versions_late()), (updates, versions), "{name}");
    }
}
