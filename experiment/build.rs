//! Collects `presets/*.toml`: a preset is one file in that folder, and no code names it. The output has the documents
//! themselves and no path, so it is valid in a copy of the repository, too.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::{env, fs, io};

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-changed=presets");
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("presets");
    let mut files: Vec<PathBuf> = fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<io::Result<_>>()?;
    files.retain(|file| file.extension().is_some_and(|extension| extension == "toml"));
    files.sort_by_key(|file| file.file_stem().map(ToOwned::to_owned));
    let mut entries = String::new();
    for file in &files {
        let (name, document) = (file.file_stem().unwrap_or_default(), fs::read_to_string(file)?);
        writeln!(entries, "    ({name:?}, {document:?}),").map_err(io::Error::other)?;
    }
    let list = format!("[(&str, &str); {}] = [\n{entries}]", files.len());
    let code = format!("/// Name and document of every preset, by name.\npub const ALL: {list};\n");
    let output = env::var_os("OUT_DIR").ok_or_else(|| io::Error::other("cargo sets OUT_DIR for build scripts"))?;
    fs::write(Path::new(&output).join("presets.rs"), code)
}
