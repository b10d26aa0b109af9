//! Programs that `cargo xtask train` starts end with it.

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const XTASK: &str = env!("CARGO_BIN_EXE_xtask");
const LIMIT: Duration = Duration::from_secs(60);
const POLL: Duration = Duration::from_millis(10);

/// Whether the process runs. One that has ended may wait for its new parent to notice.
fn runs(pid: &str) -> bool {
    let status = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    // The state is the first field after the name, which is in brackets.
    status.rsplit_once(") ").is_some_and(|(_, fields)| !fields.starts_with('Z'))
}

#[test]
fn a_child_ends_when_its_parent_is_killed() {
    let script = r#""$0" child $$ sleep 600 & echo $!; wait"#;
    let mut parent = Command::new("sh").args(["-c", script, XTASK]).stdout(Stdio::piped()).spawn().unwrap();
    let mut pid = String::new();
    BufReader::new(parent.stdout.take().unwrap()).read_line(&mut pid).unwrap();
    let deadline = Instant::now() + LIMIT;
    let name = || fs::read_to_string(format!("/proc/{}/comm", pid.trim())).unwrap_or_default();
    while name().trim() != "sleep" {
        assert!(Instant::now() < deadline, "it did not become the program: {}", name());
        std::thread::sleep(POLL);
    }
    parent.kill().unwrap();
    parent.wait().unwrap();
    while runs(pid.trim()) {
        assert!(Instant::now() < deadline, "the child lives on");
        std::thread::sleep(POLL);
    }
}

#[test]
fn a_child_whose_parent_has_ended_does_not_start() {
    // The parent of this process is this test, and never process 1.
    let output = Command::new(XTASK).args(["child", "1", "echo", "started"]).output().unwrap();
    assert!(!output.status.success() && output.stdout.is_empty());
    assert!(String::from_utf8_lossy(&output.stderr).contains("has ended"), "{output:?}");
}
