//! The build script of every crate whose programs or tests link libmujoco or libtorch. It writes the directories of these
//! libraries into the programs' run path, so that a program runs without `LD_LIBRARY_PATH`. `COMIC_RUN_PATH` names another
//! run path: `$ORIGIN/../lib` makes programs that can be moved together with their libraries.

use std::path::PathBuf;

fn main() {
    write_run_path();
}

pub(crate) fn write_run_path() {
    println!("cargo:rerun-if-env-changed=COMIC_RUN_PATH");
    println!("cargo:rerun-if-env-changed=LIBTORCH");
    println!("cargo:rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if let Ok(path) = std::env::var("COMIC_RUN_PATH") {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{path}");
        return;
    }
    let directories =
        [std::env::var("LIBTORCH").map(|root| format!("{root}/lib")), std::env::var("MUJOCO_DYNAMIC_LINK_DIR")];
    for directory in directories.into_iter().flatten() {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{directory}");
    }
}

/// Links libtorch's CUDA library, if libtorch has one, and says whether it does. The library registers itself when it is
/// loaded. No symbol refers to it, so a linker would leave it out.
#[allow(dead_code, reason = "most crates do not choose a device")]
pub(crate) fn link_cuda() -> bool {
    let Some(libtorch) = std::env::var_os("LIBTORCH").map(PathBuf::from) else { return false };
    let libraries = libtorch.join("lib");
    // The directory, not the file: Cargo takes a missing file for a change and would build everything again each time.
    println!("cargo:rerun-if-changed={}", libraries.display());
    let library = libraries.join("libtorch_cuda.so");
    let exists = library.exists();
    if exists {
        println!("cargo:rustc-link-arg=-Wl,--allow-shlib-undefined,--no-as-needed,{},--as-needed", library.display());
    }
    exists
}

/// Writes the directory of Python's shared library into the run path.
#[allow(dead_code, reason = "only `--features xla` embeds Python")]
pub(crate) fn find_python() {
    println!("cargo:rerun-if-env-changed=PYO3_PYTHON");
    let python = std::env::var("PYO3_PYTHON").unwrap_or_else(|_| "python3".into());
    let question = "import sysconfig; print(sysconfig.get_config_var('LIBDIR'))";
    let answer = std::process::Command::new(&python).args(["-c", question]).output();
    let answer = answer.unwrap_or_else(|error| panic!("cannot run {python}: {error}"));
    println!("cargo:rustc-link-arg=-Wl,-rpath,{}", String::from_utf8_lossy(&answer.stdout).trim());
}
