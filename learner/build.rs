//! What every crate's build script does, and with `--features xla` the few lines of C++ that XLA takes, and where Python
//! and its packages are.

#[allow(dead_code, reason = "its own `main` is for crates that need no more")]
#[path = "../deploy/rpath.rs"]
mod rpath;

fn main() {
    rpath::write_run_path();
    cuda();
    #[cfg(feature = "xla")]
    xla();
}

/// libtorch's CUDA registers itself when it is loaded, and nothing names what is in it: a linker would leave it out.
fn cuda() {
    let Some(libtorch) = std::env::var_os("LIBTORCH") else { return };
    let library = std::path::Path::new(&libtorch).join("lib/libtorch_cuda.so");
    println!("cargo:rerun-if-changed={}", library.display());
    if library.exists() {
        println!("cargo:rustc-link-arg=-Wl,--allow-shlib-undefined,--no-as-needed,{},--as-needed", library.display());
    }
}

#[cfg(feature = "xla")]
fn xla() {
    use std::path::PathBuf;
    use std::process::Command;

    let shim = "src/device/xla.cpp";
    println!("cargo:rerun-if-changed={shim}");
    let libtorch = PathBuf::from(std::env::var_os("LIBTORCH").expect("LIBTORCH is not set: `cargo xtask setup --xla`"));
    let include = libtorch.join("include");
    cc::Build::new()
        .cpp(true)
        .std("c++17")
        .warnings(false)
        .define("_GLIBCXX_USE_CXX11_ABI", "1")
        .include(&include)
        .include(include.join("torch/csrc/api/include"))
        .file(shim)
        // Nothing names what is in it: it registers itself, so all of it is linked.
        .cargo_metadata(false)
        .compile("comic_xla");
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
