//! What changes in training and decides its future: what a checkpoint holds and restores.

use bytes::Bytes;
use comic_experiment::{CHECKPOINT_FORMAT, Experiment, TaskSpec};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

use crate::algorithm::{Algorithm, Parts};
use crate::algorithms;
use crate::checkpoint::progress::Progress;
use crate::checkpoint::snapshot::{self, PROGRESS, Snapshot};
use crate::error::{Error, Result};
use crate::tensors;
use crate::train::statistics::ObservationStatistics;

/// The algorithm and what is saved with it.
#[derive(Debug)]
pub(super) struct State {
    pub(super) algorithm: Box<dyn Algorithm>,
    /// Of the observations that were collected. The normaliser gets them with each publication, so until then it may have
    /// older ones.
    pub(super) statistics: ObservationStatistics,
    pub(super) progress: Progress,
    /// The parameters that actors act with, as published.
    pub(super) target: Bytes,
    /// In transfer: the file of the frozen low level.
    low_level: Option<Bytes>,
}

impl State {
    /// The state at the beginning of run number `run`. `low_level` is the file of a transfer's frozen low level.
    ///
    /// # Errors
    /// When the networks cannot be made.
    pub(super) fn new(parts: Parts<'_>, low_level: Option<Bytes>, run: u64, epoch: u64) -> Result<Self> {
        let Parts { experiment, spec, .. } = parts;
        tch::manual_seed(experiment.seed as i64);
        let algorithm = algorithms::learner(parts)?;
        let progress = Progress {
            format: CHECKPOINT_FORMAT,
            run: Some(run),
            epoch,
            updates: 0,
            gradient_steps: 0,
            environment_steps: 0,
            seconds: 0.0,
            version: 0,
            random: Pcg64::seed_from_u64(experiment.seed),
        };
        let target = Bytes::from(algorithm.policy_parameters()?);
        Ok(Self { algorithm, statistics: ObservationStatistics::new(spec), progress, target, low_level })
    }

    /// Normalises by the statistics collected so far, if there are any. If it were called between two publications, the learner
    /// would normalise otherwise than the actors, and the KL to their policy would be more than what was learned.
    ///
    /// # Errors
    /// When libtorch refuses.
    pub(super) fn set_normaliser(&mut self) -> Result<()> {
        if self.statistics.rows() > 0.0 {
            self.algorithm.set_normaliser(&self.statistics.to_normaliser()?)?;
        }
        Ok(())
    }

    /// The state as a checkpoint, with the documents by which a resumed run is compared.
    ///
    /// # Errors
    /// When a part cannot be read from the device or written as a document.
    pub(super) fn snapshot(
        &self,
        experiment: &Experiment,
        spec: &TaskSpec,
        accounting: &comic_replay::LedgerSnapshot,
    ) -> Result<Snapshot> {
        let mut learned = self.algorithm.state();
        learned.extend(self.statistics.state());
        let json = |name: &str| Error::json(format!("{name} of the checkpoint"));
        let parts = [
            ("experiment.toml", experiment.to_toml()?.into_bytes()),
            ("task.json", serde_json::to_vec_pretty(spec).map_err(json("task.json"))?),
            ("policy.safetensors", self.algorithm.policy_parameters()?),
            ("target.safetensors", self.target.to_vec()),
            (snapshot::LEARNED, tensors::to_bytes(&learned)?),
            (PROGRESS, serde_json::to_vec_pretty(&self.progress).map_err(json(PROGRESS))?),
            ("accounting.json", serde_json::to_vec_pretty(accounting).map_err(json("accounting.json"))?),
        ];
        let low_level = self.low_level.as_ref().map(|file| (snapshot::LOW_LEVEL, file.to_vec()));
        let parts = parts.into_iter().chain(low_level);
        Ok(Snapshot { parts: parts.map(|(name, bytes)| (name.to_string(), bytes)).collect() })
    }

    /// Restores a checkpoint, as learner epoch `epoch` of run number `run`.
    ///
    /// # Errors
    /// When a part is missing or damaged, or does not fit the experiment.
    pub(super) fn restore(&mut self, snapshot: &Snapshot, run: u64, epoch: u64) -> Result<()> {
        self.restore_learned(snapshot)?;
        self.target = Bytes::copy_from_slice(snapshot.part("target.safetensors")?);
        self.progress = Progress { run: Some(run), epoch, ..Progress::of(snapshot)? };
        Ok(())
    }

    /// Restores what was learned, and leaves the progress as it is.
    ///
    /// # Errors
    /// As of [`restore`](Self::restore).
    pub(super) fn restore_learned(&mut self, snapshot: &Snapshot) -> Result<()> {
        let mut tensors = tensors::from_bytes(snapshot.part(snapshot::LEARNED)?)?;
        self.statistics.restore(&mut tensors)?;
        let loaded = self.algorithm.load_state(&tensors);
        loaded.map_err(Error::within("the checkpoint does not fit the experiment's networks"))
    }
}
