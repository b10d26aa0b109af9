//! The state of the learner, as `GetStatus`, `/metrics` and `/readyz` show it.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use comic_proto::v1;
use comic_replay::Batcher;
use parking_lot::Mutex;

use super::room::Room;
use super::roster::{Census, Roster};
use super::shutdown::Shutdown;
use crate::observe::heartbeat::Heartbeat;
use crate::observe::probes::Probed;
use crate::observe::prometheus::{Prometheus, Sample};
use crate::publish::Publisher;

/// What an operator can ask.
#[derive(Debug)]
pub(super) struct StatusBoard {
    pub(super) run: PathBuf,
    /// The experiment's name.
    pub(super) experiment: String,
    pub(super) started: Instant,
    /// Unrolls that the batches have room for: those of the open batch, of full ones, and of the trainer's.
    pub(super) capacity: u64,
    /// The newest metrics, JSON.
    pub(super) metrics: Mutex<String>,
    pub(super) batcher: Batcher,
    pub(super) publisher: Publisher,
    pub(super) roster: Arc<Roster>,
    pub(super) room: Room,
    pub(super) prometheus: Arc<Prometheus>,
    pub(super) shutdown: Shutdown,
    pub(super) heartbeat: Heartbeat,
}

impl StatusBoard {
    /// Replaces the metrics that `GetStatus` answers with, JSON.
    pub(super) fn set_metrics(&self, json: String) {
        *self.metrics.lock() = json;
    }

    /// The number of actors that are connected.
    pub(super) fn actors(&self) -> u64 {
        let Census { alive, slow, .. } = self.roster.census(Instant::now());
        alive + slow
    }

    /// What `GetStatus` answers.
    pub(super) fn status(&self) -> v1::Status {
        let accounting = self.batcher.accounting();
        let Census { alive, slow, lost, waiting } = self.roster.census(Instant::now());
        let ages = self.prometheus.ages();
        v1::Status {
            learner_epoch: self.publisher.epoch(),
            accounting: Some(v1::Accounting {
                produced: accounting.produced,
                trained: accounting.trained,
                dropped_stale: accounting.dropped.stale,
                dropped_invalid: accounting.dropped.invalid,
                dropped_superseded: accounting.dropped.superseded,
                dropped_lost_at_restart: accounting.dropped.lost_at_restart,
                in_flight: accounting.in_flight,
                duplicates: accounting.duplicates,
                unattributed: accounting.unattributed,
            }),
            metrics_json: self.metrics.lock().clone(),
            run: self.run.display().to_string(),
            experiment: self.experiment.clone(),
            uptime_seconds: self.started.elapsed().as_secs_f64(),
            queue: Some(v1::Queue { unrolls: accounting.in_flight, capacity: self.capacity, waiting }),
            ages: Some(v1::Ages { median: ages.median, p99: ages.p99, max: ages.max }),
            actors: Some(v1::Actors { alive, slow, lost }),
        }
    }
}

impl Probed for StatusBoard {
    fn metrics_page(&self) -> String {
        let Census { alive, slow, lost, waiting } = self.roster.census(Instant::now());
        self.prometheus.page(&Sample {
            accounting: self.batcher.accounting_by_task(),
            capacity: self.capacity,
            waiting,
            ingest: self.room.taken(),
            actors: [("alive", alive), ("slow", slow), ("lost", lost)],
            version: self.publisher.newest_version(),
            epoch: self.publisher.epoch(),
            silence: self.heartbeat.silence(),
        })
    }

    fn is_draining(&self) -> bool {
        self.shutdown.has_begun()
    }

    fn silence(&self) -> Duration {
        self.heartbeat.silence()
    }
}
