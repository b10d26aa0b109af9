//! The images, built as a user builds them: with `deploy/compose.yaml`.
//!
//! Docker pulls the base images. Where it cannot, substitutes with the same names and a label are made: Debian with
//! debootstrap, and Debian with this machine's Rust.

use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::{env, fs};

use anyhow::{Context, Result, ensure};

use crate::workspace::{self, describe, root};

/// The base images of `deploy/Dockerfile`.
const DEBIAN: &str = "debian:bookworm-slim";
const RUST: &str = "rust:1.95-bookworm";
const SUBSTITUTE: &str = "LABEL org.comic.substitute=true";
/// Paths that the real image leaves out as well.
const LEFT_OUT: [&str; 5] =
    ["./usr/share/doc/*", "./usr/share/locale/*", "./usr/share/man/*", "./var/cache/apt/*", "./var/lib/apt/lists/*"];

/// Builds the images. Layers that have not changed come from the engine's cache.
pub(crate) fn build() -> Result<()> {
    ensure!(quietly(Command::new("docker").arg("info")), "no Docker engine answers: `docker info` has the reason");
    for (image, substitute) in [(DEBIAN, make_debian as fn() -> Result<()>), (RUST, make_rust)] {
        if !exists(image) && workspace::run(Command::new("docker").args(["pull", image])).is_err() {
            eprintln!("{image} cannot be pulled: making a substitute");
            substitute().with_context(|| format!("{image} does not exist and cannot be replaced by a substitute"))?;
        }
    }
    copy_authorities()?;
    workspace::run(
        compose().args(["--file", "deploy/compose.yaml", "--profile", "tensorboard", "build"]).current_dir(root()),
    )
}

/// Compose, v2 or v1.
fn compose() -> Command {
    if !quietly(Command::new("docker").args(["compose", "version"])) {
        return Command::new("docker-compose");
    }
    let mut second = Command::new("docker");
    second.arg("compose");
    second
}

/// Whether a command ends well. Its output is discarded.
fn quietly(command: &mut Command) -> bool {
    command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
}

fn exists(image: &str) -> bool {
    quietly(Command::new("docker").args(["image", "inspect", image]))
}

/// Copies the certificate authorities that SSL_CERT_FILE names, if it is set, so that the build trusts a proxy.
fn copy_authorities() -> Result<()> {
    let Some(authorities) = env::var_os("SSL_CERT_FILE") else { return Ok(()) };
    let place = root().join("deploy/ca-certificates/ssl-cert-file.crt");
    let known =
        fs::read(&authorities).with_context(|| format!("cannot read SSL_CERT_FILE={}", authorities.display()))?;
    fs::write(&place, known).with_context(|| format!("cannot write {}", place.display()))
}

fn make_debian() -> Result<()> {
    let directory = scratch("debian")?;
    let mirror = env::var("DEBIAN_MIRROR").unwrap_or_else(|_| "http://deb.debian.org".into());
    let mut debootstrap = Command::new("debootstrap");
    debootstrap.args(["--variant=minbase", "bookworm"]).arg(&directory).arg(format!("{mirror}/debian"));
    let made = workspace::run(debootstrap.stdout(Stdio::null()));
    made.context("debootstrap needs root, and Debian's package debootstrap")?;
    let mut archive = Command::new("tar");
    archive
        .arg("--create")
        .args(LEFT_OUT.map(|path| format!("--exclude={path}")))
        .arg("--directory")
        .arg(&directory)
        .arg(".");
    feed(&mut archive, Command::new("docker").args(["import", "--change", SUBSTITUTE, "-", DEBIAN]))?;
    fs::remove_dir_all(&directory).with_context(|| format!("cannot remove {}", directory.display()))
}

fn make_rust() -> Result<()> {
    let (version, toolchain) = (rustc(&["--version"])?, rustc(&["--print", "sysroot"])?);
    ensure!(version.starts_with("rustc 1.95."), "this machine has {version}, not the one of {RUST}");
    let directory = scratch("rust")?;
    let recipe = format!(
        "FROM {DEBIAN}\n{SUBSTITUTE}\nRUN apt-get update && apt-get install --yes --no-install-recommends gcc libc6-dev \
         && rm -r /var/lib/apt/lists/*\nCOPY bin /usr/local/bin\nCOPY lib /usr/local/lib\n"
    );
    fs::write(directory.join("Dockerfile"), recipe).context("cannot write a Dockerfile")?;
    let mut archive = Command::new("tar");
    archive.arg("--create").arg("--directory").arg(&directory).arg("Dockerfile");
    archive.args(["--directory", &toolchain, "bin", "lib"]);
    feed(&mut archive, Command::new("docker").args(["build", "--tag", RUST, "-"]))?;
    fs::remove_dir_all(&directory).with_context(|| format!("cannot remove {}", directory.display()))
}

/// The output of this machine's rustc.
fn rustc(arguments: &[&str]) -> Result<String> {
    let output = Command::new("rustc").args(arguments).current_dir(root()).output().context("cannot start rustc")?;
    Ok(String::from_utf8(output.stdout)?.trim().to_owned())
}

/// An empty directory in `.deps`.
fn scratch(name: &str) -> Result<PathBuf> {
    let directory = workspace::dependencies().join("images").join(name);
    let _ = fs::remove_dir_all(&directory);
    fs::create_dir_all(&directory).with_context(|| format!("cannot make {}", directory.display()))?;
    Ok(directory)
}

/// Runs both commands; the second reads the output of the first.
fn feed(from: &mut Command, to: &mut Command) -> Result<()> {
    let mut writer = from.stdout(Stdio::piped()).spawn().with_context(|| format!("cannot start {}", describe(from)))?;
    let pipe = writer.stdout.take().context("a child without standard output")?;
    workspace::run(to.stdin(pipe))?;
    let ended = writer.wait().with_context(|| format!("cannot wait for {}", describe(from)))?;
    ensure!(ended.success(), "{} ended with {ended}", describe(from));
    Ok(())
}
