//! Build script shared by every crate whose programs or tests link libmujoco or libtorch: it writes the
//! libraries' directories into the run path, so a binary runs without LD_LIBRARY_PATH.

fn main() {
    write_run_path();
}

pub(crate) fn write_run_path() {
    println!("cargo:rerun-if-env-changed=LIBTORCH");
    println!("cargo:rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    let directories =
        [std::env::var("LIBTORCH").map(|root| format!("{root}/lib")), std::env::var("MUJOCO_DYNAMIC_LINK_DIR")];
    for directory in directories.into_iter().flatten() {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{directory}");
    }
}
