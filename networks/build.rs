//! The run path, as for every crate, and the C++ file that reads the operators of a TorchScript module.

#[path = "../setup/cpp.rs"]
mod cpp;
#[allow(dead_code, reason = "its own `main` is for crates that need no more")]
#[path = "../setup/rpath.rs"]
mod rpath;

use std::path::Path;

fn main() {
    rpath::write_run_path();
    let Some(libtorch) = std::env::var_os("LIBTORCH") else {
        panic!("LIBTORCH is not set: `cargo xtask setup` fetches libtorch");
    };
    cpp::with_libtorch(Path::new(&libtorch), "src/export/onnx/graph.cpp").compile("comic_graph");
}
