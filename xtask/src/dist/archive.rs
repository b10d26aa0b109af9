//! Archives and checksums that depend on the files' content alone: the same tree gives the same bytes.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use flate2::{Compression, GzBuilder};
use sha2::{Digest, Sha256};
use tar::{Builder, Header, HeaderMode};

/// Writes the directory `tree` with all its files as `archive`, a `.tar.gz` of one directory with the tree's name.
///
/// Names are sorted, the owner is root, the mode is 755 or 644, and every file has the time `modified`, in seconds since 1970.
pub(super) fn pack(tree: &Path, archive: &Path, modified: u64) -> Result<()> {
    let name = Path::new(tree.file_name().with_context(|| format!("{} has no name", tree.display()))?);
    let file = File::create(archive).with_context(|| format!("cannot write {}", archive.display()))?;
    let mut builder = Builder::new(GzBuilder::new().mtime(0).write(BufWriter::new(file), Compression::default()));
    for path in paths_below(tree)? {
        append(&mut builder, &path, &name.join(path.strip_prefix(tree)?), modified)
            .with_context(|| format!("cannot pack {}", path.display()))?;
    }
    let written = builder.into_inner().and_then(flate2::write::GzEncoder::finish).and_then(|mut file| file.flush());
    written.with_context(|| format!("cannot write {}", archive.display()))
}

fn append(builder: &mut Builder<impl Write>, path: &Path, name: &Path, modified: u64) -> Result<()> {
    let metadata = fs::metadata(path)?;
    let mut header = Header::new_gnu();
    header.set_metadata_in_mode(&metadata, HeaderMode::Deterministic);
    header.set_mtime(modified);
    if metadata.is_dir() {
        builder.append_data(&mut header, name, io::empty())?;
    } else {
        builder.append_data(&mut header, name, BufReader::new(File::open(path)?))?;
    }
    Ok(())
}

/// `directory` and everything below it, sorted; links are followed.
pub(super) fn paths_below(directory: &Path) -> Result<Vec<PathBuf>> {
    let mut paths = vec![directory.to_path_buf()];
    let mut next = 0;
    while let Some(path) = paths.get(next).cloned() {
        next += 1;
        if path.is_dir() {
            let entries = fs::read_dir(&path).with_context(|| format!("cannot list {}", path.display()))?;
            for entry in entries {
                paths.push(entry?.path());
            }
        }
    }
    paths.sort();
    Ok(paths)
}

/// The SHA-256 of a file, hexadecimal.
pub(super) fn sha256(path: &Path) -> Result<String> {
    let mut hash = Sha256::new();
    let read = File::open(path).and_then(|mut file| io::copy(&mut file, &mut hash));
    read.with_context(|| format!("cannot read {}", path.display()))?;
    Ok(hex::encode(hash.finalize()))
}

/// Lines of files and their SHA-256, as `sha256sum --check` reads them in the directory of the files.
pub(super) fn checksums(files: &[PathBuf]) -> Result<String> {
    let mut lines = String::new();
    for file in files {
        let name = file.file_name().with_context(|| format!("{} has no name", file.display()))?;
        lines += &format!("{}  {}\n", sha256(file)?, name.to_string_lossy());
    }
    Ok(lines)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;
    use std::process::Command;
    use std::time::{Duration, SystemTime};

    use super::*;

    /// A tree of a program and a text, which are made in this order, at this time, and with these modes.
    fn tree(directory: &Path, order: [usize; 2], modified: SystemTime, modes: [u32; 2]) -> PathBuf {
        let tree = directory.join("comic-1.0.0");
        let files = [("bin/comic", modes[0]), ("share/doc/README.md", modes[1])];
        for (name, mode) in order.map(|index| files[index]) {
            let path = tree.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, name).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            File::open(&path).unwrap().set_modified(modified).unwrap();
        }
        tree
    }

    #[test]
    fn equal_trees_give_equal_archives_whenever_and_by_whomever_they_were_made() {
        let directories = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let now = SystemTime::now();
        let first = tree(directories[0].path(), [0, 1], now, [0o755, 0o644]);
        let second = tree(directories[1].path(), [1, 0], now - Duration::from_secs(9999), [0o700, 0o600]);
        let archives = [first, second].map(|tree| {
            let archive = tree.with_extension("tar.gz");
            pack(&tree, &archive, 1_700_000_000).unwrap();
            fs::read(archive).unwrap()
        });
        assert_eq!(archives[0], archives[1]);
    }

    #[test]
    fn an_archive_has_one_directory_owned_by_root_with_sorted_names_and_the_given_time() {
        let directory = tempfile::tempdir().unwrap();
        let tree = tree(directory.path(), [1, 0], SystemTime::now(), [0o755, 0o644]);
        let archive = directory.path().join("a.tar.gz");
        pack(&tree, &archive, 1_700_000_000).unwrap();
        let mut tar = Command::new("tar");
        tar.args(["--list", "--verbose", "--numeric-owner", "--utc", "--file"]).arg(&archive).env("LC_ALL", "C");
        let output = tar.output().unwrap();
        let listed = String::from_utf8(output.stdout).unwrap().replace("/\n", "\n");
        let entries: Vec<Vec<_>> = listed.lines().map(|line| line.split_whitespace().collect()).collect();
        let entry = |mode, size, name| vec![mode, "0/0", size, "2023-11-14", "22:13", name];
        assert_eq!(
            entries,
            [
                entry("drwxr-xr-x", "0", "comic-1.0.0"),
                entry("drwxr-xr-x", "0", "comic-1.0.0/bin"),
                entry("-rwxr-xr-x", "9", "comic-1.0.0/bin/comic"),
                entry("drwxr-xr-x", "0", "comic-1.0.0/share"),
                entry("drwxr-xr-x", "0", "comic-1.0.0/share/doc"),
                entry("-rw-r--r--", "19", "comic-1.0.0/share/doc/README.md"),
            ]
        );
    }

    #[test]
    fn checksums_are_what_sha256sum_checks() {
        let directory = tempfile::tempdir().unwrap();
        let files = ["a.tar.gz", "b c.whl"].map(|name| directory.path().join(name));
        files.iter().for_each(|file| fs::write(file, "abc").unwrap());
        fs::write(directory.path().join("SHA256SUMS"), checksums(&files).unwrap()).unwrap();
        let check = || {
            let mut command = Command::new("sha256sum");
            command.args(["--check", "--strict", "SHA256SUMS"]).current_dir(directory.path()).output().unwrap()
        };
        assert!(check().status.success());
        fs::write(&files[1], "abd").unwrap();
        let output = check();
        assert!(!output.status.success());
        assert!(String::from_utf8_lossy(&output.stdout).contains("b c.whl: FAILED"));
    }
}
