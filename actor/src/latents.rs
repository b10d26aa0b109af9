//! `comic-actor latents`: the latents that an encoder gives, and the states it gives them in.

use std::io::IsTerminal as _;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use comic_clips::Catalogue;
use comic_experiment::seed::derive;
use comic_proto::{Field, UnrollShape};
use comic_tasks::Environment;
use indicatif::ProgressBar;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;
use safetensors::tensor::{Dtype, TensorView};

use crate::Error;
use crate::acting_loop::{ActingLoop, Controller, Recorder, Rollout};
use crate::checkpoint;
use crate::forward_pass::ActingRow;
use crate::policy::TorchPolicy;

/// Environments in a forward pass.
const ENVIRONMENTS: u64 = 16;
/// Latents between two log lines, when there is no terminal.
const LATENTS_A_LINE: usize = 20_000;

/// Acts as in training, with noise, from random starts, and writes each step's proprioception and latent.
#[derive(Args, Clone, Debug)]
pub struct Latents {
    /// A run's directory, its `checkpoints`, or one checkpoint; the newest complete checkpoint acts. Or a policy that
    /// `comic-learner export` wrote.
    #[arg(long, value_name = "DIR|FILE")]
    checkpoint: PathBuf,
    /// Clips in place of the experiment's own: builtin:NAME, FILE.h5, FILE.h5#SUBSET or FILE.h5#CLIP,CLIP.
    #[arg(long, value_name = "SOURCE", num_args = 1..)]
    clips: Vec<String>,
    /// How many latents.
    #[arg(long, value_name = "N", default_value_t = 200_000, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    count: u32,
    /// Seed of starts and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The file: safetensors with `proprioception` [N, P], in SI units, and `latent` [N, Z], float32.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Latents {
    /// Acts and writes the file.
    ///
    /// # Errors
    /// A checkpoint that cannot be used or has no latent, a failing forward pass, a disk that fails.
    pub fn run(&self) -> Result<(), Error> {
        let found = checkpoint::read(&self.checkpoint)?;
        let experiment = found.experiment.with_clips(&self.clips);
        let catalogue = Catalogue::open(&experiment.clips)?;
        let task = comic_tasks::build(&experiment, &catalogue)?;
        let shape = UnrollShape::new(task.spec(), &experiment);
        if shape.latent == 0 {
            let path = self.checkpoint.display();
            return Err(Error::Usage(format!("{path}: its policy has no encoder of latents: name a run of tracking")));
        }
        let mut policy =
            TorchPolicy::from_parameters(task.spec(), &experiment, found.low_level.as_deref(), &found.policy)?;
        let environments = (0..ENVIRONMENTS)
            .map(|number| Arc::clone(&task).environment(derive(self.seed, number)))
            .collect::<Result<Vec<_>, _>>()?;
        let count = self.count as usize;
        let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new(count as u64));
        let mut recorder = LatentRecorder {
            proprioception: Vec::with_capacity(count * shape.proprioception),
            latent: Vec::with_capacity(count * shape.latent),
            left: count,
            rng: Pcg64::seed_from_u64(self.seed),
        };
        let mut acting = ActingLoop::new(environments, &shape, None);
        for (index, rollout) in acting.rollouts.iter_mut().enumerate() {
            rollout.begin_episode(&mut acting.batch.row(index));
        }
        let (mut controller, mut reported) = (Controller::Policy(&mut policy), 0);
        while recorder.left > 0 {
            let _ = acting.iterate(&mut controller, &mut recorder)?;
            let done = count - recorder.left;
            match &bar {
                Some(bar) => bar.set_position(done as u64),
                None if done >= reported + LATENTS_A_LINE => {
                    tracing::info!(done, of = count, "latents");
                    reported = done;
                }
                None => {}
            }
        }
        if let Some(bar) = bar {
            bar.finish_and_clear();
        }
        self.write(&recorder, &shape)?;
        tracing::info!(latents = count, file = %self.out.display(), "wrote the latents");
        Ok(())
    }

    fn write(&self, recorder: &LatentRecorder, shape: &UnrollShape) -> Result<(), Error> {
        let bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let (proprioception, latent) = (bytes(&recorder.proprioception), bytes(&recorder.latent));
        let rows = self.count as usize;
        let view = |width: usize, bytes| TensorView::new(Dtype::F32, vec![rows, width], bytes);
        let document = view(shape.proprioception, &proprioception).and_then(|proprioception| {
            let latent = view(shape.latent, &latent)?;
            safetensors::serialize([("proprioception", proprioception), ("latent", latent)], None)
        });
        let document = document.map_err(|error| Error::Usage(format!("cannot write the latents: {error}")))?;
        std::fs::write(&self.out, document).map_err(Error::file(&self.out))
    }
}

/// Keeps every step's proprioception and latent, until there are enough.
struct LatentRecorder {
    proprioception: Vec<f32>,
    latent: Vec<f32>,
    left: usize,
    rng: Pcg64,
}

impl<E: Environment> Recorder<E> for LatentRecorder {
    fn observe(&mut self, _index: usize, rollout: &mut Rollout<E>, row: &mut ActingRow<'_>) -> Result<(), Error> {
        if rollout.ended {
            rollout.environment.reset();
            rollout.begin_episode(row);
        }
        Ok(rollout.environment.draw(row.image)?)
    }

    fn draw_latent_noise(&mut self, _index: usize, row: &mut ActingRow<'_>) {
        row.draw_latent_noise(&mut self.rng);
    }

    fn choose(&mut self, _index: usize, _rollout: &Rollout<E>, row: &mut ActingRow<'_>) {
        row.sample(&mut self.rng);
    }

    fn step(
        &mut self,
        _index: usize,
        rollout: &mut Rollout<E>,
        row: &mut ActingRow<'_>,
    ) -> Result<ControlFlow<()>, Error> {
        if self.left > 0 {
            self.left -= 1;
            self.proprioception.extend_from_slice(&row[Field::Proprioception]);
            self.latent.extend_from_slice(row.latent);
        }
        rollout.step(row);
        Ok(ControlFlow::Continue(()))
    }
}
