//! The trainer's whole state as a snapshot, and back: everything that changes the future.

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context as _, Result};
use bytes::Bytes;
use comic_networks::to_safetensors;

use crate::algorithm::Algorithm as _;
use crate::checkpoint::{Name, PROGRESS, Snapshot};
use crate::service::memory::{Bounds, Sizes};
use crate::train::trainer::{Progress, Trainer};

impl Trainer {
    /// Hands a snapshot to the writer; while it is still busy with the last one, only a `final_one` waits.
    pub(crate) fn checkpoint(&mut self, final_one: bool) -> Result<()> {
        let name = Name::Updates(self.progress.updates);
        match final_one {
            // A step that was skipped at the very end changed nothing.
            true if self.learner.is_finite() => self.write(name),
            false if self.writer.is_busy() => Ok(()),
            _ => self.keep(name),
        }
    }

    /// Has the state written, and keeps it in memory to turn back to; only a sound one.
    pub(crate) fn keep(&mut self, name: Name) -> Result<()> {
        if !self.is_sound() {
            tracing::warn!(checkpoint = %name, "not written: the last gradient steps were not finite");
            return Ok(());
        }
        self.write(name)
    }

    fn write(&mut self, name: Name) -> Result<()> {
        self.good = Arc::new(self.snapshot()?);
        self.checkpointed = Instant::now();
        self.writer.write(name, self.good.clone())
    }

    /// How much memory the learner's buffers can take, now that every size is known.
    pub(crate) fn memory(&self) -> Bounds {
        Bounds::new(&Sizes {
            ahead: self.experiment.unroll.ahead,
            batch: self.experiment.unroll.batch,
            unroll: self.batcher.layout().size(),
            ingest: self.shared.ingest(),
            parameters: self.target.len(),
            snapshot: self.good.parts.values().map(Vec::len).sum(),
        })
    }

    pub(crate) fn snapshot(&self) -> Result<Snapshot> {
        let mut tensors = self.learner.state();
        tensors.extend(self.statistics.state());
        let run = Some(self.shared.id());
        let progress = Progress { run, epoch: self.epoch, seconds: self.seconds(), ..self.progress.clone() };
        let mut snapshot = Snapshot::default();
        for (name, bytes) in [
            ("experiment.toml", self.experiment.to_toml()?.into_bytes()),
            ("task.json", serde_json::to_vec_pretty(&self.spec)?),
            ("policy.safetensors", to_safetensors(self.learner.policy_store())?),
            ("target.safetensors", self.target.to_vec()),
            ("learner.safetensors", crate::tensors::to_bytes(&tensors)?),
            (PROGRESS, serde_json::to_vec_pretty(&progress)?),
            ("accounting.json", serde_json::to_vec_pretty(&self.batcher.snapshot())?),
        ] {
            snapshot.parts.insert(name.to_string(), bytes);
        }
        Ok(snapshot)
    }

    pub(crate) fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        self.restore_learner(snapshot)?;
        self.target = Bytes::copy_from_slice(snapshot.part("target.safetensors")?);
        self.progress =
            serde_json::from_slice(snapshot.part(PROGRESS)?).context("the checkpoint's progress is damaged")?;
        Ok(())
    }

    /// What was learnt, without what counts.
    pub(crate) fn restore_learner(&mut self, snapshot: &Snapshot) -> Result<()> {
        let mut tensors = crate::tensors::from_bytes(snapshot.part("learner.safetensors")?)?;
        self.statistics.restore(&mut tensors)?;
        self.learner.load_state(&tensors).context("the checkpoint does not fit the experiment's networks")
    }
}
