//! Which processes of a run are killed while it trains, and when: the machines of a cloud that may be taken away at any time.

use std::ops::Range;
use std::time::{Duration, Instant};

use rand::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg64;

/// The learner is killed in the middle third of the budget.
const LEARNER_SHARE: Range<f64> = 1.0 / 3.0..2.0 / 3.0;

/// Draws the kills of a run, and keeps what they cost.
pub(crate) struct Preemption {
    random: Pcg64,
    /// Kills a second that each actor can expect.
    rate: f64,
    /// The next kill of an actor, since the actors were started. `None` before the first one is drawn.
    next: Option<f64>,
    /// Used share of the budget at which the learner is killed; `None` if it is not, or was.
    learner_share: Option<f64>,
    /// When the learner is killed, once that share is used.
    learner_moment: Option<Instant>,
    /// The longest time between that share and the kill.
    learner_delay: Duration,
    /// Actors killed so far.
    pub(crate) actors_killed: u64,
    /// The learner's kill, when it was started again.
    pub(crate) learner_killed: Option<LearnerKilled>,
}

/// The environment steps of a learner that was killed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LearnerKilled {
    /// In its last line of metrics.
    pub(crate) reached: u64,
    /// In the checkpoint from which it was resumed.
    pub(crate) resumed: u64,
}

impl Preemption {
    /// Kills nothing.
    pub(crate) fn none() -> Self {
        Self {
            random: Pcg64::seed_from_u64(0),
            rate: 0.0,
            next: None,
            learner_share: None,
            learner_moment: None,
            learner_delay: Duration::ZERO,
            actors_killed: 0,
            learner_killed: None,
        }
    }

    /// Kills actors, each at this rate a second: the moments are a Poisson process.
    pub(crate) fn of_actors(rate: f64, seed: u64) -> Self {
        Self { random: Pcg64::seed_from_u64(seed), rate, ..Self::none() }
    }

    /// Also kills the learner, once. The used share of the budget is known from its lines of metrics. `delay` is the time between
    /// two of them: without it the kill would always follow a line at once.
    pub(crate) fn and_learner(mut self, delay: Duration) -> Self {
        self.learner_share = Some(self.random.random_range(LEARNER_SHARE));
        self.learner_delay = delay;
        self
    }

    /// The actors, of so many, that are killed until `elapsed` after their start and since the last call. Each is drawn from all
    /// of them, so it may be one that does not run at that moment.
    pub(super) fn actors_due(&mut self, elapsed: Duration, actors: usize) -> Vec<usize> {
        let mut due = Vec::new();
        let rate = self.rate * actors as f64;
        if rate <= 0.0 {
            return due;
        }
        loop {
            let next = self.next.unwrap_or_else(|| exponential(&mut self.random, rate));
            self.next = Some(next);
            if next > elapsed.as_secs_f64() {
                return due;
            }
            due.push(self.random.random_range(0..actors));
            self.next = Some(next + exponential(&mut self.random, rate));
        }
    }

    /// Whether the learner is killed now, if this share of the budget is used.
    pub(super) fn learner_due(&mut self, used: f64, now: Instant) -> bool {
        if self.learner_share.take_if(|share| used >= *share).is_some() {
            self.learner_moment = Some(now + self.learner_delay.mul_f64(self.random.random()));
        }
        self.learner_moment.take_if(|moment| now >= *moment).is_some()
    }
}

/// Seconds until the next event of a Poisson process with this rate.
fn exponential(random: &mut Pcg64, rate: f64) -> f64 {
    -(1.0 - random.random::<f64>()).ln() / rate
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The kills of `actors` actors in so many minutes at 5 % a minute, second by second.
    fn kills(actors: usize, minutes: u64, seed: u64) -> Vec<usize> {
        let mut preemption = Preemption::of_actors(0.05 / 60.0, seed);
        (0..=minutes * 60).flat_map(|second| preemption.actors_due(Duration::from_secs(second), actors)).collect()
    }

    #[test]
    fn as_many_actors_are_killed_as_the_rate_says_and_each_as_often_as_another() {
        // 8 actors · 5 % · 10,000 minutes = 4000, with a standard deviation of 63; for each actor 500, and 22.
        let kills = kills(8, 10_000, 1);
        assert!((3750..4250).contains(&kills.len()), "{}", kills.len());
        for actor in 0..8 {
            let own = kills.iter().filter(|victim| **victim == actor).count();
            assert!((400..600).contains(&own), "{own} of actor {actor}");
        }
    }

    #[test]
    fn the_seed_decides_the_kills_and_not_how_often_one_looks() {
        assert_eq!(kills(8, 100, 7), kills(8, 100, 7));
        assert_ne!(kills(8, 100, 7), kills(8, 100, 8));
        let mut seldom = Preemption::of_actors(0.05 / 60.0, 7);
        assert_eq!(seldom.actors_due(Duration::from_secs(6000), 8), kills(8, 100, 7));
    }

    #[test]
    fn nothing_is_killed_where_nothing_should_be() {
        let mut none = Preemption::none();
        assert!(none.actors_due(Duration::from_secs(1 << 40), 8).is_empty());
        assert!(!none.learner_due(1.0, Instant::now()));
    }

    #[test]
    fn the_learner_is_killed_once_in_the_middle_third() {
        for seed in 0..100 {
            let mut preemption = Preemption::of_actors(0.0, seed).and_learner(Duration::from_secs(5));
            let begun = Instant::now();
            assert!(!preemption.learner_due(0.333, begun));
            preemption.learner_due(0.667, begun);
            assert!(preemption.learner_due(0.667, begun + Duration::from_secs(5)));
            assert!(!preemption.learner_due(1.0, begun + Duration::from_secs(60)));
        }
    }
}
