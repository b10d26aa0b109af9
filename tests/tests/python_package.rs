//! The Python package: its own tests (`python/tests`), its types, and its wheel in an environment that has nothing else.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;
use comic_tests::system::{program, python};

/// Runs a program of the tests' Python environment in `python/`, with the programs that were built.
fn run(name: &str, directory: &str, arguments: &[&str]) -> Result<()> {
    let programs = program("comic-learner")?.with_file_name("");
    let mut command = Command::new(python()?.with_file_name(name));
    // The package's own folder is not on the path of modules here: the installed wheel is tested.
    command.args(arguments).current_dir(root().join(directory)).env("COMIC_BIN", programs);
    succeeds(&mut command)
}

fn succeeds(command: &mut Command) -> Result<()> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    ensure!(output.status.success(), "{command:?}\n{}\n{}", text(&output.stdout), text(&output.stderr));
    Ok(())
}

fn pytest(file: &str, marks: &str) -> Result<()> {
    run("pytest", "python/tests", &["-m", marks, file])
}

#[test]
fn environments_follow_gymnasiums_rules_and_have_dm_controls_numbers() -> Result<()> {
    pytest("test_environments.py", "not full")
}

#[test]
fn vectors_equal_single_environments() -> Result<()> {
    pytest("test_vectors.py", "not full")
}

#[test]
fn derivatives_equal_finite_differences() -> Result<()> {
    pytest("test_gradients.py", "not full")
}

#[test]
fn the_adapter_has_dm_controls_names() -> Result<()> {
    pytest("test_dm.py", "not full")
}

#[test]
fn policies_act_and_runs_are_read() -> Result<()> {
    pytest("test_policies.py", "not full")
}

#[test]
fn clips_and_experiments_are_read() -> Result<()> {
    pytest("test_clips.py", "not full")
}

#[test]
fn a_run_is_copied_to_a_tracker_once() -> Result<()> {
    pytest("test_track.py", "not full")
}

#[test]
fn a_search_reads_the_curves_of_its_runs() -> Result<()> {
    pytest("test_sweep.py", "not full")
}

#[test]
fn cards_say_what_a_file_holds_and_hostile_files_are_refused() -> Result<()> {
    pytest("test_card.py", "not full")
}

#[test]
fn the_hub_says_what_it_needs() -> Result<()> {
    pytest("test_hub.py", "not full")
}

#[test]
fn opengl_draws_pictures_and_camera_images() -> Result<()> {
    pytest("test_pictures.py", "not full")
}

#[test]
fn types_are_consistent() -> Result<()> {
    run("mypy", "python", &["--cache-dir", "../target/mypy"])
}

#[test]
fn the_stub_has_what_the_native_module_has() -> Result<()> {
    run("stubtest", "python/tests", &["comic._native", "--ignore-disjoint-bases"])
}

#[test]
fn a_wheel_works_in_an_empty_environment() -> Result<()> {
    let directory = tempfile::tempdir()?;
    succeeds(Command::new("python3").args(["-m", "venv"]).arg(directory.path().join("venv")))?;
    let python = directory.path().join("venv/bin/python");
    succeeds(Command::new(&python).args(["-m", "pip", "install", "--quiet"]).arg(wheel()?))?;
    let script = "import comic, gymnasium, importlib.metadata, sys\n\
        environment = gymnasium.make('comic/Tracking-v0', clips='builtin:walk')\n\
        environment.reset(seed=1)\n\
        environment.step(environment.action_space.sample())\n\
        assert 'torch' not in sys.modules and 'dm_control' not in sys.modules\n\
        files = importlib.metadata.files('comic-rl')\n\
        texts = {file.name: file.read_text() for file in files if 'licenses' in file.parts}\n\
        assert set(texts) == {'LICENSE-APACHE', 'LICENSE-MIT', 'NOTICE'}\n\
        assert 'dm_control' in texts['NOTICE'] and 'Apache License' in texts['LICENSE-APACHE']";
    let mut command = Command::new(&python);
    command.args(["-c", script]).current_dir(directory.path()).env_clear().env("HOME", directory.path());
    succeeds(&mut command)
}

/// The wheel that `cargo xtask test` has built.
fn wheel() -> Result<PathBuf> {
    let directory: PathBuf = root().join("target/wheels");
    let entries = std::fs::read_dir(&directory).with_context(|| format!("cannot read {}", directory.display()))?;
    let is_wheel = |path: &Path| path.extension().is_some_and(|extension| extension == "whl");
    let wheels: Vec<PathBuf> = entries
        .map(|entry| Ok(entry?.path()))
        .collect::<Result<Vec<_>>>()?
        .into_iter()
        .filter(|path| is_wheel(path))
        .collect();
    ensure!(wheels.len() == 1, "{wheels:?}");
    Ok(wheels[0].clone())
}
