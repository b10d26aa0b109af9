//! The invariants of ARCHITECTURE.md that can be read off the repository itself.

use anyhow::{Result, ensure};
use comic_tests::modules::circles;
use comic_tests::repository::{Source, dependencies, direct_dependencies, folders, root, sources};

const MUJOCO: [&str; 2] = ["mujoco-rs", "mujoco-sys"];
const LIBTORCH: [&str; 2] = ["tch", "torch-sys"];
const GRPC: [&str; 2] = ["tonic", "tonic-prost"];

fn knows_nothing_of(package: &str, forbidden: &[&[&str]]) -> Result<()> {
    let found = dependencies(package)?;
    for name in forbidden.concat() {
        ensure!(!found.contains(name), "{package} is built from {name}");
    }
    Ok(())
}

#[test]
fn the_wire_knows_neither_simulator_nor_libtorch() -> Result<()> {
    knows_nothing_of("comic-proto", &[&MUJOCO, &LIBTORCH])
}

#[test]
fn clips_know_neither_simulator_nor_libtorch_nor_grpc() -> Result<()> {
    knows_nothing_of("comic-clips", &[&MUJOCO, &LIBTORCH, &GRPC])
}

#[test]
fn tasks_know_neither_libtorch_nor_grpc() -> Result<()> {
    knows_nothing_of("comic-tasks", &[&LIBTORCH, &GRPC])
}

#[test]
fn networks_know_neither_simulator_nor_grpc() -> Result<()> {
    knows_nothing_of("comic-networks", &[&MUJOCO, &GRPC])
}

/// It shares the unroll's layout with the wire's crate, so gRPC is beneath it; it calls none of it.
#[test]
fn replay_knows_neither_simulator_nor_libtorch_and_calls_no_grpc() -> Result<()> {
    knows_nothing_of("comic-replay", &[&MUJOCO, &LIBTORCH])?;
    let named = direct_dependencies("comic-replay")?;
    ensure!(GRPC.iter().all(|name| !named.contains(*name)), "comic-replay names {GRPC:?}");
    Ok(())
}

#[test]
fn the_learner_links_no_simulator() -> Result<()> {
    knows_nothing_of("comic-learner", &[&MUJOCO, &["comic-tasks", "comic-actor"]])
}

#[test]
fn actors_know_no_losses() -> Result<()> {
    knows_nothing_of("comic-actor", &[&["comic-learner"]])
}

#[test]
fn set_up_needs_nothing_of_what_it_sets_up() -> Result<()> {
    knows_nothing_of("xtask", &[&MUJOCO, &LIBTORCH, &GRPC])
}

/// A module and the modules inside it may need each other. With `--no-capture` this lists every circle in full.
#[test]
fn no_modules_import_each_other_in_a_circle() -> Result<()> {
    let sources = sources()?;
    let files = sources.iter().map(|source| (source.path.as_str(), source.text.as_str())).collect();
    let mut found = Vec::new();
    for root in sources.iter().filter(|source| is_crate_root(&source.path)) {
        for circle in circles(&root.path, &files)? {
            println!("{}: {circle}all of them:", root.path);
            circle.edges.iter().for_each(|(from, to, place)| println!("  {from} -> {to} ({place})"));
            found.push(format!("{}: {circle}", root.path));
        }
    }
    ensure!(found.is_empty(), "{} circles\n{}", found.len(), found.join("\n"));
    Ok(())
}

/// A library, a program, a test or a benchmark.
fn is_crate_root(path: &str) -> bool {
    let Some((folder, file)) = path.rsplit_once('/') else { return false };
    let folder = folder.rsplit('/').next().unwrap_or_default();
    match folder {
        "src" => ["lib.rs", "main.rs"].contains(&file),
        "bin" | "tests" | "benches" | "examples" | "targets" => true,
        _ => file == "main.rs",
    }
}

/// Files in which `holds` finds a line, as `path:line`.
fn places(sources: &[Source], holds: impl Fn(&str) -> bool) -> Vec<String> {
    let lines = sources
        .iter()
        .flat_map(|source| source.text.lines().enumerate().map(move |(number, line)| (source, number + 1, line)));
    lines.filter(|(_, _, line)| holds(line)).map(|(source, number, _)| format!("{}:{number}", source.path)).collect()
}

/// Benchmarks name their subject; whatever acts or learns takes the low level as it comes.
#[test]
fn neither_actor_nor_learner_asks_which_low_level_acts() -> Result<()> {
    let mut sources = sources()?;
    sources.retain(|source| ["actor/src/", "learner/src/"].iter().any(|crate_| source.path.starts_with(crate_)));
    ensure!(!sources.is_empty(), "the crates are not where this test looks for them");
    sources.retain(|source| !source.path.contains("/bench"));
    let found = places(&sources, |line| line.contains(concat!("LowLevel", "Name::")) || line.contains(".low_level"));
    let found: Vec<_> = found.into_iter().filter(|place| !place.starts_with("learner/src/options.rs")).collect();
    ensure!(found.is_empty(), "{found:?}");
    Ok(())
}

#[test]
fn every_channel_is_bounded() -> Result<()> {
    // Put together here so that this file is not found itself.
    let signs = [concat!("unbounded", "_channel"), concat!("unbounded", "("), concat!("mpsc::", "channel()")];
    let found = places(&sources()?, |line| signs.iter().any(|sign| line.contains(sign)));
    ensure!(found.is_empty(), "unbounded channels: {found:?}");
    Ok(())
}

#[test]
fn only_the_checkpoint_module_touches_the_learners_checkpoints() -> Result<()> {
    let learner: Vec<Source> =
        sources()?.into_iter().filter(|source| source.path.starts_with("learner/src/")).collect();
    let found = places(&learner, |line| line.contains("join(\"checkpoints\")") || line.contains("fs::rename"));
    ensure!(!found.is_empty(), "the checkpoint module is not where this test looks for it");
    let others: Vec<_> = found.iter().filter(|place| !place.starts_with("learner/src/checkpoint")).collect();
    ensure!(others.is_empty(), "other modules touch checkpoints: {others:?}");
    Ok(())
}

/// Set-up moves what a later run verifies again; everything else that is renamed must survive a power cut.
#[test]
fn files_are_renamed_durably() -> Result<()> {
    let found = places(&sources()?, |line| line.contains(concat!("fs::", "rename(")));
    let others: Vec<_> = found
        .iter()
        .filter(|place| {
            !["learner/src/checkpoint", "deploy/setup/src/extract.rs"].iter().any(|at| place.starts_with(at))
        })
        .collect();
    ensure!(others.is_empty(), "renames elsewhere: {others:?}");
    Ok(())
}

#[test]
fn no_test_is_ignored_and_nothing_is_left_for_later() -> Result<()> {
    let signs = [
        concat!("#[ig", "nore"),
        concat!("TO", "DO"),
        concat!("FIX", "ME"),
        concat!("todo", "!("),
        concat!("unimplemented", "!("),
    ];
    let found = places(&sources()?, |line| signs.iter().any(|sign| line.contains(sign)));
    ensure!(found.is_empty(), "{found:?}");
    Ok(())
}

/// A test without what it needs fails, and `cargo xtask test` says which tests it leaves out: a test that returns early
/// would count as passed. Files outside the repository are not needed at all.
#[test]
fn no_test_passes_without_running() -> Result<()> {
    let signs = [concat!("\"", "skipped"), concat!("../", "shared"), concat!("\"", "shared\"")];
    let found = places(&sources()?, |line| signs.iter().any(|sign| line.contains(sign)));
    ensure!(found.is_empty(), "{found:?}");
    let early: Vec<_> = sources()?.iter().flat_map(early_returns).collect();
    ensure!(early.is_empty(), "tests that return before their end: {early:?}");
    Ok(())
}

/// The tests of a file that return without a value, as `path: name`.
fn early_returns(source: &Source) -> Vec<String> {
    let mut found = Vec::new();
    let mut lines = source.text.lines();
    while let Some(line) = lines.next() {
        if !["#[test]", "#[tokio::test"].iter().any(|sign| line.trim_start().starts_with(sign)) {
            continue;
        }
        let Some(head) = lines.find(|line| line.contains("fn ")) else { break };
        let end = format!("{}}}", &head[..head.len() - head.trim_start().len()]);
        let mut body = lines.by_ref().take_while(|line| *line != end);
        if body.any(|line| line.trim() == "return;" || line.contains("else { return };")) {
            found.push(format!("{}: {}", source.path, head.trim()));
        }
    }
    found
}

#[test]
fn a_file_is_one_concept_long() -> Result<()> {
    let long = sources()?.into_iter().map(|source| (source.text.lines().count(), source.path));
    let long: Vec<_> = long.filter(|(lines, _)| *lines > 450).collect();
    ensure!(long.is_empty(), "over 450 lines: {long:?}");
    Ok(())
}

#[test]
fn every_crate_keeps_the_workspaces_lints() -> Result<()> {
    for folder in folders()? {
        let manifest = std::fs::read_to_string(root().join(&folder).join("Cargo.toml"))?;
        let inherited = manifest.contains("[lints]\nworkspace = true");
        // Where unsafe code cannot be done without, a crate has its own copy, in which it is denied, not forbidden.
        let copied =
            ["unsafe_code = \"deny\"", "missing_docs", "unwrap_used = \"deny\"", "disallowed_methods = \"deny\""]
                .iter()
                .all(|lint| manifest.contains(lint));
        ensure!(inherited || copied, "{folder}/Cargo.toml keeps no lints");
    }
    Ok(())
}

/// Where foreign functions or the processor's own instructions take it, and nowhere else.
#[test]
fn these_files_alone_are_allowed_what_the_compiler_cannot_check() -> Result<()> {
    const FILES: [&str; 8] = [
        "learner/src/device/cuda.rs",
        "replay/src/streaming.rs",
        "tasks/src/arenas.rs",
        "tasks/src/humanoid/body.rs",
        "tasks/src/silence.rs",
        "tasks/tests/parity/model.rs",
        "tasks/tests/parity/model_arrays.rs",
        // Where the word is a crate's lint, above.
        "tests/tests/architecture.rs",
    ];
    let found = sources()?.into_iter().filter(|source| source.text.contains(concat!("unsafe", "_code")));
    let mut found: Vec<_> = found.map(|source| source.path).collect();
    found.sort();
    ensure!(found == FILES, "{found:?}");
    Ok(())
}

#[test]
fn every_unsafe_block_says_why_it_is_sound() -> Result<()> {
    let keyword = concat!("unsafe", " ");
    for source in sources()? {
        let lines: Vec<&str> = source.text.lines().collect();
        for (number, line) in lines.iter().enumerate() {
            let code = line.split("//").next().unwrap_or_default();
            let opens = ["{", "impl "].iter().any(|next| code.contains(&format!("{keyword}{next}")));
            let said = lines[number.saturating_sub(10)..=number].iter().any(|line| line.contains("SAFETY"));
            ensure!(!opens || said, "{}:{}: no SAFETY comment", source.path, number + 1);
        }
    }
    Ok(())
}
