//! Set-up: the native libraries and the humanoid, from pinned wheels into a directory, `.deps` where nobody says otherwise.
//!
//! Each wheel is fetched, unpacked beside its place, moved into it, and stamped last; so set-up can be stopped at any
//! moment and goes on at the first wheel that is not whole.
//!
//! It is a crate of its own, which `cargo xtask setup` calls, so that an image's layer with the libraries is made anew
//! when a pin changes and not with every other change of this workspace.

mod accelerators;
mod download;
mod extract;
mod interrupt;
mod progress;
mod provided;
mod stamp;
mod wheels;

use std::fs::{self, File};
use std::path::Path;

use anyhow::{Context, Result, bail};

use stamp::Stamp;
use wheels::{Extent, Part, Wheel, wheels};

pub use interrupt::Interrupt;
pub use progress::on_terminal;

/// What is taken.
#[derive(clap::Args, Debug, Default)]
pub struct Options {
    /// All of libtorch and NVIDIA's libraries (3.7 GB to fetch, 6 GB on disk) instead of what a CPU needs (1 GB, 0.5 GB)
    #[arg(long)]
    cuda: bool,
    /// The same and torch_xla, for TPUs (4.0 GB to fetch, 7 GB on disk); it takes Python 3.11 with its shared library
    #[arg(long)]
    xla: bool,
}

impl Options {
    /// As much as the update on XLA takes.
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

/// Brings the directory `dependencies` to what the pins say; under a second when it is already.
///
/// # Errors
/// A machine without wheels, an index that does not answer, a full disk, Ctrl-C: each with its remedy.
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
            bail!("XLA takes the libtorch that set-up fetches, and LIBTORCH is {}: unset it", own.display());
        }
        join(dependencies)?;
    }
    let mut missing = Vec::new();
    for wheel in wheels().filter(|wheel| wheel.from <= extent) {
        match provided::directory(wheel.part, dependencies, |name| std::env::var_os(name).map(Into::into))? {
            Some(own) => announce(wheel, &own),
            None if !is_whole(wheel, dependencies, extent) => missing.push(wheel),
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
        take(wheel, dependencies, extent, &interrupt)
            .with_context(|| format!("set-up of {} {} in {}", wheel.name, wheel.version, dependencies.display()))?;
    }
    let _ = fs::remove_dir_all(dependencies.join("wheels"));
    eprintln!("set-up is complete: {}", dependencies.display());
    Ok(())
}

/// libtorch finds NVIDIA's libraries where a wheel of torch does, beside its directory; and Python imports the libtorch that
/// programs link.
#[cfg(unix)]
fn join(dependencies: &Path) -> Result<()> {
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

/// Without links there is no set-up for more than a CPU; there are no wheels for such a platform either.
#[cfg(not(unix))]
fn join(_dependencies: &Path) -> Result<()> {
    Ok(())
}

/// One set-up at a time; a second one waits and then finds the work done.
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

/// A CUDA libtorch serves CPU runs too, so it is not trimmed by a later set-up without the flag.
fn is_whole(wheel: &Wheel, dependencies: &Path, extent: Extent) -> bool {
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
        "set-up knows wheels for Linux on x86_64 only, and this is {} on {} ({} missing); provide MuJoCo 3.17.0 and libtorch \
         2.9.0 yourself and name them by MUJOCO_DYNAMIC_LINK_DIR and LIBTORCH",
        std::env::consts::OS,
        std::env::consts::ARCH,
        native.join(", ")
    )
}

fn take(wheel: &Wheel, dependencies: &Path, extent: Extent, interrupt: &Interrupt) -> Result<()> {
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
    use crate::wheels::WHEELS;

    fn stamped(cuda: bool) -> tempfile::TempDir {
        let dependencies = tempfile::tempdir().unwrap();
        fs::create_dir_all(dependencies.path().join("mujoco")).unwrap();
        fs::write(dependencies.path().join("mujoco/a"), "abc").unwrap();
        let stamp = Stamp { sha256: WHEELS[0].sha256.into(), cuda, files: [("mujoco/a".into(), 3)].into() };
        stamp.write(dependencies.path(), WHEELS[0].name).unwrap();
        dependencies
    }

    #[test]
    fn a_wheel_is_whole_only_with_its_stamp_and_every_file_in_its_size() {
        let dependencies = stamped(false);
        assert!(is_whole(&WHEELS[0], dependencies.path(), Extent::Cpu));
        assert!(!is_whole(&WHEELS[1], dependencies.path(), Extent::Cpu), "another wheel has no stamp");
        fs::write(dependencies.path().join("mujoco/a"), "ab").unwrap();
        assert!(!is_whole(&WHEELS[0], dependencies.path(), Extent::Cpu), "a file was cut short");
        fs::remove_file(dependencies.path().join("mujoco/a")).unwrap();
        assert!(!is_whole(&WHEELS[0], dependencies.path(), Extent::Cpu), "a file is gone");
    }

    #[test]
    fn asking_for_cuda_after_a_trimmed_set_up_takes_the_wheel_again_and_not_the_other_way_round() {
        assert!(!is_whole(&WHEELS[0], stamped(false).path(), Extent::Cuda));
        assert!(is_whole(&WHEELS[0], stamped(true).path(), Extent::Cpu));
    }

    #[test]
    fn what_was_stamped_goes_with_its_stamp() {
        let dependencies = stamped(false);
        Stamp::read(dependencies.path(), WHEELS[0].name).unwrap().remove(dependencies.path(), WHEELS[0].name).unwrap();
        assert!(!dependencies.path().join("mujoco/a").exists());
        assert!(Stamp::read(dependencies.path(), WHEELS[0].name).is_none());
    }
}
