//! `comic-actor assess`: what a low level does with random latents, before anything is learned with it.
//!
//! A low level that falls at once under random latents gives a new policy nothing to explore with. Each row of the table is
//! one source of latents, from the same starts: frames of the clips. An episode ends when the head is below 1.2 m, or after
//! the time limit.

use std::io::{IsTerminal as _, Write as _};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use comic_clips::Catalogue;
use comic_experiment::{ACTION_SIZE, Experiment, StartPose, TaskName, Transfer, TransferPrior};
use comic_networks::FrozenLowLevel;
use comic_networks::export::Exported;
use comic_proto::{Field, UnrollShape};
use comic_tasks::{Environment as _, Simulated, Task};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;
use serde::Serialize;

use crate::Error;
use crate::acting_loop::{ActingLoop, Controller, Recorder, Rollout};
use crate::film::recorder::{Look, Recorder as Film};
use crate::forward_pass::{ActingBatch, ActingRow, ForwardPass, LowLevelShape};
use crate::policy::actuate;

/// Height of the head below which the humanoid has fallen, m.
const FALLEN: f64 = 1.2;
/// Environments in a forward pass.
const ENVIRONMENTS: usize = 16;

/// Seconds upright and metres walked under p(z | s), N(0, I) and z = 0, and of an untrained low level.
#[derive(Args, Clone, Debug)]
pub struct Assess {
    /// A file of `comic-learner export --part low-level`, with or without the prior of `comic-learner prior`.
    #[arg(long, value_name = "FILE")]
    low_level: PathBuf,
    /// Clips whose frames are the starts: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP. The clips of the low
    /// level's own run unless given.
    #[arg(long, value_name = "SOURCE", num_args = 1..)]
    clips: Vec<String>,
    /// Episodes of each row.
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=64))]
    episodes: u32,
    /// Seconds of an episode, at most.
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

/// What one source of latents does.
#[derive(Clone, Debug, Serialize)]
struct Row {
    /// The source.
    latents: &'static str,
    episodes: usize,
    /// Mean seconds until the head is below 1.2 m, or until the time limit.
    seconds_upright: f64,
    /// Share of the episodes that are upright at the time limit.
    upright_to_the_end: f64,
    /// Mean horizontal distance between the start and the place where the episode ended, m.
    metres: f64,
}

/// Where the latents of a row come from.
#[derive(Clone, Copy)]
struct Source {
    name: &'static str,
    file: &'static str,
    /// Whether the low level has its learned parameters.
    trained: bool,
    prior: TransferPrior,
    /// Standard deviation of the policy's action.
    std: f32,
}

const SOURCES: [Source; 4] = [
    Source { name: "p(z | s)", file: "state-prior", trained: true, prior: TransferPrior::State, std: 1.0 },
    Source { name: "N(0, I)", file: "standard-prior", trained: true, prior: TransferPrior::Standard, std: 1.0 },
    Source { name: "z = 0", file: "zero", trained: true, prior: TransferPrior::Standard, std: 0.0 },
    Source { name: "untrained, N(0, I)", file: "untrained", trained: false, prior: TransferPrior::Standard, std: 1.0 },
];

impl Assess {
    /// Rolls out every source and prints the table.
    ///
    /// # Errors
    /// A low level or clips that cannot be used, a failing forward pass or film.
    pub fn run(&self) -> Result<(), Error> {
        let refuse = |error: comic_networks::Error| Error::Usage(format!("{}: {error}", self.low_level.display()));
        let file = Exported::open(&self.low_level).map_err(refuse)?;
        let untrained = file.untrained(self.seed).map_err(refuse)?;
        let task = self.task(&file)?;
        let mut rows = Vec::new();
        for source in SOURCES {
            if source.prior == TransferPrior::State && file.spec.prior.is_none() {
                tracing::info!("the low level has no prior of the state; `comic-learner prior` fits one");
                continue;
            }
            let transfer = Transfer { prior: source.prior, ..Transfer::default() };
            let low_level = if source.trained { &file } else { &untrained }.freeze(&transfer).map_err(refuse)?;
            let latent = file.experiment.network.latent.size;
            let sheet = self.sheets.as_ref().map(|directory| directory.join(format!("{}.png", source.file)));
            rows.push(self.roll_out(source, low_level, latent, &task, sheet.as_deref())?);
        }
        let text = if self.json { json(&rows)? } else { table(&rows) };
        std::io::stdout().write_all(text.as_bytes()).map_err(Error::file("standard output"))
    }

    /// Go-to-target from frames of the clips: no early end, and the target does not matter.
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
        let film = match sheet {
            Some(path) => {
                let directory = path.parent().unwrap_or(Path::new("."));
                std::fs::create_dir_all(directory).map_err(Error::file(directory))?;
                Some(Film::new(&Look::sheet(), path, task.control_timestep())?)
            }
            None => None,
        };
        let shape = UnrollShape { action: latent, ..UnrollShape::new(task.spec(), &Experiment::default()) };
        let shape = UnrollShape { latent: 0, components: 1, state: 0, ..shape };
        let mut policy = RandomLatents { low_level, std: source.std };
        let environments = (0..ENVIRONMENTS.min(self.episodes as usize) as u64)
            .map(|number| Arc::clone(task).environment(number))
            .collect::<Result<Vec<_>, _>>()?;
        let mut acting = ActingLoop::new(environments, &shape, policy.low_level());
        let mut recorder = FallRecorder {
            episodes: vec![Falling::default(); acting.rollouts.len()],
            next: 0,
            all: self.episodes as usize,
            finished: Vec::new(),
            film,
            timestep: task.control_timestep(),
            rng: Pcg64::seed_from_u64(self.seed),
        };
        for (index, rollout) in acting.rollouts.iter_mut().enumerate() {
            recorder.begin_next(index, rollout, &mut acting.batch.row(index))?;
        }
        let mut controller = Controller::Policy(&mut policy);
        while recorder.finished.len() < recorder.all {
            let _ = acting.iterate(&mut controller, &mut recorder)?;
        }
        if let Some(film) = recorder.film {
            film.finish()?;
        }
        let finished = recorder.finished;
        let mean = |of: &dyn Fn(&Fallen) -> f64| finished.iter().map(of).sum::<f64>() / finished.len().max(1) as f64;
        let row = Row {
            latents: source.name,
            episodes: finished.len(),
            seconds_upright: mean(&|one| one.seconds),
            upright_to_the_end: mean(&|one| f64::from(u8::from(one.upright))),
            metres: mean(&|one| one.metres),
        };
        if !std::io::stderr().is_terminal() {
            tracing::info!(
                latents = row.latents,
                seconds_upright = row.seconds_upright,
                metres = row.metres,
                "assessed"
            );
        }
        Ok(row)
    }
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

/// An episode under way.
#[derive(Clone, Copy, Default)]
struct Falling {
    /// The place of its start among all starts.
    number: usize,
    /// Where the root was at the start, x and y, m.
    from: [f64; 2],
}

/// An episode that is over.
struct Fallen {
    seconds: f64,
    upright: bool,
    metres: f64,
}

struct FallRecorder {
    /// The episode of each environment.
    episodes: Vec<Falling>,
    /// The next start.
    next: usize,
    all: usize,
    finished: Vec<Fallen>,
    /// Films the first start.
    film: Option<Film>,
    /// Seconds of a control step.
    timestep: f64,
    /// The noise of all environments.
    rng: Pcg64,
}

type Walking = Rollout<Box<dyn Simulated>>;

impl FallRecorder {
    /// Begins the next start's episode; the environment stays idle when there is none.
    fn begin_next(&mut self, index: usize, rollout: &mut Walking, row: &mut ActingRow<'_>) -> Result<(), Error> {
        rollout.ended = true;
        if self.next == self.all {
            return Ok(());
        }
        rollout.environment.reset_to(0, self.next)?;
        rollout.begin_episode(row);
        self.episodes[index] = Falling { number: self.next, from: place(rollout) };
        self.next += 1;
        self.shoot(index, rollout)
    }

    fn shoot(&mut self, index: usize, rollout: &mut Walking) -> Result<(), Error> {
        match (&mut self.film, self.episodes[index].number) {
            (Some(film), 0) => film.shoot(rollout.environment.as_mut()),
            _ => Ok(()),
        }
    }
}

/// Where the root is, x and y, m.
fn place(rollout: &Walking) -> [f64; 2] {
    let qpos = rollout.environment.simulation().qpos();
    [0, 1].map(|axis| qpos.get(axis).copied().unwrap_or(0.0))
}

impl Recorder<Box<dyn Simulated>> for FallRecorder {
    fn observe(&mut self, _index: usize, _rollout: &mut Walking, _row: &mut ActingRow<'_>) -> Result<(), Error> {
        Ok(())
    }

    fn draw_latent_noise(&mut self, _index: usize, _row: &mut ActingRow<'_>) {}

    fn choose(&mut self, _index: usize, rollout: &Walking, row: &mut ActingRow<'_>) {
        if !rollout.ended {
            row.sample(&mut self.rng);
        }
    }

    fn step(&mut self, index: usize, rollout: &mut Walking, row: &mut ActingRow<'_>) -> Result<ControlFlow<()>, Error> {
        if rollout.ended {
            return Ok(ControlFlow::Continue(()));
        }
        let step = rollout.step(row);
        let upright = step.head_height >= FALLEN;
        if upright {
            self.shoot(index, rollout)?;
        }
        if !upright || rollout.ended {
            let ([x, y], Falling { from: [from_x, from_y], .. }) = (place(rollout), self.episodes[index]);
            // After a divergence positions mean nothing.
            let metres = Some((x - from_x).hypot(y - from_y)).filter(|metres| metres.is_finite()).unwrap_or(0.0);
            let seconds = f64::from(rollout.steps) * self.timestep;
            self.finished.push(Fallen { seconds, upright, metres });
            self.begin_next(index, rollout, row)?;
        }
        Ok(ControlFlow::Continue(()))
    }
}

fn json(rows: &[Row]) -> Result<String, Error> {
    let text = serde_json::to_string_pretty(rows);
    text.map(|text| text + "\n").map_err(|error| Error::Usage(format!("cannot write the table as JSON: {error}")))
}

fn table(rows: &[Row]) -> String {
    let mut text =
        format!("{:<20}{:>10}{:>16}{:>12}{:>10}\n", "latents", "episodes", "upright", "to the end", "walked");
    for Row { latents, episodes, seconds_upright, upright_to_the_end, metres } in rows {
        let end = 100.0 * upright_to_the_end;
        text += &format!("{latents:<20}{episodes:>10}{seconds_upright:>14.2} s{end:>10.0} %{metres:>8.2} m\n");
    }
    text
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds) if seconds > 0.0 && seconds <= 3600.0 => Ok(seconds),
        _ => Err("must be positive seconds, at most 3600".into()),
    }
}
