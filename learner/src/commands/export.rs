//! `comic-learner export`: writes a checkpoint's policy, or a part of it, to a file for other programs.

use std::path::Path;

use comic_experiment::Experiment;
use comic_networks::export::{Exported, Part, Source};

use crate::checkpoint::progress::Progress;
use crate::checkpoint::snapshot::LOW_LEVEL;
use crate::checkpoint::{self, Snapshot};
use crate::error::{Error, Result};

/// The format of a file, which its extension names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Safetensors,
    TorchScript,
    Onnx,
}

/// Writes `part` of the newest checkpoint at `path` to `out`. It is a part of the online policy, as in evaluations.
///
/// # Errors
/// [`Error::Configuration`] when `path` names no whole checkpoint; no such part in it, an extension other than `.safetensors`,
/// `.pt` and `.onnx`, or a disk that fails.
pub fn run(path: &Path, part: Part, out: &Path) -> Result<()> {
    let format = format_of(out)?;
    let (place, snapshot) = checkpoint::find(path)?;
    let exported =
        read(&place, part, &snapshot).map_err(Error::within(format!("cannot export {}", place.display())))?;
    let failed = || Error::within(format!("cannot write {}", out.display()));
    let write = |bytes: &[u8]| std::fs::write(out, bytes).map_err(Error::file("write", out));
    match format {
        Format::Safetensors => write(&exported.bytes)?,
        Format::TorchScript => exported.save_script(out).map_err(failed())?,
        Format::Onnx => write(&exported.to_onnx().map_err(failed())?)?,
    }
    tracing::info!(checkpoint = %place.display(), %part, out = %out.display(), "exported");
    Ok(())
}

fn format_of(out: &Path) -> Result<Format> {
    match out.extension().and_then(|extension| extension.to_str()) {
        Some("safetensors") => Ok(Format::Safetensors),
        Some("pt") => Ok(Format::TorchScript),
        Some("onnx") => Ok(Format::Onnx),
        _ => Err(Error::configuration(format!(
            "--out {}: name it .safetensors, .pt for TorchScript, or .onnx for ONNX",
            out.display()
        ))),
    }
}

/// Makes the file's contents of a snapshot.
///
/// # Errors
/// A part that is missing, or does not fit the snapshot's experiment.
pub(crate) fn read(place: &Path, part: Part, snapshot: &Snapshot) -> Result<Exported> {
    let experiment = Experiment::from_toml("experiment.toml of the checkpoint", snapshot.text("experiment.toml")?)?;
    let progress: Progress =
        serde_json::from_slice(snapshot.part("progress.json")?).map_err(Error::json("the checkpoint's progress"))?;
    let name = |path: Option<&Path>| {
        path.and_then(Path::file_name).map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
    };
    // RUN/checkpoints/NAME, whatever the working directory is.
    let place = std::path::absolute(place).map_err(Error::file("find", place))?;
    let source = Source {
        program: concat!(env!("CARGO_PKG_NAME"), " ", env!("CARGO_PKG_VERSION")).into(),
        run: name(place.ancestors().nth(2)),
        checkpoint: name(Some(&place)),
        updates: progress.updates,
        environment_steps: progress.environment_steps,
        epoch: progress.epoch,
        version: progress.version,
        seed: experiment.seed,
    };
    let low_level = experiment.transfer.is_on().then(|| snapshot.part(LOW_LEVEL)).transpose()?;
    Ok(Exported::new(part, &experiment, source, snapshot.part("policy.safetensors")?, low_level)?)
}
