//! What every crate's build script does, and the few lines of C++ that other devices take: CUDA where libtorch has it, XLA
//! with `--features xla`, which also wants to know where Python and its packages are.

#[allow(dead_code, reason = "its own `main` is for crates that need no more")]
#[path = "../setup/rpath.rs"]
mod rpath;

use std::path::{Path, PathBuf};

fn main() {
    rpath::write_run_path();
    cuda();
    #[cfg(feature = "xla")]
    xla();
}

/// libtorch's CUDA registers itself when it is loaded, and nothing names what is in it: a linker would leave it out.
fn cuda() {
    println!("cargo:rustc-check-cfg=cfg(cuda)");
    let Some(libtorch) = std::env::var_os("LIBTORCH").map(PathBuf::from) else { return };
    let libraries = libtorch.join("lib");
    // The directory: of a file that is not there Cargo thinks that it has just gone, and builds everything anew each time.
    println!("cargo:rerun-if-changed={}", libraries.display());
    let library = libraries.join("libtorch_cuda.so");
    if library.exists() {
        println!("cargo:rustc-link-arg=-Wl,--allow-shlib-undefined,--no-as-needed,{},--as-needed", library.display());
        println!("cargo:rustc-cfg=cuda");
        cpp(&libtorch, "src/device/cuda.cpp").compile("comic_cuda");
    }
}

/// A file of C++ that sees libtorch.
fn cpp(libtorch: &Path, file: &str) -> cc::Build {
    println!("cargo:rerun-if-changed={file}");
    let include = libtorch.join("include");
    let mut build = cc::Build::new();
    build.cpp(true).std("c++17").warnings(false).define("_GLIBCXX_USE_CXX11_ABI", "1");
    build.include(&include).include(include.join("torch/csrc/api/include")).file(file);
    build
}

#[cfg(feature = "xla")]
fn xla() {
    use std::process::Command;

    let libtorch = PathBuf::from(std::env::var_os("LIBTORCH").expect("LIBTORCH is not set: `cargo xtask setup --xla`"));
    // Nothing names what is in it: it registers itself, so all of it is linked.
    cpp(&libtorch, "src/device/xla.cpp").cargo_metadata(false).compile("comic_xla");
    println!("cargo:rustc-link-search=native={}", std::env::var("OUT_DIR").expect("cargo sets OUT_DIR"));
    println!("cargo:rustc-link-lib=static:+whole-archive,-bundle=comic_xla");
    println!("cargo:rustc-link-lib=stdc++");
    // torch, torch_xla and what they import, as `cargo xtask setup --xla` puts them beside libtorch.
    let packages = libtorch.parent().map(|dependencies| dependencies.join("python")).unwrap_or_default();
    println!("cargo:rustc-env=COMIC_PYTHON_PACKAGES={}", packages.display());
    println!("cargo:rerun-if-env-changed=PYO3_PYTHON");
    let python = std::env::var("PYO3_PYTHON").unwrap_or_else(|_| "python3".into());
    let asked =
        Command::new(&python).args(["-c", "import sysconfig; print(sysconfig.get_config_var('LIBDIR'))"]).output();
    let asked = asked.unwrap_or_else(|error| panic!("cannot run {python}: {error}"));
    println!("cargo:rustc-link-arg=-Wl,-rpath,{}", String::from_utf8_lossy(&asked.stdout).trim());
}
