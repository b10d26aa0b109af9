//! The run path, as for every crate, and the C++ files: for Adam, for several learners, for CUDA where libtorch has it, and for XLA with `--features xla`.
//! XLA also needs the directories of Python and of its packages.

#[path = "../setup/cpp.rs"]
mod cpp;
#[allow(dead_code, reason = "its own `main` is for crates that need no more")]
#[path = "../setup/rpath.rs"]
mod rpath;

use std::path::{Path, PathBuf};

fn main() {
    rpath::write_run_path();
    let Some(libtorch) = std::env::var_os("LIBTORCH").map(PathBuf::from) else {
        panic!("LIBTORCH is not set: `cargo xtask setup` fetches libtorch");
    };
    cpp::with_libtorch(&libtorch, "src/adam/fused.cpp").compile("comic_adam");
    // The directory has what c10d's header includes of gloo.
    println!("cargo:rerun-if-changed=src/world/gloo");
    let mut world = cpp::with_libtorch(&libtorch, "src/world/c10d.cpp");
    world.define("USE_C10D_GLOO", None).include("src/world").compile("comic_world");
    cuda(&libtorch);
    #[cfg(feature = "xla")]
    xla(&libtorch);
}

/// Links CUDA where libtorch has it, and compiles the C++ that copies to a card.
fn cuda(libtorch: &Path) {
    println!("cargo:rustc-check-cfg=cfg(cuda)");
    if rpath::link_cuda() {
        println!("cargo:rustc-cfg=cuda");
        cpp::with_libtorch(libtorch, "src/device/cuda.cpp").compile("comic_cuda");
    }
}

#[cfg(feature = "xla")]
fn xla(libtorch: &Path) {
    // The object file registers itself and no symbol refers to it, so all of it is linked.
    cpp::with_libtorch(libtorch, "src/device/xla.cpp").cargo_metadata(false).compile("comic_xla");
    println!("cargo:rustc-link-search=native={}", std::env::var("OUT_DIR").expect("cargo sets OUT_DIR"));
    println!("cargo:rustc-link-lib=static:+whole-archive,-bundle=comic_xla");
    println!("cargo:rustc-link-lib=stdc++");
    // torch, torch_xla and what they import, where `cargo xtask setup --xla` puts them.
    let packages = libtorch.parent().map(|dependencies| dependencies.join("python")).unwrap_or_default();
    println!("cargo:rustc-env=COMIC_PYTHON_PACKAGES={}", packages.display());
    rpath::find_python();
}
