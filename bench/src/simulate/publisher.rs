//! Which version a reader begins: the rules of `learner/src/publish.rs`.

/// Versions that are held for readers (`publish::HELD`).
const HELD: usize = 4;
/// Seconds after which a newer version may replace a held one that is still read (`Holding::longest`).
const LONGEST: f64 = 60.0;

#[derive(Debug, Default)]
pub(super) struct Publisher {
    newest: u64,
    held: Vec<Held>,
}

#[derive(Debug)]
struct Held {
    version: u64,
    begun: f64,
    readers: usize,
}

/// What a reader can do that has read a version to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Begun {
    /// It reads this version.
    Reading(u64),
    /// It waits for a newer version.
    NothingNew,
    /// It waits for one of the places, which older versions have.
    AllPlacesTaken,
}

impl Publisher {
    pub(super) fn publish(&mut self, version: u64) {
        self.newest = version;
    }

    /// Versions in memory: those held and the newest.
    pub(super) fn in_memory(&self) -> usize {
        self.held.len() + usize::from(self.held.iter().all(|held| held.version != self.newest))
    }

    /// Begins the newest version if it can be held, or else the newest held one that is newer than `finished`. The second
    /// value is a version that lost its place; its readers must begin another one.
    pub(super) fn begin(&mut self, finished: u64, now: f64) -> (Begun, Option<u64>) {
        if self.newest == finished {
            return (Begun::NothingNew, None);
        }
        let mut replaced = None;
        if self.held.iter().all(|held| held.version != self.newest) {
            let long = |held: &Held| now - held.begun >= LONGEST;
            if self.held.len() >= HELD
                && let Some(place) = self.held.iter().position(long)
            {
                replaced = Some(self.held.remove(place).version);
            }
            if self.held.len() < HELD {
                self.held.push(Held { version: self.newest, begun: now, readers: 0 });
            }
        }
        let unseen = self.held.iter_mut().filter(|held| held.version > finished);
        let Some(best) = unseen.max_by_key(|held| held.version) else { return (Begun::AllPlacesTaken, replaced) };
        best.readers += 1;
        (Begun::Reading(best.version), replaced)
    }

    /// A reader has read this version to its end. Says whether that left a place for another version.
    pub(super) fn finish(&mut self, version: u64) -> bool {
        let before = self.held.len();
        self.held.iter_mut().filter(|held| held.version == version).for_each(|held| held.readers -= 1);
        self.held.retain(|held| held.readers > 0);
        self.held.len() < before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_version_is_held_until_its_last_reader_has_it() {
        let mut publisher = Publisher::default();
        publisher.publish(1);
        assert_eq!(publisher.begin(0, 0.0), (Begun::Reading(1), None));
        assert_eq!(publisher.begin(0, 0.0), (Begun::Reading(1), None));
        publisher.publish(2);
        assert_eq!(publisher.in_memory(), 2);
        assert!(!publisher.finish(1));
        assert!(publisher.finish(1));
        assert_eq!(publisher.begin(1, 1.0), (Begun::Reading(2), None));
        assert_eq!(publisher.begin(2, 1.0), (Begun::NothingNew, None));
    }

    #[test]
    fn a_version_that_is_read_for_too_long_loses_its_place() {
        let mut publisher = Publisher::default();
        for version in 1..=HELD as u64 {
            publisher.publish(version);
            assert_eq!(publisher.begin(0, 0.0), (Begun::Reading(version), None));
        }
        publisher.publish(9);
        assert_eq!(publisher.begin(HELD as u64, 1.0), (Begun::AllPlacesTaken, None));
        assert_eq!(publisher.begin(0, 1.0), (Begun::Reading(HELD as u64), None));
        assert_eq!(publisher.begin(0, LONGEST), (Begun::Reading(9), Some(1)));
    }
}
