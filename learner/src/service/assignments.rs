//! Lockstep: which actor simulates which of the run's environments.

use std::ops::Range;
use std::sync::Mutex;

use super::lock;

/// The environments of a run in lockstep, each one actor's at most.
#[derive(Debug)]
pub(super) struct Assignments {
    /// By number: the incarnation that simulates it, or did before it went.
    owners: Mutex<Vec<Option<u64>>>,
}

/// Environments that an actor got.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Assignment {
    /// Their numbers, one at least.
    pub(super) environments: Range<u32>,
    /// Some of them were another actor's before, which is gone.
    pub(super) inherited: bool,
    /// Environments that are still nobody's.
    pub(super) left: usize,
}

/// Why an actor gets none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Denied {
    /// Others simulate all of them.
    Taken,
    /// It comes back, and what it simulated was begun anew: by another actor, or in another life of the learner.
    Lost,
}

impl Assignments {
    /// So many environments, all nobody's.
    pub(super) fn new(environments: usize) -> Self {
        Self { owners: Mutex::new(vec![None; environments]) }
    }

    /// What an actor has, or else the first stretch of free environments, up to `wanted` of them. Free is also, when
    /// nothing else is, what belongs to an actor that is not `expected` any more. An actor that `returns` gets what it had or nothing.
    pub(super) fn claim(
        &self,
        incarnation: u64,
        wanted: u64,
        returns: bool,
        expected: impl Fn(u64) -> bool,
    ) -> Result<Assignment, Denied> {
        let mut owners = lock(&self.owners);
        let own = |owner: &Option<u64>| *owner == Some(incarnation);
        let free = |owner: &Option<u64>| owner.is_none_or(|owner| !expected(owner));
        let mut inherited = false;
        if !owners.iter().any(own) {
            if returns {
                return Err(Denied::Lost);
            }
            let nobodys = owners.iter().position(Option::is_none);
            let first = nobodys.or_else(|| owners.iter().position(free)).ok_or(Denied::Taken)?;
            let wanted = usize::try_from(wanted.max(1)).unwrap_or(usize::MAX);
            let count = owners[first..].iter().take(wanted).take_while(|owner| free(owner)).count();
            let gone: Vec<_> = owners[first..first + count].iter().copied().flatten().collect();
            inherited = !gone.is_empty();
            // Whoever lost a part has lost all.
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

    /// Whether an environment is this actor's.
    pub(super) fn owns(&self, incarnation: u64, environment: u32) -> bool {
        lock(&self.owners).get(environment as usize).is_some_and(|owner| *owner == Some(incarnation))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn everybody(_: u64) -> bool {
        true
    }

    fn share(environments: Range<u32>, inherited: bool, left: usize) -> Result<Assignment, Denied> {
        Ok(Assignment { environments, inherited, left })
    }

    #[test]
    fn actors_get_what_is_left_in_turn_and_one_too_many_gets_nothing() {
        let assignments = Assignments::new(8);
        assert_eq!(assignments.claim(70, 3, false, everybody), share(0..3, false, 5));
        assert_eq!(assignments.claim(71, 3, false, everybody), share(3..6, false, 2));
        assert_eq!(assignments.claim(72, 3, false, everybody), share(6..8, false, 0));
        assert_eq!(assignments.claim(73, 3, false, everybody), Err(Denied::Taken));
    }

    #[test]
    fn who_comes_back_gets_what_it_had_and_nothing_else() {
        let assignments = Assignments::new(8);
        assignments.claim(70, 3, false, everybody).unwrap();
        assert_eq!(assignments.claim(70, 8, true, everybody), share(0..3, false, 5));
        assert_eq!(assignments.claim(70, 8, false, everybody), share(0..3, false, 5), "its reply was lost on the way");
        assert_eq!(assignments.claim(71, 3, true, everybody), Err(Denied::Lost), "of an earlier life of the learner");
    }

    #[test]
    fn what_a_lost_actor_had_is_inherited_and_lost_for_it_as_a_whole() {
        let assignments = Assignments::new(8);
        assignments.claim(70, 4, false, everybody).unwrap();
        assignments.claim(71, 4, false, everybody).unwrap();
        let without = |incarnation| incarnation != 70;
        assert_eq!(assignments.claim(72, 2, false, without), share(0..2, true, 2));
        assert_eq!(assignments.claim(70, 4, true, everybody), Err(Denied::Lost));
        assert_eq!(assignments.claim(73, 4, false, everybody), share(2..4, false, 0));
    }

    proptest! {
        /// Whoever comes, goes and comes back: an environment is simulated by one of those who are there, at most.
        #[test]
        fn no_environment_is_two_actors(
            environments in 1_usize..12,
            claims in prop::collection::vec((0_u64..6, 0_u64..6, any::<bool>(), 0_u64..6), 0..40),
        ) {
            let assignments = Assignments::new(environments);
            let mut simulated = std::collections::HashMap::<u64, Range<u32>>::new();
            for (incarnation, wanted, returns, absent) in claims {
                let claimed = assignments.claim(incarnation, wanted, returns, |owner| owner != absent || owner == incarnation);
                match claimed {
                    Ok(share) => {
                        prop_assert!(!share.environments.is_empty());
                        prop_assert!(share.environments.end as usize <= environments);
                        let overlaps = |other: &Range<u32>| {
                            other.start < share.environments.end && share.environments.start < other.end
                        };
                        for (other, theirs) in &simulated {
                            prop_assert!(*other == incarnation || *other == absent || !overlaps(theirs));
                        }
                        simulated.retain(|_, theirs| !overlaps(theirs));
                        simulated.insert(incarnation, share.environments);
                    }
                    Err(Denied::Lost) => prop_assert!(returns),
                    Err(Denied::Taken) => {}
                }
            }
        }
    }
}
