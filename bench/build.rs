//! Where the programs find libmujoco and libtorch, and what they link beside them: CUDA where libtorch has it, and
//! Python's own library with `--features xla`.

#[allow(dead_code, reason = "its own `main` is for crates that need no more")]
#[path = "../setup/rpath.rs"]
mod rpath;

fn main() {
    rpath::write_run_path();
    rpath::link_cuda();
    #[cfg(feature = "xla")]
    rpath::find_python();
}
