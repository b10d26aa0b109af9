//! The invariants of ARCHITECTURE.md that follow from the repository's own files and dependencies.

use std::collections::BTreeSet;

use anyhow::{Result, ensure};
use comic_tests::modules::circles;
use comic_tests::repository::{Source, compiled, dependencies, direct_dependencies, folders, root, sources};

const MUJOCO: [&str; 2] = ["mujoco-rs", "mujoco-sys"];
const LIBTORCH: [&str; 2] = ["tch", "torch-sys"];
const GRPC: [&str; 2] = ["tonic", "tonic-prost"];

fn does_not_depend_on(package: &str, forbidden: &[&[&str]]) -> Result<()> {
    let found = dependencies(package)?;
    for name in forbidden.concat() {
        ensure!(!found.contains(name), "{package} depends on {name}");
    }
    Ok(())
}

#[test]
fn proto_depends_on_neither_simulator_nor_libtorch() -> Result<()> {
    does_not_depend_on("comic-proto", &[&MUJOCO, &LIBTORCH])
}

#[test]
fn clips_depend_on_neither_simulator_nor_libtorch_nor_grpc() -> Result<()> {
    does_not_depend_on("comic-clips", &[&MUJOCO, &LIBTORCH, &GRPC])
}

#[test]
fn tasks_depend_on_neither_libtorch_nor_grpc() -> Result<()> {
    does_not_depend_on("comic-tasks", &[&LIBTORCH, &GRPC])
}

/// A wheel of 4 MB, which finds its only native library in another package.
#[test]
fn the_python_package_depends_on_neither_libtorch_nor_grpc() -> Result<()> {
    does_not_depend_on("comic-python", &[&LIBTORCH, &GRPC])
}

#[test]
fn networks_depend_on_neither_simulator_nor_grpc() -> Result<()> {
    does_not_depend_on("comic-networks", &[&MUJOCO, &GRPC])
}

/// Replay needs the unroll's layout from proto, so gRPC is among its indirect dependencies.
#[test]
fn replay_depends_on_neither_simulator_nor_libtorch_and_names_no_grpc() -> Result<()> {
    does_not_depend_on("comic-replay", &[&MUJOCO, &LIBTORCH])?;
    let named = direct_dependencies("comic-replay")?;
    ensure!(GRPC.iter().all(|name| !named.contains(*name)), "comic-replay names {GRPC:?}");
    Ok(())
}

#[test]
fn the_learner_links_no_simulator() -> Result<()> {
    does_not_depend_on("comic-learner", &[&MUJOCO, &["comic-tasks", "comic-actor"]])
}

#[test]
fn actors_link_no_losses() -> Result<()> {
    does_not_depend_on("comic-actor", &[&["comic-learner"]])
}

#[test]
fn xtask_and_setup_link_nothing_that_they_fetch() -> Result<()> {
    does_not_depend_on("xtask", &[&MUJOCO, &LIBTORCH, &GRPC])?;
    does_not_depend_on("comic-setup", &[&MUJOCO, &LIBTORCH, &GRPC])
}

#[test]
fn shipped_programs_contain_no_benchmarks() -> Result<()> {
    ["comic-actor", "comic-learner"].iter().try_for_each(|package| does_not_depend_on(package, &[&["comic-bench"]]))
}

/// Cargo chooses the features of a crate for all packages of one build. If they differed, `cargo build` after `cargo xtask train`
/// would compile most crates again. The packages are those of `xtask/src/workspace.rs`.
#[test]
fn programs_are_built_from_the_same_crates_alone_as_with_the_workspace() -> Result<()> {
    let everything = compiled(&["--workspace", "--exclude", "comic-python"])?;
    for packages in [["comic-learner", "comic-actor"], ["comic-bench", "comic-learner"]] {
        let arguments: Vec<&str> = packages.iter().flat_map(|package| ["--package", package]).collect();
        let other: Vec<String> = compiled(&arguments)?.difference(&everything).cloned().collect();
        ensure!(other.is_empty(), "{packages:?} alone: {other:?}");
    }
    Ok(())
}

/// A folder is one module to its siblings; a module and the modules inside it may need each other. With `--no-capture` this lists every circle in full.
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

/// Whether a file is the root of a library, a program, a test or a benchmark.
fn is_crate_root(path: &str) -> bool {
    let Some((folder, file)) = path.rsplit_once('/') else { return false };
    let folder = folder.rsplit('/').next().unwrap_or_default();
    match folder {
        "src" => ["lib.rs", "main.rs"].contains(&file),
        "bin" | "tests" | "benches" | "examples" | "targets" => true,
        _ => file == "main.rs",
    }
}

/// The files in these folders, at least one of each.
fn within(folders: &[&str]) -> Result<Vec<Source>> {
    let mut sources = sources()?;
    sources.retain(|source| folders.iter().any(|folder| source.path.starts_with(folder)));
    for folder in folders {
        ensure!(sources.iter().any(|source| source.path.starts_with(folder)), "no Rust file is in {folder}");
    }
    Ok(sources)
}

/// The lines that satisfy `holds`, as `path:line`.
fn places(sources: &[Source], holds: impl Fn(&str) -> bool) -> Vec<String> {
    let lines = sources
        .iter()
        .flat_map(|source| source.text.lines().enumerate().map(move |(number, line)| (source, number + 1, line)));
    lines.filter(|(_, _, line)| holds(line)).map(|(source, number, _)| format!("{}:{number}", source.path)).collect()
}

/// Command-line options may name a low level. All other code works with every low level.
#[test]
fn neither_actor_nor_learner_names_a_low_level() -> Result<()> {
    let mut sources = within(&["actor/src/", "learner/src/"])?;
    sources.retain(|source| !source.path.ends_with("/options.rs"));
    let found =
        places(&sources, |line| line.contains(concat!("LowLevel", "Name::")) || line.contains("network.low_level"));
    ensure!(found.is_empty(), "{found:?}");
    Ok(())
}

/// An algorithm is an entry of a list, and its own files.
#[test]
fn one_file_of_each_crate_names_the_algorithms() -> Result<()> {
    for name in ["experiment", "networks", "learner", "actor", "proto", "replay", "tasks"] {
        let sources = within(&[&format!("{name}/src/")])?;
        let found = places(&sources, |line| {
            let variants = line.match_indices("AlgorithmName::").map(|(at, name)| &line[at + name.len()..]);
            // Not `ALL`, and not the variable of a macro.
            variants.filter(|rest| !rest.starts_with("ALL")).any(|rest| rest.starts_with(char::is_uppercase))
        });
        let files: BTreeSet<_> = found.iter().filter_map(|place| place.split(':').next()).collect();
        ensure!(files.len() <= 1, "{files:?}");
    }
    Ok(())
}

/// Everything else works with every algorithm.
#[test]
fn only_its_own_files_read_the_parameters_of_an_algorithm() -> Result<()> {
    let mut sources = sources()?;
    sources.retain(|source| source.path.contains("/src/") && source.path != "experiment/src/document.rs");
    for algorithm in ["vmpo", "svg0"] {
        let words = |line: &str| line.split(|c: char| !c.is_alphanumeric() && c != '_').any(|word| word == algorithm);
        let reads = |line: &str| {
            let destructures = line.contains("Experiment {") && words(line);
            destructures
                || line.contains(&format!("experiment.{algorithm}"))
                || line.contains(&format!("self.{algorithm}."))
        };
        let found = places(&sources, |line| reads(line));
        ensure!(!found.is_empty(), "no file reads the parameters of {algorithm}");
        let others: Vec<_> = found.iter().filter(|place| !place.contains(&format!("/{algorithm}"))).collect();
        ensure!(others.is_empty(), "{others:?}");
    }
    Ok(())
}

#[test]
fn every_channel_is_bounded() -> Result<()> {
    // `concat!` keeps these lines from being found themselves.
    let signs = [concat!("unbounded", "_channel"), concat!("unbounded", "("), concat!("mpsc::", "channel()")];
    let found = places(&sources()?, |line| signs.iter().any(|sign| line.contains(sign)));
    ensure!(found.is_empty(), "unbounded channels: {found:?}");
    Ok(())
}

#[test]
fn only_the_checkpoint_module_touches_the_learners_checkpoints() -> Result<()> {
    let learner = within(&["learner/src/"])?;
    let found = places(&learner, |line| line.contains("join(\"checkpoints\")") || line.contains("fs::rename"));
    ensure!(!found.is_empty(), "no line of learner/src touches the checkpoint directory");
    let others: Vec<_> = found.iter().filter(|place| !place.starts_with("learner/src/checkpoint")).collect();
    ensure!(others.is_empty(), "other modules touch checkpoints: {others:?}");
    Ok(())
}

/// A renamed file must survive a power cut. Set-up needs no such care, since its next run verifies every file.
#[test]
fn files_are_renamed_durably() -> Result<()> {
    let found = places(&sources()?, |line| line.contains(concat!("fs::", "rename(")));
    let others: Vec<_> = found
        .iter()
        .filter(|place| !["learner/src/checkpoint", "setup/src/extract.rs"].iter().any(|at| place.starts_with(at)))
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

/// A test that returns early counts as passed. So a test without its requirement must fail, and `cargo xtask test` says
/// which tests it leaves out. No test reads files outside the repository.
#[test]
fn no_test_passes_without_running() -> Result<()> {
    let signs = [concat!("eprintln!(\"", "skipped"), concat!("../", "shared"), concat!("\"..\", ", "\"shared\"")];
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

/// Each invariant of ARCHITECTURE.md names the file that holds it.
#[test]
fn every_file_that_the_architecture_names_exists() -> Result<()> {
    let text = std::fs::read_to_string(root().join("ARCHITECTURE.md"))?;
    let names = text.split('`').skip(1).step_by(2);
    let paths = names.filter(|name| name.ends_with(".rs") || name.ends_with('/')).filter(|name| name.contains('/'));
    // Beside a path, a file of the same folder or a folder of the same crate stands without the rest.
    let files: Vec<String> = sources()?.into_iter().map(|source| source.path).collect();
    let exists = |path: &str| root().join(path).exists() || files.iter().any(|file| file.contains(&format!("/{path}")));
    let missing: Vec<_> = paths.filter(|path| !exists(path)).collect();
    ensure!(missing.is_empty(), "ARCHITECTURE.md names files that do not exist: {missing:?}");
    Ok(())
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
        // A crate that needs unsafe code has its own copy of the lints, which denies unsafe code instead of forbidding it.
        let copied =
            ["unsafe_code = \"deny\"", "missing_docs", "unwrap_used = \"deny\"", "disallowed_methods = \"deny\""]
                .iter()
                .all(|lint| manifest.contains(lint));
        ensure!(inherited || copied, "{folder}/Cargo.toml lacks the workspace's lints");
    }
    Ok(())
}

/// Foreign functions, processor instructions and the memory of a tensor need unsafe code. Only these files use them.
#[test]
fn unsafe_code_is_in_these_files_only() -> Result<()> {
    const FILES: [&str; 13] = [
        "learner/src/adam/fused.rs",
        "learner/src/device/cuda.rs",
        "learner/src/world/c10d.rs",
        "networks/src/export/onnx/graph.rs",
        "networks/src/linear.rs",
        "networks/src/packed.rs",
        "replay/src/uncached_copy.rs",
        "tasks/src/arenas",
        "tasks/src/gradient/constraints.rs",
        "tasks/src/humanoid/body.rs",
        "tasks/src/silence.rs",
        "tasks/tests/parity/model.rs",
        "tasks/tests/parity/model_arrays.rs",
    ];
    let found = sources()?.into_iter().filter(|source| source.text.contains(concat!("allow(unsafe", "_code")));
    let found: Vec<_> = found.map(|source| source.path).collect();
    let expected = found.len() == FILES.len() && found.iter().zip(FILES).all(|(path, file)| path.starts_with(file));
    ensure!(expected, "{found:?}");
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
