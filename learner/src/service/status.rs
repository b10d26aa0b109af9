//! The state of the learner, as `GetStatus` and `/metrics` tell it.

use std::time::Instant;

use comic_proto::v1;

use super::roster::Census;
use super::{Shared, lock};
use crate::observe::telemetry::Sample;

/// What `GetStatus` answers.
pub(super) fn of(shared: &Shared) -> v1::Status {
    let accounting = shared.batcher.accounting();
    let Census { alive, slow, lost, waiting } = shared.roster.census(Instant::now());
    let ages = shared.telemetry.ages();
    v1::Status {
        learner_epoch: shared.publisher.epoch(),
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
        metrics_json: lock(&shared.metrics).clone(),
        run: shared.run.display().to_string(),
        experiment: shared.name.clone(),
        uptime_seconds: shared.since.elapsed().as_secs_f64(),
        queue: Some(v1::Queue { unrolls: accounting.in_flight, capacity: shared.capacity, waiting }),
        ages: Some(v1::Ages { median: ages.median, p99: ages.p99, max: ages.max }),
        actors: Some(v1::Actors { alive, slow, lost }),
    }
}

impl Shared {
    /// What `/metrics` answers.
    pub fn metrics_page(&self) -> String {
        let Census { alive, slow, lost, waiting } = self.roster.census(Instant::now());
        self.telemetry.page(&Sample {
            accounting: self.batcher.accounting_by_task(),
            capacity: self.capacity,
            waiting,
            ingest: self.room.taken(),
            actors: [("alive", alive), ("slow", slow), ("lost", lost)],
            version: self.publisher.newest_version(),
            epoch: self.publisher.epoch(),
        })
    }
}
