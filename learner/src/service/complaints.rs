//! A log that stays readable when an actor sends rubbish at full speed.

use std::collections::HashMap;
use std::fmt::Display;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use super::lock;

/// Silence after a complaint about an actor.
const QUIET: Duration = Duration::from_secs(60);
/// Actors remembered. Were so many to send rubbish within a minute, the log would have nothing more to tell.
const REMEMBERED: usize = 1024;

/// When each actor was last complained about, and how often it deserved it since.
#[derive(Debug, Default)]
pub(super) struct Complaints {
    actors: Mutex<HashMap<u64, (Instant, u64)>>,
}

impl Complaints {
    /// Logs a refused unroll, at most once per actor and minute.
    pub(super) fn about(&self, actor: u64, sequence: u64, reason: &dyn Display) {
        if let Some(unreported) = self.due(actor, Instant::now()) {
            tracing::warn!(actor, sequence, unreported, "invalid unroll refused: {reason}");
        }
    }

    /// How many went unreported before this one, if it is to be reported.
    fn due(&self, actor: u64, now: Instant) -> Option<u64> {
        let mut actors = lock(&self.actors);
        if let Some((last, unreported)) = actors.get_mut(&actor) {
            if now.duration_since(*last) < QUIET {
                *unreported += 1;
                return None;
            }
            *last = now;
            return Some(std::mem::take(unreported));
        }
        if actors.len() >= REMEMBERED {
            actors.retain(|_, (last, _)| now.duration_since(*last) < QUIET);
        }
        if actors.len() >= REMEMBERED {
            return None;
        }
        actors.insert(actor, (now, 0));
        Some(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_actor_is_complained_about_once_a_minute_and_the_rest_is_counted() {
        let (complaints, start) = (Complaints::default(), Instant::now());
        assert_eq!(complaints.due(7, start), Some(0));
        assert_eq!(complaints.due(7, start + QUIET / 2), None);
        assert_eq!(complaints.due(8, start + QUIET / 2), Some(0), "another actor has its own minute");
        assert_eq!(complaints.due(7, start + QUIET), Some(1));
    }

    #[test]
    fn memory_is_bounded_and_recovers() {
        let (complaints, start) = (Complaints::default(), Instant::now());
        for actor in 0..5000 {
            complaints.due(actor, start);
        }
        assert_eq!(lock(&complaints.actors).len(), REMEMBERED);
        assert_eq!(complaints.due(5000, start), None);
        assert_eq!(complaints.due(5000, start + QUIET), Some(0));
    }
}
