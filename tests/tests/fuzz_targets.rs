//! Every fuzz target is run by `cargo xtask fuzz` and every night, and begins with inputs of its own.

use std::collections::BTreeSet;
use std::fs;

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;
use serde_yaml_ng::Value;

/// The files or folders of a folder of `tests/fuzz`, without what follows a dot.
fn names(folder: &str) -> Result<BTreeSet<String>> {
    let path = root().join("tests/fuzz").join(folder);
    let entries = fs::read_dir(&path).with_context(|| path.display().to_string())?;
    entries.map(|entry| Ok(entry?.file_name().to_string_lossy().split('.').next().unwrap_or_default().into())).collect()
}

#[test]
fn each_target_is_built_has_a_corpus_and_is_fuzzed_every_night() -> Result<()> {
    let targets = names("targets")?;
    ensure!(targets.len() >= 8, "{targets:?}");
    let manifest: toml::Table = fs::read_to_string(root().join("tests/fuzz/Cargo.toml"))?.parse()?;
    let programs = manifest["bin"].as_array().context("no programs")?;
    let programs: BTreeSet<_> = programs.iter().filter_map(|program| Some(program["name"].as_str()?.into())).collect();
    ensure!(programs == targets, "Cargo.toml builds {programs:?}");
    let corpus = names("corpus")?;
    ensure!(corpus == targets, "there is a corpus of {corpus:?}");
    for target in &targets {
        let inputs = fs::read_dir(root().join("tests/fuzz/corpus").join(target))?;
        let sizes = inputs.map(|input| Ok(input?.metadata()?.len())).collect::<Result<Vec<_>>>()?;
        ensure!(!sizes.is_empty() && sizes.iter().sum::<u64>() < 256 * 1024, "{target}: {} inputs", sizes.len());
    }
    let workflow: Value = serde_yaml_ng::from_str(&fs::read_to_string(root().join(".github/workflows/fuzz.yml"))?)?;
    let nightly = workflow["jobs"]["fuzz"]["strategy"]["matrix"]["target"].as_sequence().context("no matrix")?;
    let nightly: BTreeSet<_> = nightly.iter().filter_map(|target| Some(target.as_str()?.to_owned())).collect();
    ensure!(nightly == targets, "the workflow fuzzes {nightly:?}");
    Ok(())
}
