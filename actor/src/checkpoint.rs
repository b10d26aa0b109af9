//! Reads checkpoints; only the learner writes them.
//!
//! A checkpoint is a directory whose `MANIFEST.json` maps each file's name to its SHA-256 (hexadecimal). Of its files
//! three matter here: `experiment.toml`, `progress.json`, and `policy.safetensors`, the parameters of the online policy. A
//! file that `comic-learner export` made of a checkpoint can be read too. In transfer there is also `low_level.safetensors`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use comic_experiment::Experiment;
use comic_networks::export::{Exported, Part, Source};
use sha2::{Digest as _, Sha256};

use crate::Error;

const MANIFEST: &str = "MANIFEST.json";
const EXPERIMENT: &str = "experiment.toml";
const PROGRESS: &str = "progress.json";
const POLICY: &str = "policy.safetensors";
/// In transfer: the file of the frozen low level.
const LOW_LEVEL: &str = "low_level.safetensors";
/// What a path has to name.
const WANTED: &str = "name a run's directory (runs/… of `cargo xtask train`), its `checkpoints`, one of them, or a file of `comic-learner export`";

/// What acting needs of a checkpoint.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// The checkpoint's directory, or the file.
    pub path: PathBuf,
    /// The experiment it belongs to.
    pub experiment: Experiment,
    /// Parameters of the online policy (safetensors).
    pub policy: Vec<u8>,
    /// In transfer: the file of the frozen low level.
    pub low_level: Option<Vec<u8>>,
    /// Where the run stood.
    pub position: Position,
}

/// The run and the learner epoch that wrote a checkpoint, and the newest version it had published.
#[derive(Clone, Copy, Debug, Default, serde::Deserialize)]
pub struct Position {
    /// The run's number; `None` in checkpoints of learners without one, and in exported files.
    pub run: Option<u64>,
    /// The learner epoch.
    pub epoch: u64,
    /// The newest version published.
    pub version: u64,
    /// Updates until then; checkpoints are named by this number.
    pub updates: u64,
}

/// What matters here of `progress.json`.
#[derive(serde::Deserialize)]
struct Progress {
    format: Option<u32>,
    #[serde(flatten)]
    position: Position,
}

/// Reads the newest complete checkpoint that `path` names: a run directory (which holds `checkpoints/`), a directory of
/// checkpoints (`checkpoint-NNNNNNNNNN`), or one checkpoint. If `path` is a file, reads the policy that was exported to it.
/// A damaged checkpoint among several is skipped with a warning.
///
/// # Errors
/// [`Error::Checkpoint`] when there is none, or the one that was named is damaged.
pub fn read(path: &Path) -> Result<Checkpoint, Error> {
    if path.is_file() {
        return read_exported(path);
    }
    if path.join(MANIFEST).is_file() {
        return read_one(path);
    }
    if !path.is_dir() {
        return Err(refuse(path, format!("no such directory; {WANTED}")));
    }
    let below = path.join("checkpoints");
    let directory = if below.is_dir() { below } else { path.to_path_buf() };
    for candidate in numbered(&directory)?.into_iter().rev() {
        match read_one(&candidate) {
            Ok(checkpoint) => return Ok(checkpoint),
            Err(error @ Error::CheckpointFormat { .. }) => return Err(error),
            // With its causes: the last one says what is wrong.
            Err(error) => tracing::warn!("skipped a damaged checkpoint: {:#}", anyhow::Error::from(error)),
        }
    }
    Err(refuse(path, format!("no complete checkpoint here; {WANTED}")))
}

fn read_exported(path: &Path) -> Result<Checkpoint, Error> {
    let exported = Exported::open(path).map_err(|error| refuse(path, error))?;
    let low_level = exported.low_level_file().map_err(|error| refuse(path, error))?.map(<[u8]>::to_vec);
    let policy = exported.parameters().map_err(|error| refuse(path, error))?;
    let Exported { spec, experiment, .. } = exported;
    if !matches!(spec.part, Part::Policy(_)) {
        let part = spec.part;
        return Err(refuse(path, format!("{part} cannot act alone: export a policy with --part policy")));
    }
    let Source { epoch, version, updates, .. } = spec.source;
    let position = Position { run: None, epoch, version, updates };
    Ok(Checkpoint { path: path.to_path_buf(), experiment, policy, low_level, position })
}

/// Numbered checkpoints, oldest first: the numbers are zero-padded.
fn numbered(directory: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(|error| refuse(directory, error))? {
        let entry = entry.map_err(|error| refuse(directory, error))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let digits = name.strip_prefix("checkpoint-").unwrap_or_default();
        if digits.len() == 10 && digits.bytes().all(|byte| byte.is_ascii_digit()) && entry.path().is_dir() {
            found.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

fn read_one(path: &Path) -> Result<Checkpoint, Error> {
    let manifest = std::fs::read(path.join(MANIFEST)).map_err(|error| refuse(path, format!("{MANIFEST}: {error}")))?;
    let manifest: BTreeMap<String, String> =
        serde_json::from_slice(&manifest).map_err(|error| refuse(path, format!("{MANIFEST}: {error}")))?;
    let Progress { format, position } = serde_json::from_slice(&part(path, &manifest, PROGRESS)?)
        .map_err(|error| refuse(path, format!("{PROGRESS}: {error}")))?;
    // First, because the parts of another format may have another meaning.
    comic_experiment::check_checkpoint_format(format)
        .map_err(|source| Error::CheckpointFormat { path: path.to_path_buf(), source })?;
    let experiment = String::from_utf8(part(path, &manifest, EXPERIMENT)?)
        .map_err(|error| refuse(path, format!("{EXPERIMENT}: {error}")))?;
    let experiment = Experiment::from_toml(&path.join(EXPERIMENT).display().to_string(), &experiment)?;
    let policy = part(path, &manifest, POLICY)?;
    let low_level = experiment.transfer.is_on().then(|| part(path, &manifest, LOW_LEVEL)).transpose()?;
    Ok(Checkpoint { path: path.to_path_buf(), experiment, policy, low_level, position })
}

fn part(path: &Path, manifest: &BTreeMap<String, String>, name: &str) -> Result<Vec<u8>, Error> {
    let expected = manifest.get(name).ok_or_else(|| refuse(path, format!("{MANIFEST} does not name {name}")))?;
    let bytes = std::fs::read(path.join(name)).map_err(|error| refuse(path, format!("{name}: {error}")))?;
    if hex::encode(Sha256::digest(&bytes)) == *expected {
        Ok(bytes)
    } else {
        Err(refuse(path, format!("{name} is damaged: its SHA-256 differs")))
    }
}

fn refuse(path: &Path, reason: impl ToString) -> Error {
    Error::Checkpoint { path: path.to_path_buf(), reason: reason.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(path: &Path, policy: &[u8]) {
        std::fs::create_dir_all(path).unwrap();
        let mut manifest = BTreeMap::new();
        let experiment = Experiment::default().to_toml().unwrap();
        let progress = br#"{"format": 2, "epoch": 2, "version": 30, "updates": 29}"#;
        for (name, bytes) in [(EXPERIMENT, experiment.as_bytes()), (PROGRESS, progress), (POLICY, policy)] {
            std::fs::write(path.join(name), bytes).unwrap();
            manifest.insert(name, hex::encode(Sha256::digest(bytes)));
        }
        std::fs::write(path.join(MANIFEST), serde_json::to_vec(&manifest).unwrap()).unwrap();
    }

    fn run_with_two() -> tempfile::TempDir {
        let run = tempfile::tempdir().unwrap();
        write(&run.path().join("checkpoints/checkpoint-0000000009"), b"older");
        write(&run.path().join("checkpoints/checkpoint-0000000010"), b"newer");
        run
    }

    #[test]
    fn a_run_its_checkpoints_and_a_single_one_can_be_named() {
        let run = run_with_two();
        assert_eq!(read(run.path()).unwrap().policy, b"newer");
        assert_eq!(read(&run.path().join("checkpoints")).unwrap().policy, b"newer");
        assert_eq!(read(&run.path().join("checkpoints/checkpoint-0000000009")).unwrap().policy, b"older");
    }

    #[test]
    fn a_damaged_checkpoint_is_skipped_but_refused_when_named() {
        let run = run_with_two();
        let newest = run.path().join("checkpoints/checkpoint-0000000010");
        std::fs::write(newest.join(POLICY), b"altered").unwrap();
        assert_eq!(read(run.path()).unwrap().policy, b"older");
        let error = read(&newest).unwrap_err();
        assert!(error.is_configuration() && error.to_string().contains("SHA-256 differs"), "{error}");
    }

    /// It is whole, so the older ones are of that release, too.
    #[test]
    fn a_checkpoint_of_another_format_is_refused_and_not_skipped() {
        let run = run_with_two();
        let newest = run.path().join("checkpoints/checkpoint-0000000010");
        let progress = br#"{"epoch": 2, "version": 30, "updates": 29}"#;
        std::fs::write(newest.join(PROGRESS), progress).unwrap();
        let manifest = std::fs::read(newest.join(MANIFEST)).unwrap();
        let mut manifest: BTreeMap<String, String> = serde_json::from_slice(&manifest).unwrap();
        manifest.insert(PROGRESS.into(), hex::encode(Sha256::digest(progress)));
        std::fs::write(newest.join(MANIFEST), serde_json::to_vec(&manifest).unwrap()).unwrap();
        let error = read(run.path()).unwrap_err();
        let said = format!("{:#}", anyhow::Error::from(error));
        assert!(said.contains("has format 1, and this release reads format 2"), "{said}");
    }

    #[test]
    fn an_incomplete_checkpoint_is_skipped() {
        let run = run_with_two();
        std::fs::remove_file(run.path().join("checkpoints/checkpoint-0000000010").join(MANIFEST)).unwrap();
        assert_eq!(read(run.path()).unwrap().policy, b"older");
    }

    #[test]
    fn an_empty_directory_holds_none() {
        let empty = tempfile::tempdir().unwrap();
        assert!(read(empty.path()).unwrap_err().to_string().contains("no complete checkpoint"));
    }

    #[test]
    fn a_file_that_is_no_export_is_refused_with_its_name() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("policy.safetensors");
        for bytes in [&b""[..], b"not one", &[255; 64], b"\x02\0\0\0\0\0\0\0{}"] {
            std::fs::write(&path, bytes).unwrap();
            let error = read(&path).unwrap_err();
            assert!(error.is_configuration() && error.to_string().contains("policy.safetensors"), "{error}");
        }
    }
}
