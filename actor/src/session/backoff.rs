//! The wait before another attempt.

use std::time::Duration;

use comic_proto::chain;
use rand::Rng as _;
use tokio::time::Instant;

use super::connection::Failure;
use crate::Error;

const FIRST: Duration = Duration::from_millis(100);
const LONGEST: Duration = Duration::from_secs(5);
/// How long a process tries that is not accepted at its first contact. Kubernetes brings a renewed secret to a running learner up
/// to two minutes after it is there for new pods.
const UNWELCOME: Duration = Duration::from_secs(180);
/// After such a pause, for instance while the learner restarts, the time begins anew. Attempts are at most fifteen seconds
/// apart.
const PAUSE: Duration = Duration::from_secs(30);

/// Exponential back-off, 0.1 s to 5 s, with jitter, so that not all actors reach a restarted learner at the same moment.
#[derive(Debug)]
pub(super) struct Backoff {
    next: Duration,
    /// How long this process goes on without the learner; for ever if absent.
    give_up_after: Option<Duration>,
    /// Since when it is without the learner.
    alone_since: Option<Instant>,
    /// When it was refused first, and last.
    unwelcome: Option<(Instant, Instant)>,
}

impl Backoff {
    pub(super) fn new(give_up_after: Option<Duration>) -> Self {
        Self { next: FIRST, give_up_after, alone_since: None, unwelcome: None }
    }

    /// The learner has answered, and accepts this process.
    pub(super) fn answered(&mut self) {
        (self.alone_since, self.unwelcome) = (None, None);
    }

    /// The connection was good: the next delay is a short one again.
    pub(super) fn reset(&mut self) {
        self.next = FIRST;
    }

    /// Between half of the current delay and the whole; the delay doubles.
    fn draw(&mut self) -> Duration {
        let delay = self.next.mul_f64(rand::rng().random_range(0.5..=1.0));
        self.next = (self.next * 2).min(LONGEST);
        delay
    }

    /// Logs the failure, and waits until the next attempt.
    ///
    /// # Errors
    /// A failure that a retry cannot help; [`Error::GaveUp`], when the learner has not answered for too long.
    pub(super) async fn retry(&mut self, learner: &str, failure: Failure) -> Result<(), Error> {
        match failure {
            Failure::Fatal(error) => Err(error),
            Failure::Lost(reason) => self.wait(learner, &reason).await,
            Failure::Unwelcome(error) => {
                let (patience, now) =
                    (self.give_up_after.map_or(UNWELCOME, |limit| limit.min(UNWELCOME)), Instant::now());
                let (first, _) = self.unwelcome.filter(|(_, last)| now - *last < PAUSE).unwrap_or((now, now));
                if now - first >= patience {
                    return Err(error);
                }
                self.unwelcome = Some((first, now));
                self.alone_since = None;
                self.wait(learner, &chain(&error)).await
            }
            Failure::Postponed(reason) => {
                self.answered();
                self.wait(learner, &reason).await
            }
        }
    }

    async fn wait(&mut self, learner: &str, reason: &str) -> Result<(), Error> {
        let alone = self.alone_since.get_or_insert_with(Instant::now).elapsed();
        let mut delay = self.draw();
        if let Some(limit) = self.give_up_after {
            if alone >= limit {
                return Err(Error::GaveUp { learner: learner.into(), after: limit, reason: reason.into() });
            }
            delay = delay.min(limit - alone);
        }
        tracing::warn!(learner, again_in_seconds = delay.as_secs_f32(), "no connection to the learner: {reason}");
        tokio::time::sleep(delay).await;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_grow_from_a_tenth_of_a_second_to_five_and_stay() {
        let mut backoff = Backoff::new(None);
        let delays: Vec<Duration> = (0..20).map(|_| backoff.draw()).collect();
        assert!(delays[0] <= FIRST && delays[0] >= FIRST / 2);
        assert!(delays[19] <= LONGEST && delays[19] >= LONGEST / 2);
        assert!(delays.windows(3).take(4).all(|window| window[2] >= window[0]));
    }

    #[tokio::test]
    async fn only_silence_counts_towards_giving_up() {
        let limit = Duration::from_millis(200);
        let mut backoff = Backoff::new(Some(limit));
        let begun = Instant::now();
        let lost = || Failure::Lost("no answer".into());
        let waited = loop {
            if let Err(error) = backoff.retry("nobody", lost()).await {
                assert!(matches!(error, Error::GaveUp { .. }), "{error}");
                break begun.elapsed();
            }
        };
        assert!(waited >= limit, "{waited:?}");
        backoff.retry("nobody", Failure::Postponed("later".into())).await.unwrap();
    }
}
