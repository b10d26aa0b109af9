//! `comic-actor assess`: what a low level does with random latents, before anything is learned with it.
//!
//! A low level that falls at once under random latents gives a new policy nothing to explore with. Each row of the table is
//! one source of latents, from the same starts: frames of the clips. An episode ends when the head is below 1.2 m, or after
//! the time limit. The gate is the verdict.

mod fall;
mod gate;
mod row;
mod source;

use std::io::{IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use comic_clips::Catalogue;
use comic_experiment::{ACTION_SIZE, Experiment, StartPose, TaskName, Transfer, TransferPrior};
use comic_networks::FrozenLowLevel;
use comic_networks::export::Exported;
use comic_proto::{Field, UnrollShape};
use comic_tasks::Task;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;
use serde::Serialize;

use self::fall::FallRecorder;
use self::gate::{Gate, verdict};
use self::row::{Row, table};
use self::source::{SOURCES, Source};
use crate::Error;
use crate::acting_loop::{ActingLoop, Controller};
use crate::film::recorder::{Look, Recorder as Film};
use crate::forward_pass::{ActingBatch, ForwardPass, LowLevelShape};
use crate::policy::actuate;

/// Environments in a forward pass.
const ENVIRONMENTS: usize = 16;

/// Seconds upright, metres walked and the spread of headings under p(z | s), its mean, N(0, I) and z = 0, and of an untrained
/// low level; and whether a new policy can explore with the low level.
#[derive(Args, Clone, Debug)]
pub struct Assess {
    /// A file of `comic-learner export --part low-level`, with or without the prior of `comic-learner prior`; or `builtin`.
    #[arg(long, value_name = "FILE")]
    low_level: PathBuf,
    /// Clips whose frames are the starts: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP. The clips of the low
    /// level's own run unless given.
    #[arg(long, value_name = "SOURCE", num_args = 1..)]
    clips: Vec<String>,
    /// Episodes of each row.
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=4096))]
    episodes: u32,
    /// Seconds of an episode, at most. The verdict asks for a median of 4 s.
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, value_parser = seconds)]
    seconds: f64,
    /// Seed of the latents.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// JSON instead of a table.
    #[arg(long)]
    json: bool,
    /// Draws the first episode of each row into this directory, a contact sheet each.
    #[arg(long, value_name = "DIR")]
    sheets: Option<PathBuf>,
}

impl Assess {
    /// Rolls out every source and prints the table.
    ///
    /// # Errors
    /// A low level or clips that cannot be used, a failing forward pass or film.
    pub fn run(&self) -> Result<(), Error> {
        let refuse = |error: comic_networks::Error| Error::Usage(format!("{}: {error}", self.low_level.display()));
        let file = Exported::open_or_builtin(&self.low_level).map_err(refuse)?;
        let untrained = file.untrained(self.seed).map_err(refuse)?;
        let task = self.task(&file)?;
        let has_prior = file.spec.prior.is_some();
        if !has_prior {
            tracing::info!("the low level has no prior of the state; `comic-learner prior` fits one");
        }
        let mut rows = Vec::new();
        for source in SOURCES.into_iter().filter(|source| has_prior || source.prior == TransferPrior::Standard) {
            let transfer = Transfer { prior: source.prior, ..Transfer::default() };
            let low_level = if source.trained { &file } else { &untrained }.freeze(&transfer).map_err(refuse)?;
            let latent = file.experiment.network.latent.size;
            let sheet = self.sheets.as_ref().map(|directory| directory.join(format!("{}.png", source.file)));
            rows.push(self.roll_out(source, low_level, latent, &task, sheet.as_deref())?);
        }
        let gate = Gate::new(&rows);
        let assessment = Assessment { rows, gate };
        let text = if self.json { assessment.json()? } else { assessment.text() };
        std::io::stdout().write_all(text.as_bytes()).map_err(Error::file("standard output"))
    }

    /// Go-to-target from frames of the clips; the target does not matter.
    fn task(&self, file: &Exported) -> Result<Arc<dyn Task>, Error> {
        let mut experiment = Experiment { clips: file.experiment.clips.clone(), ..Experiment::default() };
        experiment.task = TaskName::GoToTarget;
        experiment.go_to_target.start_pose = StartPose::Clip;
        experiment.go_to_target.time_limit = self.seconds;
        let experiment = experiment.with_clips(&self.clips);
        let catalogue = Catalogue::open(&experiment.clips)?;
        Ok(comic_tasks::build(&experiment, &catalogue)?)
    }

    fn roll_out(
        &self,
        source: Source,
        low_level: FrozenLowLevel,
        latent: usize,
        task: &Arc<dyn Task>,
        sheet: Option<&Path>,
    ) -> Result<Row, Error> {
        let (environments, all) = (ENVIRONMENTS.min(self.episodes as usize), self.episodes as usize);
        let rng = Pcg64::seed_from_u64(self.seed);
        let film = sheet.map(|path| film(path, task.control_timestep())).transpose()?;
        let mut recorder = FallRecorder::new(task, environments, all, film, rng);
        let shape = UnrollShape { action: latent, ..UnrollShape::new(task.spec(), &Experiment::default()) };
        let shape = UnrollShape { latent: 0, components: 1, state: 0, ..shape };
        let mut policy = RandomLatents { low_level, std: source.std };
        let environments = (0..environments as u64).map(|number| Arc::clone(task).environment(number));
        let mut acting = ActingLoop::new(environments.collect::<Result<_, _>>()?, &shape, policy.low_level());
        for (index, rollout) in acting.rollouts.iter_mut().enumerate() {
            recorder.begin_next(index, rollout, &mut acting.batch.row(index))?;
        }
        let mut controller = Controller::Policy(&mut policy);
        while recorder.finished.len() < all {
            let _ = acting.iterate(&mut controller, &mut recorder)?;
        }
        if let Some(film) = recorder.film {
            film.finish()?;
        }
        let row = Row::new(source.name, &recorder.finished);
        if !std::io::stderr().is_terminal() {
            let Row { latents, seconds_upright, metres, .. } = row;
            tracing::info!(latents, seconds_upright, metres, "assessed");
        }
        Ok(row)
    }
}

/// A contact sheet.
fn film(path: &Path, timestep: f64) -> Result<Film, Error> {
    let directory = path.parent().unwrap_or(Path::new("."));
    std::fs::create_dir_all(directory).map_err(Error::file(directory))?;
    Film::new(&Look::sheet(), path, timestep)
}

/// A policy that looks at nothing: N(0, σ²) for every entry of its action.
#[derive(Debug)]
struct RandomLatents {
    low_level: FrozenLowLevel,
    std: f32,
}

impl ForwardPass for RandomLatents {
    fn load(&mut self, _parameters: &[u8]) -> Result<(), Error> {
        Ok(())
    }

    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        batch[Field::Mean].fill(0.0);
        batch[Field::Std].fill(self.std);
        Ok(())
    }

    fn low_level(&self) -> Option<LowLevelShape> {
        Some(LowLevelShape { command: ACTION_SIZE, state: self.low_level.state_size() })
    }

    fn actuate(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        actuate(&self.low_level, batch)
    }
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Assessment {
    rows: Vec<Row>,
    /// `null` if the low level has no prior of the state.
    gate: Option<Gate>,
}

impl Assessment {
    fn json(&self) -> Result<String, Error> {
        let text = serde_json::to_string_pretty(self);
        text.map(|text| text + "\n").map_err(|error| Error::Usage(format!("cannot write the table as JSON: {error}")))
    }

    fn text(&self) -> String {
        table(&self.rows) + "\n" + &verdict(self.gate.as_ref())
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds) if seconds > 0.0 && seconds <= 3600.0 => Ok(seconds),
        _ => Err("must be positive seconds, at most 3600".into()),
    }
}
