//! Set-up: copies the native libraries and the humanoid from pinned wheels into a directory, by default `.deps`.
//!
//! Each wheel is fetched, unpacked into a temporary directory, moved to its place, and stamped last. So set-up can be
//! stopped at any moment, and continues at the first incomplete wheel.
//!
//! This is a crate of its own, which `cargo xtask setup` calls. So the Docker layer with the libraries is rebuilt when a
//! pin changes, and not with every other change of the workspace.
//!
//! # Layout
//! - `wheel` is what set-up knows of a wheel, `wheels` the pinned ones; `provided` are libraries that the user has.
//! - `download` fetches a wheel, `extract` unpacks it, `stamp` records that it is complete.
//! - `progress` and `interrupt` are the terminal's side.

mod download;
mod extract;
mod interrupt;
mod progress;
mod provided;
mod stamp;
mod wheel;
mod wheels;

use std::fs::{self, File};
use std::path::Path;

use anyhow::{Context, Result, bail};

use stamp::Stamp;
use wheel::{Extent, Part, Wheel};
use wheels::wheels;

pub use interrupt::Interrupt;
pub use progress::on_terminal;

/// How much is set up.
#[derive(clap::Args, Debug, Default)]
pub struct Options {
    /// Fetch all of libtorch and NVIDIA's libraries (3.7 GB, 6 GB on disk), not only what a CPU needs (1 GB, 0.5 GB on disk)
    #[arg(long)]
    cuda: bool,
    /// Fetch the same and torch_xla, for TPUs (4.0 GB, 7 GB on disk); it needs Python 3.11 with its shared library
    #[arg(long)]
    xla: bool,
}

impl Options {
    /// What the update on XLA needs.
    pub fn xla() -> Self {
        Self { cuda: false, xla: true }
    }

    fn extent(&self) -> Extent {
        match self {
            Self { xla: true, .. } => Extent::Xla,
            Self { cuda: true, .. } => Extent::Cuda,
            _ => Extent::Cpu,
        }
    }
}

/// The version and the SHA-256 (hexadecimal) of the pinned wheel `name`.
pub fn pin(name: &str) -> Option<(&'static str, &'static str)> {
    wheels().find(|wheel| wheel.name == name).map(|wheel| (wheel.version, wheel.sha256))
}

/// Brings the directory `dependencies` to the state that the pins describe. Takes less than a second if it is already.
///
/// # Errors
/// A platform without wheels, an index that does not answer, a full disk, Ctrl-C: each with its remedy.
pub fn run(options: &Options, dependencies: &Path) -> Result<()> {
    let extent = options.extent();
    if extent == Extent::Xla {
        download::require_embeddable()?;
    }
    fs::create_dir_all(dependencies).with_context(|| format!("cannot make {}", dependencies.display()))?;
    let _lock = lock(dependencies)?;
    if extent > Extent::Cpu {
        let variable = |name: &str| std::env::var_os(name).map(Into::into);
        if let (Extent::Xla, Some(own)) = (extent, provided::directory(Part::Libtorch, dependencies, variable)?) {
            bail!("XLA needs the libtorch that set-up fetches, but LIBTORCH is {}: unset it", own.display());
        }
        link_packages(dependencies)?;
    }
    let mut missing = Vec::new();
    for wheel in wheels().filter(|wheel| wheel.from <= extent) {
        match provided::directory(wheel.part, dependencies, |name| std::env::var_os(name).map(Into::into))? {
            Some(own) => announce(wheel, &own),
            None if !is_complete(wheel, dependencies, extent) => missing.push(wheel),
            None => {}
        }
    }
    if missing.is_empty() {
        return Ok(());
    }
    require_platform(&missing)?;
    download::require_pip()?;
    let interrupt = Interrupt::install()?;
    for wheel in missing {
        fetch_and_extract(wheel, dependencies, extent, &interrupt)
            .with_context(|| format!("set-up of {} {} in {}", wheel.name, wheel.version, dependencies.display()))?;
    }
    let _ = fs::remove_dir_all(dependencies.join("wheels"));
    eprintln!("set-up is complete: {}", dependencies.display());
    Ok(())
}

/// Makes two links: libtorch looks for NVIDIA's libraries beside its own directory, as in an installed torch; and Python
/// imports the libtorch that programs link.
#[cfg(unix)]
fn link_packages(dependencies: &Path) -> Result<()> {
    fs::create_dir_all(dependencies.join("python")).context("cannot make the directory of Python's packages")?;
    for (link, target) in [("nvidia", "python/nvidia"), ("python/torch", "../libtorch")] {
        let link = dependencies.join(link);
        if fs::read_link(&link).is_ok_and(|found| found == Path::new(target)) {
            continue;
        }
        let _ = fs::remove_file(&link);
        std::os::unix::fs::symlink(target, &link).with_context(|| format!("cannot link {}", link.display()))?;
    }
    Ok(())
}

/// A platform without symbolic links has no wheels for accelerators either.
#[cfg(not(unix))]
fn link_packages(_dependencies: &Path) -> Result<()> {
    Ok(())
}

/// Allows one set-up at a time. A second one waits, and then finds the work done.
fn lock(dependencies: &Path) -> Result<File> {
    let path = dependencies.join("lock");
    let file = File::create(&path).with_context(|| format!("cannot write {}", path.display()))?;
    if file.try_lock().is_err() {
        eprintln!("waiting for another set-up in {}", dependencies.display());
        file.lock().with_context(|| format!("cannot lock {}", path.display()))?;
    }
    Ok(file)
}

fn announce(wheel: &Wheel, own: &Path) {
    let first = wheels().find(|other| other.part == wheel.part);
    if first.is_some_and(|first| first.name == wheel.name) {
        let what = match wheel.part {
            Part::Mujoco => "MuJoCo",
            Part::Libtorch => "libtorch",
            Part::DmControl => "humanoid",
            Part::Python => "torch_xla",
        };
        eprintln!("using your own {what}: {}", own.display());
    }
}

/// A libtorch with CUDA also serves a CPU, so a later set-up without the flag keeps it.
fn is_complete(wheel: &Wheel, dependencies: &Path, extent: Extent) -> bool {
    let enough = |stamp: &Stamp| stamp.cuda || extent == Extent::Cpu;
    Stamp::read(dependencies, wheel.name)
        .is_some_and(|stamp| stamp.sha256 == wheel.sha256 && enough(&stamp) && stamp.agrees(dependencies))
}

fn require_platform(missing: &[&Wheel]) -> Result<()> {
    let native: Vec<_> = missing.iter().filter(|wheel| wheel.native).map(|wheel| wheel.name).collect();
    if native.is_empty() || cfg!(all(target_os = "linux", target_arch = "x86_64")) {
        return Ok(());
    }
    bail!(
        "set-up has wheels for Linux on x86_64 only, and this is {} on {} ({} missing); provide MuJoCo 3.17.0 and libtorch \
         2.9.0 yourself and name them by MUJOCO_DYNAMIC_LINK_DIR and LIBTORCH",
        std::env::consts::OS,
        std::env::consts::ARCH,
        native.join(", ")
    )
}

fn fetch_and_extract(wheel: &Wheel, dependencies: &Path, extent: Extent, interrupt: &Interrupt) -> Result<()> {
    if let Some(old) = Stamp::read(dependencies, wheel.name) {
        old.remove(dependencies, wheel.name)?;
    }
    let directory = dependencies.join("wheels");
    let archive = download::fetch(wheel, &directory, interrupt)?;
    let files = extract::extract(wheel, &archive, dependencies, extent, interrupt)?;
    let stamp = Stamp { sha256: wheel.sha256.into(), cuda: extent > Extent::Cpu, files };
    stamp.write(dependencies, wheel.name)?;
    fs::remove_file(&archive).with_context(|| format!("cannot remove {}", archive.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    fn pinned(index: usize) -> &'static Wheel {
        wheels().nth(index).unwrap()
    }

    fn stamped(cuda: bool) -> tempfile::TempDir {
        let dependencies = tempfile::tempdir().unwrap();
        fs::create_dir_all(dependencies.path().join("mujoco")).unwrap();
        fs::write(dependencies.path().join("mujoco/a"), "abc").unwrap();
        let stamp = Stamp { sha256: pinned(0).sha256.into(), cuda, files: [("mujoco/a".into(), 3)].into() };
        stamp.write(dependencies.path(), pinned(0).name).unwrap();
        dependencies
    }

    #[test]
    fn a_wheel_is_complete_only_with_its_stamp_and_every_file_in_its_size() {
        let dependencies = stamped(false);
        assert!(is_complete(pinned(0), dependencies.path(), Extent::Cpu));
        assert!(!is_complete(pinned(1), dependencies.path(), Extent::Cpu), "another wheel has no stamp");
        fs::write(dependencies.path().join("mujoco/a"), "ab").unwrap();
        assert!(!is_complete(pinned(0), dependencies.path(), Extent::Cpu), "a file was cut short");
        fs::remove_file(dependencies.path().join("mujoco/a")).unwrap();
        assert!(!is_complete(pinned(0), dependencies.path(), Extent::Cpu), "a file is gone");
    }

    #[test]
    fn a_set_up_with_cuda_replaces_one_for_a_cpu_and_not_the_other_way_round() {
        assert!(!is_complete(pinned(0), stamped(false).path(), Extent::Cuda));
        assert!(is_complete(pinned(0), stamped(true).path(), Extent::Cpu));
    }

    #[test]
    fn files_are_removed_with_their_stamp() {
        let dependencies = stamped(false);
        Stamp::read(dependencies.path(), pinned(0).name).unwrap().remove(dependencies.path(), pinned(0).name).unwrap();
        assert!(!dependencies.path().join("mujoco/a").exists());
        assert!(Stamp::read(dependencies.path(), pinned(0).name).is_none());
    }
}
