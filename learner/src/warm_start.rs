//! The warm start: regression towards the servo action on demonstrations that actors make.

use std::sync::Arc;

use anyhow::Result;
use comic_proto::v1::Behaviour;
use rand::Rng as _;
use rand::seq::index::sample;

use crate::checkpoint::Name;
use crate::trainer::{Trainer, Wait};
use crate::vmpo::{Losses, MinibatchTensors};

impl Trainer {
    /// Gathers demonstrations, regresses on them, and leaves the checkpoint `warm-started`. `None` when the learner was
    /// asked to stop meanwhile; the warm start then begins anew next time.
    pub(crate) fn warm_start(&mut self) -> Result<Option<()>> {
        self.publish(Behaviour::Demonstrate)?;
        tracing::info!(steps = self.experiment.warm_start.demonstration_steps, "gathering demonstrations");
        let Some(mut demonstrations) = self.gather()? else { return Ok(None) };
        if self.experiment.network.normaliser_steps > 0 {
            self.set_normaliser()?;
        }
        // Without the scale of the observations there would be no way on from the state before.
        self.good = Arc::new(self.snapshot()?);
        let config = self.experiment.warm_start.clone();
        tracing::info!(steps = config.steps, "regressing on them");
        let (mut unreported, mut step) = (Vec::new(), 0);
        // A last step that was skipped is made up for: what is not sound would not be published.
        while step < config.steps || !self.is_sound() {
            self.learner.set_learning_rates(config.learning_rate, self.experiment.optimiser.multiplier_learning_rate);
            unreported.push(self.regress(&mut demonstrations, config.minibatch_unrolls)?);
            self.backend.end_step()?;
            if (step % 50 == 0 || step + 1 >= config.steps)
                && let Some(losses) = Losses::mean(&std::mem::take(&mut unreported))
            {
                let losses = losses.to_metrics();
                tracing::info!(step, regression = losses.regression_loss, latent_kl = losses.latent_kl, "regressing");
                if self.report(&losses)? {
                    step = 0;
                    continue;
                }
            }
            step += 1;
            self.write_metrics_when_due()?;
            if self.batcher.is_closed() {
                return Ok(None);
            }
        }
        self.learner.reset_optimiser();
        self.progress.warm_started = true;
        self.publish(Behaviour::Policy)?;
        self.keep(Name::WarmStarted)?;
        Ok(Some(()))
    }

    /// At least `demonstration_steps` rows of the servo's rollouts, batch by batch.
    fn gather(&mut self) -> Result<Option<Vec<MinibatchTensors>>> {
        let unroll = &self.experiment.unroll;
        let rows = (unroll.batch * unroll.length) as u64;
        let wanted = self.experiment.warm_start.demonstration_steps.div_ceil(rows).max(1);
        let mut demonstrations = Vec::new();
        while (demonstrations.len() as u64) < wanted {
            match self.next_batch()? {
                Wait::Batch(batch) => {
                    let tensors = self.tensors(&batch)?;
                    // What has no reference has nothing to demonstrate: holding still is no example.
                    let shows = |task: &usize| self.spec.tasks.get(*task).is_some_and(|task| task.demonstrated);
                    let shown: Vec<usize> =
                        (0..batch.unrolls).filter(|unroll| tensors.tasks().get(*unroll).is_some_and(shows)).collect();
                    if !shown.is_empty() {
                        demonstrations.push(tensors.select(&shown));
                    }
                    self.absorb(&batch);
                    self.metrics.absorb(batch.headers(), 0);
                    if (demonstrations.len() as u64) < wanted {
                        self.keep_step(Behaviour::Demonstrate);
                    }
                    self.book(batch);
                }
                Wait::Nothing => {}
                Wait::Closed => return Ok(None),
            }
        }
        Ok(Some(demonstrations))
    }

    /// One step on some unrolls of one batch. The demonstrator has no latent, so z_{t−1} is this encoder's own: what it
    /// gave when it last saw these unrolls.
    fn regress(&mut self, demonstrations: &mut [MinibatchTensors], unrolls: usize) -> Result<Losses> {
        let random = &mut self.progress.random;
        let batch = &mut demonstrations[random.random_range(0..demonstrations.len())];
        let of = batch.shape().unrolls;
        let chosen = sample(random, of, unrolls.min(of)).into_vec();
        let (losses, latents) = self.learner.regress(&batch.select(&chosen))?;
        batch.refresh_previous_latent(&chosen, &latents);
        Ok(losses)
    }
}
