//! Lockstep: which actor simulates which environments of the run.

use std::ops::Range;

use parking_lot::Mutex;

/// The environments of a run in lockstep. Each is assigned to one actor at most.
#[derive(Debug)]
pub(super) struct Assignments {
    /// For each environment, the incarnation of the actor that simulates it, or did until it left.
    owners: Mutex<Vec<Option<u64>>>,
}

/// The environments of one actor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Assignment {
    /// Their numbers; there is at least one.
    pub(super) environments: Range<u32>,
    /// Whether some of them belonged to another actor, which is gone.
    pub(super) inherited: bool,
    /// Environments that are still free.
    pub(super) left: usize,
}

/// Why an actor gets no environments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Denied {
    /// Other actors simulate all of them.
    Taken,
    /// The actor comes back, but its environments began anew: with another actor, or in another learner epoch.
    Lost,
}

impl Assignments {
    /// So many free environments.
    pub(super) fn new(environments: usize) -> Self {
        Self { owners: Mutex::new(vec![None; environments]) }
    }

    /// The environments that the actor has, or else the first free ones that lie together, at most `wanted`. If no environment
    /// is free, those of an actor that is not `expected` any more count as free. An actor that `returns` gets the environments
    /// that it had, or none.
    pub(super) fn claim(
        &self,
        incarnation: u64,
        wanted: u64,
        returns: bool,
        expected: impl Fn(u64) -> bool,
    ) -> Result<Assignment, Denied> {
        let mut owners = self.owners.lock();
        let own = |owner: &Option<u64>| *owner == Some(incarnation);
        let free = |owner: &Option<u64>| owner.is_none_or(|owner| !expected(owner));
        let mut inherited = false;
        if !owners.iter().any(own) {
            if returns {
                return Err(Denied::Lost);
            }
            let unassigned = owners.iter().position(Option::is_none);
            let first = unassigned.or_else(|| owners.iter().position(free)).ok_or(Denied::Taken)?;
            let wanted = usize::try_from(wanted.max(1)).unwrap_or(usize::MAX);
            let count = owners[first..].iter().take(wanted).take_while(|owner| free(owner)).count();
            let gone: Vec<_> = owners[first..first + count].iter().copied().flatten().collect();
            inherited = !gone.is_empty();
            // An actor that loses one environment loses all of them.
            for owner in owners.iter_mut().filter(|owner| owner.is_some_and(|owner| gone.contains(&owner))) {
                *owner = None;
            }
            owners[first..first + count].fill(Some(incarnation));
        }
        let first = owners.iter().position(own).unwrap_or_default();
        let count = owners.iter().filter(|owner| own(owner)).count();
        let left = owners.iter().filter(|owner| free(owner)).count();
        Ok(Assignment { environments: first as u32..(first + count) as u32, inherited, left })
    }

    /// Whether an environment is assigned to this actor.
    pub(super) fn owns(&self, incarnation: u64, environment: u32) -> bool {
        self.owners.lock().get(environment as usize).is_some_and(|owner| *owner == Some(incarnation))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn all(_: u64) -> bool {
        true
    }

    fn assigned(environments: Range<u32>, inherited: bool, left: usize) -> Result<Assignment, Denied> {
        Ok(Assignment { environments, inherited, left })
    }

    #[test]
    fn actors_get_free_environments_in_turn_until_none_is_left() {
        let assignments = Assignments::new(8);
        assert_eq!(assignments.claim(70, 3, false, all), assigned(0..3, false, 5));
        assert_eq!(assignments.claim(71, 3, false, all), assigned(3..6, false, 2));
        assert_eq!(assignments.claim(72, 3, false, all), assigned(6..8, false, 0));
        assert_eq!(assignments.claim(73, 3, false, all), Err(Denied::Taken));
    }

    #[test]
    fn an_actor_that_comes_back_gets_the_environments_that_it_had() {
        let assignments = Assignments::new(8);
        assignments.claim(70, 3, false, all).unwrap();
        assert_eq!(assignments.claim(70, 8, true, all), assigned(0..3, false, 5));
        assert_eq!(
            assignments.claim(70, 8, false, all),
            assigned(0..3, false, 5),
            "the reply to its first request was lost"
        );
        assert_eq!(
            assignments.claim(71, 3, true, all),
            Err(Denied::Lost),
            "it was assigned in an earlier learner epoch"
        );
    }

    #[test]
    fn the_environments_of_a_lost_actor_are_inherited_and_it_loses_all_of_them() {
        let assignments = Assignments::new(8);
        assignments.claim(70, 4, false, all).unwrap();
        assignments.claim(71, 4, false, all).unwrap();
        let without = |incarnation| incarnation != 70;
        assert_eq!(assignments.claim(72, 2, false, without), assigned(0..2, true, 2));
        assert_eq!(assignments.claim(70, 4, true, all), Err(Denied::Lost));
        assert_eq!(assignments.claim(73, 4, false, all), assigned(2..4, false, 0));
    }

    proptest! {
        /// Actors join, leave and come back. At most one present actor simulates an environment.
        #[test]
        fn no_environment_has_two_actors(
            environments in 1_usize..12,
            claims in prop::collection::vec((0_u64..6, 0_u64..6, any::<bool>(), 0_u64..6), 0..40),
        ) {
            let assignments = Assignments::new(environments);
            let mut simulated = std::collections::HashMap::<u64, Range<u32>>::new();
            for (incarnation, wanted, returns, absent) in claims {
                let claimed = assignments.claim(incarnation, wanted, returns, |owner| owner != absent || owner == incarnation);
                match claimed {
                    Ok(assigned) => {
                        prop_assert!(!assigned.environments.is_empty());
                        prop_assert!(assigned.environments.end as usize <= environments);
                        let overlaps = |other: &Range<u32>| {
                            other.start < assigned.environments.end && assigned.environments.start < other.end
                        };
                        for (other, theirs) in &simulated {
                            prop_assert!(*other == incarnation || *other == absent || !overlaps(theirs));
                        }
                        simulated.retain(|_, theirs| !overlaps(theirs));
                        simulated.insert(incarnation, assigned.environments);
                    }
                    Err(Denied::Lost) => prop_assert!(returns),
                    Err(Denied::Taken) => {}
                }
            }
        }
    }
}
