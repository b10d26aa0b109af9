//! The warm start: regression towards the servo action on demonstrations that actors make.

use std::sync::Arc;

use anyhow::Result;
use comic_proto::v1::Behaviour;
use rand::Rng;
use rand::seq::index::sample;

use crate::checkpoint::Name;
use crate::trainer::{Trainer, Wait};
use crate::vmpo::{Losses, MinibatchTensors};

/// A batch of the servo's rollouts in which only those of tasks with a reference are seen, one unroll at least.
struct Demonstrations {
    unrolls: MinibatchTensors,
    shown: Vec<usize>,
    hidden: Vec<usize>,
}

impl Demonstrations {
    /// `count` different unrolls, or all there are: shown ones at random, and hidden ones where these are too few, since
    /// each size that the mix of tasks made would have to be compiled.
    fn choose(&self, count: usize, random: &mut impl Rng) -> Vec<usize> {
        let shown = sample(random, self.shown.len(), self.shown.len().min(count));
        let shown = shown.into_iter().filter_map(|place| self.shown.get(place));
        shown.chain(&self.hidden).copied().take(count).collect()
    }
}

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
    fn gather(&mut self) -> Result<Option<Vec<Demonstrations>>> {
        let unroll = &self.experiment.unroll;
        let rows = (unroll.batch * unroll.length) as u64;
        let wanted = self.experiment.warm_start.demonstration_steps.div_ceil(rows).max(1);
        let mut demonstrations = Vec::new();
        while (demonstrations.len() as u64) < wanted {
            match self.next_batch()? {
                Wait::Batch(batch) => {
                    let mut unrolls = self.tensors(&batch)?;
                    // What has no reference has nothing to demonstrate: holding still is no example.
                    let shows = |unroll: &usize| {
                        let task = unrolls.tasks().get(*unroll).and_then(|task| self.spec.tasks.get(*task));
                        task.is_some_and(|task| task.demonstrated)
                    };
                    let (shown, hidden): (Vec<usize>, Vec<usize>) = (0..batch.unrolls).partition(shows);
                    if !shown.is_empty() {
                        unrolls.hide(|unroll| hidden.contains(&unroll));
                        demonstrations.push(Demonstrations { unrolls, shown, hidden });
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
    fn regress(&mut self, demonstrations: &mut [Demonstrations], unrolls: usize) -> Result<Losses> {
        let random = &mut self.progress.random;
        let batch = &mut demonstrations[random.random_range(0..demonstrations.len())];
        let chosen = batch.choose(unrolls, random);
        let (losses, latents) = self.learner.regress(&batch.unrolls.select(&chosen))?;
        batch.unrolls.refresh_previous_latent(&chosen, &latents);
        Ok(losses)
    }
}
