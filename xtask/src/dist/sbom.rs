//! The bill of materials of a program, in CycloneDX: its crates by cargo-cyclonedx, and its native libraries.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde_json::{Value, json};

use super::libraries::{self, Library, Licence};
use super::{TARGET, archive};
use crate::workspace::{self, cargo, root, run};

const CYCLONEDX: &str = "cargo-cyclonedx";
const VERSION: &str = "0.5.9";
/// The name that cargo-cyclonedx gives its files, beside each crate's manifest.
const OUTPUT: &str = "bill-of-materials-of-xtask";

/// The bills of materials of these programs, which are also the names of their packages. `trees` are their directories, with
/// the native libraries in `lib`.
pub(super) fn bills(programs: &[&str], trees: &[PathBuf], date: u64) -> Result<Vec<Value>> {
    let packages = packages()?;
    // It writes a file for every crate of the workspace, also before an interruption.
    let clean =
        || packages.iter().for_each(|package| drop(fs::remove_file(package.directory.join(format!("{OUTPUT}.json")))));
    clean();
    let listed = list_crates(&packages, programs, date);
    clean();
    let mut bills = listed?;
    for ((bill, tree), program) in bills.iter_mut().zip(trees).zip(programs) {
        let native = libraries::of(program).map(|library| component(library, tree)).collect::<Result<Vec<_>>>()?;
        add(bill, native)?;
    }
    Ok(bills)
}

/// A package of the workspace.
struct Package {
    name: String,
    directory: PathBuf,
}

fn packages() -> Result<Vec<Package>> {
    let output =
        cargo().args(["metadata", "--no-deps", "--format-version=1"]).output().context("cannot start cargo")?;
    let metadata: Value = serde_json::from_slice(&output.stdout).context("cargo metadata wrote no JSON")?;
    let packages = metadata["packages"].as_array().context("cargo metadata lists no packages")?;
    let package = |value: &Value| {
        let (name, manifest) = (value["name"].as_str()?, value["manifest_path"].as_str()?);
        Some(Package { name: name.to_owned(), directory: Path::new(manifest).parent()?.to_path_buf() })
    };
    Ok(packages.iter().filter_map(package).collect())
}

/// What cargo-cyclonedx says about these programs.
fn list_crates(packages: &[Package], programs: &[&str], date: u64) -> Result<Vec<Value>> {
    let tools = workspace::dependencies().join("tools");
    install(&tools)?;
    let mut cyclonedx = std::process::Command::new(tools.join("bin").join(CYCLONEDX));
    cyclonedx.args(["cyclonedx", "--quiet", "--format=json", "--spec-version=1.5", "--no-build-deps"]);
    cyclonedx.args(["--target", TARGET, "--override-filename", OUTPUT]).current_dir(root());
    // Its times are this date, and it draws no serial number.
    run(cyclonedx.env("SOURCE_DATE_EPOCH", date.to_string()))?;
    let read = |program: &&str| {
        let package = packages.iter().find(|package| package.name == **program);
        let package = package.with_context(|| format!("the workspace has no package {program}"))?;
        let path = package.directory.join(format!("{OUTPUT}.json"));
        let text =
            fs::read_to_string(&path).with_context(|| format!("{CYCLONEDX} did not write {}", path.display()))?;
        // The names of our own crates have the repository's path.
        Ok(serde_json::from_str(&text.replace(&format!("{}/", root().display()), ""))?)
    };
    programs.iter().map(read).collect()
}

/// Installs cargo-cyclonedx in `tools`, unless this version is there.
fn install(tools: &Path) -> Result<()> {
    let installed =
        std::process::Command::new(tools.join("bin").join(CYCLONEDX)).args(["cyclonedx", "--version"]).output();
    if installed.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).trim_end().ends_with(VERSION)) {
        return Ok(());
    }
    eprintln!("installing {CYCLONEDX} {VERSION} in {}: some minutes, once", tools.display());
    let mut install = cargo();
    install.args(["install", "--locked", "--force", CYCLONEDX, "--version", VERSION, "--root"]).arg(tools);
    run(&mut install).context("the bill of materials needs cargo-cyclonedx, and its installation needs crates.io")
}

/// A native library, with the hash of the wheel that it comes from and of each file in `tree`.
fn component(library: &Library, tree: &Path) -> Result<Value> {
    let (version, sha256) = library.pin()?;
    let wheel = comic_setup::pin(library.wheel).map_or(version, |(version, _)| version);
    let purl = format!("pkg:pypi/{}@{wheel}", library.wheel);
    let files = library.files.iter().map(|file| {
        let name = Path::new(file).file_name().with_context(|| format!("{file} has no name"))?;
        let path = Path::new("lib").join(name);
        let hash = archive::sha256(&tree.join(&path))?;
        Ok(json!({"type": "file", "name": path, "hashes": [{"alg": "SHA-256", "content": hash}]}))
    });
    let licence = match library.licence {
        Licence::Spdx(expression) => json!({"expression": expression}),
        Licence::Named(name) => json!({"license": {"name": name}}),
    };
    let origin = json!({
        "type": "distribution",
        "url": format!("https://pypi.org/project/{}/{wheel}/", library.wheel),
        "hashes": [{"alg": "SHA-256", "content": sha256}],
    });
    Ok(json!({
        "type": "library",
        "bom-ref": format!("native:{}@{version}", library.name),
        "name": library.name,
        "version": version,
        "scope": "required",
        "licenses": [licence],
        "purl": purl,
        "externalReferences": [origin],
        "components": files.collect::<Result<Vec<_>>>()?,
    }))
}

/// Adds components to a bill, as dependencies of the program that it describes.
fn add(bill: &mut Value, native: Vec<Value>) -> Result<()> {
    let program = bill["metadata"]["component"]["bom-ref"].clone();
    let names: Vec<_> = native.iter().map(|component| component["bom-ref"].clone()).collect();
    let dependencies = bill["dependencies"].as_array_mut().context("a bill without dependencies")?;
    let own = dependencies.iter_mut().find(|entry| entry["ref"] == program);
    let own = own.context("a bill that does not list the program's dependencies")?;
    own["dependsOn"].as_array_mut().context("a program without crates")?.extend(names.iter().cloned());
    dependencies.extend(names.into_iter().map(|name| json!({"ref": name})));
    bill["components"].as_array_mut().context("a bill without components")?.extend(native);
    Ok(())
}

/// The names of the crates of a bill, as `cargo metadata` names packages.
pub(super) fn crates(bill: &Value) -> BTreeSet<String> {
    let components = bill["components"].as_array().into_iter().flatten();
    components.filter_map(|component| component["bom-ref"].as_str()).map(str::to_owned).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bill() -> Value {
        json!({
            "metadata": {"component": {"bom-ref": "comic-learner"}},
            "components": [{"bom-ref": "tch", "name": "tch"}],
            "dependencies": [{"ref": "comic-learner", "dependsOn": ["tch"]}, {"ref": "tch"}],
        })
    }

    #[test]
    fn a_native_library_is_listed_with_its_pin_and_the_hashes_of_the_shipped_files() {
        let tree = tempfile::tempdir().unwrap();
        fs::create_dir(tree.path().join("lib")).unwrap();
        fs::write(tree.path().join("lib/libgomp.so.1"), "abc").unwrap();
        let library = libraries::of("comic-learner").find(|library| library.name == "libgomp").unwrap();
        let component = component(library, tree.path()).unwrap();
        let (wheel, pinned) = comic_setup::pin("torch").unwrap();
        assert_eq!(component["version"], "8.5.0");
        assert_eq!(component["purl"], format!("pkg:pypi/torch@{wheel}"));
        assert_eq!(component["externalReferences"][0]["hashes"][0]["content"], pinned);
        assert_eq!(component["licenses"][0]["expression"], "GPL-3.0-or-later WITH GCC-exception-3.1");
        let file = &component["components"][0];
        assert_eq!(file["name"], "lib/libgomp.so.1");
        // FIPS 180-2, appendix B.1.
        let abc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(file["hashes"][0]["content"], abc);
    }

    #[test]
    fn native_libraries_become_components_and_dependencies_of_the_program() {
        let mut bill = bill();
        add(&mut bill, vec![json!({"bom-ref": "native:libgomp@8.5.0"})]).unwrap();
        assert_eq!(bill["components"][1]["bom-ref"], "native:libgomp@8.5.0");
        assert_eq!(bill["dependencies"][0]["dependsOn"], json!(["tch", "native:libgomp@8.5.0"]));
        assert_eq!(bill["dependencies"][2], json!({"ref": "native:libgomp@8.5.0"}));
    }

    #[test]
    fn only_the_actor_lists_mujoco() {
        let names = |program| libraries::of(program).map(|library| library.name).collect::<Vec<_>>();
        assert!(names("comic-actor").contains(&"libmujoco"));
        assert!(!names("comic-learner").contains(&"libmujoco"));
        assert!(names("comic-learner").contains(&"libtorch"));
    }
}
