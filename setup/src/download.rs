//! Fetches one wheel from the user's package index with pip.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, bail};

use crate::interrupt::Interrupt;
use crate::progress::Progress;
use crate::wheel::Wheel;

/// The platform of the pinned wheels. The user's own Python may be another one.
const PLATFORM: [&str; 9] = [
    "--platform=manylinux_2_31_x86_64",
    "--platform=manylinux_2_28_x86_64",
    "--platform=manylinux_2_27_x86_64",
    "--platform=manylinux_2_17_x86_64",
    "--platform=manylinux2014_x86_64",
    "--platform=linux_x86_64",
    "--python-version=3.11",
    "--implementation=cp",
    "--abi=cp311",
];

/// Fails with the remedy unless `python3 -m pip` runs.
pub(crate) fn require_pip() -> Result<()> {
    let pip = Command::new("python3").args(["-m", "pip", "--version"]).output();
    match pip {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => bail!(
            "python3 has no pip ({}); install it (Debian and Ubuntu: apt install python3-pip) and run `cargo xtask setup` again",
            String::from_utf8_lossy(&output.stderr).trim()
        ),
        Err(error) => bail!(
            "cannot run python3 ({error}); set-up fetches wheels with `python3 -m pip download`: install Python 3 with pip \
             and run `cargo xtask setup` again"
        ),
    }
}

/// Fails with the remedy unless the Python that the learner embeds is the one for which torch_xla was built.
pub(crate) fn require_embeddable() -> Result<()> {
    let python = std::env::var("PYO3_PYTHON").unwrap_or_else(|_| "python3".into());
    let question = "import os, sys, sysconfig; print(*sys.version_info[:2], \
                    os.path.exists(os.path.join(sysconfig.get_config_var('LIBDIR'), 'libpython3.11.so')))";
    let answer = Command::new(&python).args(["-c", question]).output();
    let answer = answer.with_context(|| format!("cannot run {python}"))?;
    let answer = String::from_utf8_lossy(&answer.stdout).trim().to_owned();
    if answer == "3 11 True" {
        return Ok(());
    }
    bail!(
        "XLA needs Python 3.11 with its shared library; {python} is another one (its version, and whether libpython3.11.so \
         exists: {answer}); install Python 3.11 (Debian 12: apt install python3 libpython3.11-dev) and name it by PYO3_PYTHON"
    )
}

/// Fetches `wheel` into `directory` with the user's own pip configuration. pip verifies the hash, and keeps a complete
/// wheel that is already there.
pub(crate) fn fetch(wheel: &Wheel, directory: &Path, interrupt: &Interrupt) -> Result<PathBuf> {
    let temporary = directory.join("unfinished");
    let _ = fs::remove_dir_all(&temporary);
    fs::create_dir_all(&temporary).with_context(|| format!("cannot make {}", temporary.display()))?;
    let requirements = directory.join("requirements.txt");
    fs::write(&requirements, format!("{}=={} --hash=sha256:{}\n", wheel.name, wheel.version, wheel.sha256))
        .with_context(|| format!("cannot write {}", requirements.display()))?;
    let log = directory.join("pip.log");
    pip(wheel, directory, &temporary, &requirements, &log, interrupt)?;
    fs::remove_dir_all(&temporary).with_context(|| format!("cannot remove {}", temporary.display()))?;
    find(wheel, directory)
}

fn pip(
    wheel: &Wheel,
    directory: &Path,
    temporary: &Path,
    requirements: &Path,
    log: &Path,
    interrupt: &Interrupt,
) -> Result<()> {
    let output = File::create(log).with_context(|| format!("cannot write {}", log.display()))?;
    let mut progress = Progress::start(format!("fetching {} {}", wheel.name, wheel.version), wheel.size);
    let mut child = Command::new("python3")
        .args(["-m", "pip", "download", "--no-deps", "--only-binary=:all:", "--require-hashes", "--no-input"])
        .args(["--progress-bar=off", "--disable-pip-version-check"])
        .args(PLATFORM)
        .arg("--dest")
        .arg(directory)
        .arg("--requirement")
        .arg(requirements)
        // pip downloads into its temporary directory. There the bytes can be counted, and they need space on the disk of
        // .deps only.
        .env("TMPDIR", temporary)
        .stdin(Stdio::null())
        .stdout(output.try_clone()?)
        .stderr(output)
        .spawn()
        .context("cannot start python3")?;
    let status = loop {
        if let Some(status) = child.try_wait().context("cannot wait for pip")? {
            break status;
        }
        if interrupt.requested() {
            let _ = child.kill();
            let _ = child.wait();
            bail!("interrupted; `cargo xtask setup` continues at {}", wheel.name);
        }
        progress.set(size_below(temporary));
        std::thread::sleep(Duration::from_millis(100));
    };
    if !status.success() {
        bail!(explain(wheel, &fs::read_to_string(log).unwrap_or_default(), log));
    }
    progress.finish();
    Ok(())
}

/// pip's message, and the remedy.
fn explain(wheel: &Wheel, output: &str, log: &Path) -> String {
    let remedy = if output.contains("DO NOT MATCH THE HASHES") {
        "the index serves a file that differs from the pinned one: check which index pip is configured to use (python3 -m pip config list)"
    } else if output.contains("No space left on device") {
        "the disk is full: set-up needs about 1.5 GB while it runs and 0.5 GB afterwards; 8 GB and 7 GB with --cuda or --xla"
    } else if ["NewConnectionError", "ConnectTimeout", "NameResolution", "ProxyError", "Max retries", "ReadTimeout"]
        .iter()
        .any(|sign| output.contains(sign))
    {
        "the package index cannot be reached: check the network or pip's index and proxy settings (python3 -m pip config list); \
         offline, PIP_FIND_LINKS=DIRECTORY PIP_NO_INDEX=1 takes the wheels from a directory. Complete wheels are kept"
    } else if output.contains("No matching distribution") || output.contains("Could not find a version") {
        "the package index cannot be reached or does not have this wheel: check the network and pip's configuration \
         (python3 -m pip config list); offline, PIP_FIND_LINKS=DIRECTORY PIP_NO_INDEX=1 takes the wheels from a directory"
    } else if output.contains("no such option") {
        "this pip is too old: python3 -m pip install --upgrade pip"
    } else {
        "the file has the whole output"
    };
    let last: Vec<&str> = output.lines().filter(|line| !line.trim().is_empty()).collect();
    let last = last[last.len().saturating_sub(6)..].join("\n  ");
    format!("cannot fetch {} {}: {remedy} ({})\n  {last}", wheel.name, wheel.version, log.display())
}

/// The file that pip wrote for `wheel`.
fn find(wheel: &Wheel, directory: &Path) -> Result<PathBuf> {
    let prefix = format!("{}-{}-", wheel.name.replace('-', "_"), wheel.version);
    let files = fs::read_dir(directory).with_context(|| format!("cannot read {}", directory.display()))?;
    files
        .flatten()
        .map(|file| file.path())
        .find(|path| {
            path.extension().is_some_and(|extension| extension == "whl")
                && path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(&prefix))
        })
        .with_context(|| format!("pip wrote no {prefix}*.whl into {}", directory.display()))
}

/// Bytes of all files below `directory`. pip works there, so files may appear and disappear.
fn size_below(directory: &Path) -> u64 {
    let Ok(entries) = fs::read_dir(directory) else { return 0 };
    entries
        .flatten()
        .map(|entry| match entry.metadata() {
            Ok(metadata) if metadata.is_dir() => size_below(&entry.path()),
            Ok(metadata) => metadata.len(),
            Err(_) => 0,
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wheels::wheels;

    #[test]
    fn a_failed_download_names_the_wheel_the_remedy_and_the_end_of_pips_output() {
        let mujoco = wheels().next().unwrap();
        let message = explain(mujoco, "Collecting mujoco\nERROR: No matching distribution found", Path::new("pip.log"));
        assert!(message.contains("mujoco 3.17.0"), "{message}");
        assert!(message.contains("PIP_FIND_LINKS"), "{message}");
        assert!(message.ends_with("No matching distribution found"), "{message}");
    }
}
