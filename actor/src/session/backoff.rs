//! The wait before another attempt.

use std::time::Duration;

use rand::Rng as _;

const FIRST: Duration = Duration::from_millis(100);
const LONGEST: Duration = Duration::from_secs(5);

/// Exponential back-off, 0.1 s to 5 s, with jitter, so that not all actors
/// reach a restarted learner at the same moment.
#[derive(Debug)]
pub(super) struct Backoff {
    next: Duration,
}

impl Default for Backoff {
    fn default() -> Self {
        Self { next: FIRST }
    }
}

impl Backoff {
    /// Between half of the current delay and the whole; the delay doubles.
    fn draw(&mut self) -> Duration {
        let delay = self.next.mul_f64(rand::rng().random_range(0.5..=1.0));
        self.next = (self.next * 2).min(LONGEST);
        delay
    }

    /// Logs the reason, and waits.
    pub(super) async fn wait(&mut self, learner: &str, reason: &str) {
        let delay = self.draw();
        tracing::warn!(learner, again_in_seconds = delay.as_secs_f32(), "no connection to the learner: {reason}");
        tokio::time::sleep(delay).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_grow_from_a_tenth_of_a_second_to_five_and_stay() {
        let mut backoff = Backoff::default();
        let delays: Vec<Duration> = (0..20).map(|_| backoff.draw()).collect();
        assert!(delays[0] <= FIRST && delays[0] >= FIRST / 2);
        assert!(delays[19] <= LONGEST && delays[19] >= LONGEST / 2);
        assert!(delays.windows(3).take(4).all(|window| window[2] >= window[0]));
    }
}
