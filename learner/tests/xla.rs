//! The learner's program with XLA: how it starts, stops and fails.

#![cfg(feature = "xla")]

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use comic_learner::checkpoint::find;
use rustix::process::{Pid, Signal, kill_process};

fn learner(run: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_comic-learner"));
    command.args(["--preset", "quickstart", "--port", "0", "--run"]).arg(run).args(arguments);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Starts a learner, and returns when it serves.
fn started(mut command: Command) -> Child {
    let mut child = command.spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    if !line.contains("listening") {
        let output = child.wait_with_output().unwrap();
        panic!("it does not serve: {}", String::from_utf8_lossy(&output.stderr));
    }
    child
}

#[test]
fn ctrl_c_leaves_a_checkpoint_that_another_device_resumes() {
    let directory = tempfile::tempdir().unwrap();
    let run = directory.path().join("run");
    for (device, signal) in [("xla", Signal::INT), ("cpu", Signal::TERM), ("xla:0", Signal::TERM)] {
        let child = started(learner(&run, &["--device", device]));
        kill_process(Pid::from_child(&child), signal).unwrap();
        let output = child.wait_with_output().unwrap();
        let log = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(4), "{device}: {log}");
        assert!(log.contains("stopped; start again"), "{device}: {log}");
        assert!(find(&run).is_ok(), "{device}: {log}");
    }
}

#[test]
fn a_missing_device_is_a_wrong_configuration() {
    let directory = tempfile::tempdir().unwrap();
    for (device, word) in [("xla:200", "PJRT_DEVICE"), ("cuda:200", "setup --cuda")] {
        let output = learner(&directory.path().join("run"), &["--device", device]).output().unwrap();
        let log = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{log}");
        assert!(log.contains(word), "{log}");
    }
    let mut elsewhere = learner(&directory.path().join("run"), &["--device", "xla"]);
    let output = elsewhere.env("COMIC_PYTHON_PACKAGES", directory.path()).output().unwrap();
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && log.contains("setup --xla"), "{log}");
}

/// For instance of a torch_xla that was installed by hand.
#[test]
fn a_missing_part_of_the_plugin_is_a_wrong_configuration() {
    let directory = tempfile::tempdir().unwrap();
    let packages = directory.path().join("packages");
    std::fs::create_dir(&packages).unwrap();
    for entry in std::fs::read_dir(env!("COMIC_PYTHON_PACKAGES")).unwrap().map(Result::unwrap) {
        if !entry.file_name().to_string_lossy().starts_with("libtpu") {
            std::os::unix::fs::symlink(entry.path(), packages.join(entry.file_name())).unwrap();
        }
    }
    let mut without = learner(&directory.path().join("run"), &["--device", "xla"]);
    let output = without.env("COMIC_PYTHON_PACKAGES", &packages).env("PJRT_DEVICE", "TPU").output().unwrap();
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && log.contains("libtpu") && log.contains("setup --xla"), "{log}");
}
