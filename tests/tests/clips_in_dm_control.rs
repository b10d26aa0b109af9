//! `comic-actor clips` end to end: dm_control's own loader reads the files that it writes.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;
use comic_tests::system::{program, python};
use serde_json::Value;

/// Metres, or parts of a quaternion. Both programs compute in double precision.
const TOLERANCE: f64 = 1e-9;

fn clips(arguments: &[&str]) -> Result<Output> {
    Ok(Command::new(program("comic-actor")?).arg("clips").args(arguments).output()?)
}

fn succeeds(arguments: &[&str]) -> Result<String> {
    let output = clips(arguments)?;
    ensure!(output.status.success(), "clips {arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}

/// The JSON that `tests/python/read_clips.py` prints for a file.
fn dm_control(file: &str) -> Result<Value> {
    let output = Command::new(python()?).arg(root().join("tests/python/read_clips.py")).arg(file).output()?;
    ensure!(output.status.success(), "dm_control cannot read {file}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).context("read_clips.py printed no JSON")
}

fn recording(name: &str) -> String {
    root().join("clips/tests/data/cmu").join(name).display().to_string()
}

fn path(directory: &Path, name: &str) -> String {
    let path: PathBuf = directory.join(name);
    path.display().to_string()
}

#[test]
fn dm_control_reads_imported_and_merged_clips_and_computes_the_same_kinematics() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let (run, all) = (path(directory.path(), "run.h5"), path(directory.path(), "all.h5"));
    let import = ["import", "--asf", &recording("02.asf"), "--amc", &recording("02_03.amc"), "--out", &run];
    let said = succeeds(&import)?;
    ensure!(said.starts_with("CMU_002_03: 47 frames, 1.41 s, with --scale 1.17"), "{said}");
    succeeds(&["merge", &run, "builtin:walk", "builtin:stand", "--out", &all])?;

    let report = dm_control(&all)?;
    for (clip, frames) in [("CMU_002_03", 47), ("CMU_007_01", 87), ("stand", 120)] {
        let found = &report[clip];
        ensure!(found["frames"] == frames && found["dt"] == 0.03, "{clip}: {found}");
        let differences = found["differences"].as_object().context("no differences")?;
        ensure!(differences.len() == 5, "{clip}: {found}");
        for (field, difference) in differences {
            ensure!(
                difference.as_f64().is_some_and(|difference| difference < TOLERANCE),
                "{clip}: {field}: {difference}"
            );
        }
    }
    let checked: Value = serde_json::from_str(&succeeds(&["check", &all, "--json"])?)?;
    ensure!(checked.as_array().is_some_and(|clips| clips.iter().all(|clip| clip["defects"] == serde_json::json!([]))));
    let listed: Value = serde_json::from_str(&succeeds(&["list", &all, "--json"])?)?;
    ensure!(listed[1]["clip"] == "CMU_007_01" && listed[1]["starts"] == serde_json::json!([0, 72]), "{listed}");
    Ok(())
}

#[test]
fn the_printed_options_give_the_same_file_again() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let (first, second) = (path(directory.path(), "a.h5"), path(directory.path(), "b.h5"));
    let import = ["import", "--asf", &recording("02.asf"), "--amc", &recording("02_03.amc"), "--out"];
    let said = succeeds(&[&import[..], &[&first]].concat())?;
    let options =
        said.lines().next().and_then(|line| line.split_once(" with ")).context("the program printed no options")?.1;
    let taken: Vec<&str> = options.split(' ').collect();
    succeeds(&[&import[..], &[&second], &taken].concat())?;
    ensure!(std::fs::read(first)? == std::fs::read(second)?);
    Ok(())
}

#[test]
fn exit_codes_tell_defects_from_wrong_files() -> Result<()> {
    let defects = root().join("clips/tests/data/defects.h5").display().to_string();
    let output = clips(&["check", &defects])?;
    ensure!(output.status.code() == Some(1), "{output:?}");
    let table = String::from_utf8(output.stdout)?;
    ensure!(table.contains("not_finite") && table.contains("quaternion_norm"), "{table}");
    for wrong in [["check", "no-such.h5"], ["list", "no-such.h5"], ["merge", "builtin:walk"]] {
        let output = clips(&wrong)?;
        ensure!(output.status.code() == Some(2), "{wrong:?}: {output:?}");
    }
    Ok(())
}
