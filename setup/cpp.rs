//! Compiles the few C++ files that call what libtorch has and tch lacks.

use std::path::Path;

/// A C++ file that is compiled with libtorch's headers.
pub(crate) fn with_libtorch(libtorch: &Path, file: &str) -> cc::Build {
    println!("cargo:rerun-if-changed={file}");
    let include = libtorch.join("include");
    let mut build = cc::Build::new();
    // These files only call libtorch, whose headers take long to compile.
    build.opt_level(1).cpp(true).std("c++17").warnings(false).define("_GLIBCXX_USE_CXX11_ABI", "1");
    build.include(&include).include(include.join("torch/csrc/api/include")).file(file);
    build
}
