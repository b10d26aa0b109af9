//! `cargo xtask fuzz`: random bytes for everything that reads bytes from outside, guided by the code that they reach.
//!
//! libFuzzer guides. rustc's own options compile its counters in, so the stable toolchain is enough. The crates are built
//! for this in a directory of their own. Seeds are valid files of the present formats, which each target writes.
//! `tests/fuzz/corpus` has a few inputs that reach more; they are part of the repository. Inputs that reach new code are kept
//! in `target/fuzz/corpus`, where the next run starts.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};
use clap::ValueEnum as _;

use crate::setup;
use crate::workspace::{cargo, root, run};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// The targets [default: all]
    #[arg(value_enum)]
    targets: Vec<Target>,
    /// Minutes for each target
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    minutes: u64,
    /// Do not fuzz: add the kept inputs that reach new code, but are not large, to the corpus of the repository
    #[arg(long)]
    merge: bool,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum Target {
    /// Messages of unrolls
    Unroll,
    /// Pieces of parameters, and the policy that they make
    Parameters,
    /// Experiments and overrides
    Experiment,
    /// Checkpoints with one random part
    Checkpoint,
    /// Motion capture: HDF5, ASF and AMC
    Clips,
    /// Saved tables of a replay
    Table,
    /// Messages in the frames of a connection
    Frames,
    /// Exported policies and low levels
    Exported,
}

/// Coverage counters for libFuzzer: what `-fsanitize=fuzzer-no-link` does in clang.
const COUNTERS: [&str; 7] = [
    "-Cpasses=sancov-module",
    "-Cllvm-args=-sanitizer-coverage-level=4",
    "-Cllvm-args=-sanitizer-coverage-inline-8bit-counters",
    "-Cllvm-args=-sanitizer-coverage-pc-table",
    "-Cllvm-args=-sanitizer-coverage-trace-compares",
    "-Ccodegen-units=1",
    "--cfg=fuzzing",
];
const HOST: &str = "x86_64-unknown-linux-gnu";
/// The limit of resident memory. libtorch alone needs a few hundred.
const MEGABYTES: usize = 2048;
/// The longest input that `--merge` adds to the repository, bytes.
const LONGEST_COMMITTED: u64 = 2048;
/// An input takes less than a second; the machine may be busy.
const SECONDS_OF_AN_INPUT: usize = 20;

/// Builds the targets and runs each for its time. The first finding ends the run.
pub(crate) fn fuzz(options: &Options) -> Result<()> {
    setup::run(&setup::Options::default())?;
    let directory = root().join("target/fuzz");
    let mut build = cargo();
    // Naming the target keeps the counters out of build scripts and macros.
    build.args(["build", "--release", "--manifest-path", "tests/fuzz/Cargo.toml", "--target", HOST, "--target-dir"]);
    run(build.arg(&directory).env("RUSTFLAGS", COUNTERS.join(" ")))?;
    let all = Target::value_variants();
    let chosen = if options.targets.is_empty() { all } else { &options.targets };
    for target in chosen {
        let name = target.to_possible_value().context("a target without a name")?.get_name().to_owned();
        let program = directory.join(HOST).join("release").join(&name);
        let made = |kind: &str| -> Result<PathBuf> {
            let path = directory.join(kind).join(&name);
            fs::create_dir_all(&path).with_context(|| format!("cannot make {}", path.display()))?;
            Ok(path)
        };
        let (seeds, corpus, findings) = (made("seeds")?, made("corpus")?, made("findings")?);
        let committed = root().join("tests/fuzz/corpus").join(&name);
        fs::create_dir_all(&committed).with_context(|| format!("cannot make {}", committed.display()))?;
        run(Command::new(&program).arg("-runs=0").env("COMIC_FUZZ_SEEDS", &seeds))?;
        if options.merge {
            let small = made("small")?;
            for folder in [&seeds, &corpus] {
                copy_small(folder, &small)?;
            }
            let mut merge = Command::new(&program);
            // By the code that an input reaches, not by how often.
            merge.args(["-merge=1", "-use_counters=0"]).args([&committed, &small]);
            run(merge.env("OMP_NUM_THREADS", "1").current_dir(root()))?;
            continue;
        }
        eprintln!("fuzzing {name} for {} minutes", options.minutes);
        let mut fuzzer = Command::new(&program);
        fuzzer.args([&corpus, &seeds, &committed]).args([
            format!("-max_total_time={}", 60 * options.minutes),
            format!("-rss_limit_mb={MEGABYTES}"),
            format!("-timeout={SECONDS_OF_AN_INPUT}"),
            format!("-artifact_prefix={}/", findings.display()),
            "-print_final_stats=1".into(),
        ]);
        // One thread, so that an input always has the same effect.
        run(fuzzer.env("OMP_NUM_THREADS", "1").current_dir(root())).with_context(|| {
            let (program, findings) = (program.display(), findings.display());
            format!("{name}: the findings are in {findings}; `{program} {findings}/FILE` runs one of them")
        })?;
    }
    Ok(())
}

/// Copies the files that the repository can hold.
fn copy_small(from: &Path, to: &Path) -> Result<()> {
    for entry in fs::read_dir(from).with_context(|| format!("cannot read {}", from.display()))? {
        let entry = entry?;
        if entry.metadata()?.len() <= LONGEST_COMMITTED {
            fs::copy(entry.path(), to.join(entry.file_name()))?;
        }
    }
    Ok(())
}
