//! Compares the tracking environment with recorded rollouts.

use std::path::PathBuf;
use std::sync::Arc;

use comic_clips::Catalogue;
use comic_experiment::{ClipSource, TRACKING_REWARD_TERMS, Tracking};
use comic_tasks::{Environment, Outcome, Simulated, Step, TrackingEnvironment, TrackingTask};

use crate::recording::{Rollout, files, workspace};

/// Compares every number of every row. The error is the first difference, with file, row and quantity.
pub(crate) fn compare(rollout: &Rollout) -> Result<(), String> {
    let channels: Vec<String> = rollout.array("reward_channels")?.texts()?.to_vec();
    if channels != TRACKING_REWARD_TERMS {
        return Err(format!("{}: reward_channels: {channels:?} recorded", rollout.file));
    }
    let mut environment = environment(rollout)?;
    let warm = rollout.array("qacc_warmstart_after_reset")?.numbers()?;
    rollout.equal(0, "qacc_warmstart_after_reset", warm, environment.simulation().qacc_warmstart(), 0.0)?;
    compare_row(rollout, 0, &environment, None)?;
    for (row, control) in (1..).zip(rollout.controls()?) {
        let step = environment.step_control(control);
        compare_row(rollout, row, &environment, Some(step))?;
    }
    Ok(())
}

fn compare_row(
    rollout: &Rollout,
    row: usize,
    environment: &TrackingEnvironment,
    step: Option<Step>,
) -> Result<(), String> {
    rollout.compare_common(row, environment, step)?;
    rollout.exact(row, "mocap_step", &[environment.frame() as f64])?;
    rollout.close(row, "termination_error", &[environment.termination_error()])?;
    rollout.compare_observations(row, &environment.dictionary())?;
    let Some(step) = step else { return rollout.exact(row, "reward_terms", &[0.0; 5]) };
    rollout.close(row, "reward_terms", &step.reward_terms)?;
    // These are flags of the last step. At a reset dm_control keeps those of the previous episode.
    rollout.exact(row, "truncate", &[f64::from(u8::from(step.outcome == Outcome::Terminated))])?;
    let episode = environment.episode();
    let at_the_end = environment.frame() == episode.start + episode.steps_left;
    rollout.exact(row, "end_mocap", &[f64::from(u8::from(at_the_end))])
}

/// Finds the file that contains the rollout's clip.
fn clip_file(rollout: &Rollout, clip: &str) -> Result<PathBuf, String> {
    let wheel = std::env::var_os("COMIC_DM_CONTROL_DIR")
        .map_or_else(|| workspace().join(".deps/dm_control"), |directory| workspace().join(directory));
    let mut candidates = files(&rollout.folder, "h5")?;
    candidates.push(wheel.join("test_trajectories.h5"));
    let mut searched = Vec::new();
    for path in candidates {
        match Catalogue::open(&[ClipSource::whole(path.to_string_lossy())]) {
            Ok(catalogue) if catalogue.entries().iter().any(|entry| entry.name == clip) => return Ok(path),
            Ok(_) => searched.push(path.display().to_string()),
            Err(error) => searched.push(error.to_string()),
        }
    }
    Err(format!("{}: clip `{clip}` is in none of: {}", rollout.file, searched.join("; ")))
}

fn environment(rollout: &Rollout) -> Result<TrackingEnvironment, String> {
    let fail = |error: &dyn std::fmt::Display| format!("{}: {error}", rollout.file);
    let clip = rollout.array("clip_id")?.text()?;
    let index = rollout.scalar("clip")?;
    let layout = rollout.layout()?;
    let size = |name: &str| layout.iter().find(|(known, _)| known == name).map_or(0, |(_, size)| *size);
    let config = Tracking {
        reference_steps: (1..=size("walker/reference_appendages_pos") / 15).collect(),
        min_steps: 1,
        ..Tracking::default()
    };
    let source =
        ClipSource { ids: vec![clip.into()], ..ClipSource::whole(clip_file(rollout, clip)?.to_string_lossy()) };
    // The clip's index is an observation: its place in the recording's list of clips. That list is not recorded, so copies
    // of the clip fill the places before it.
    let catalogue = Catalogue::open(&vec![source; index + 1]).map_err(|error| fail(&error))?;
    let task = Arc::new(TrackingTask::comparison(&config, &catalogue).map_err(|error| fail(&error))?);
    let mut environment = task.tracking_environment(0);
    environment.reset_to(index, rollout.scalar("start")?).map_err(|error| fail(&error))?;
    Ok(environment)
}
