//! Which rank an actor belongs to, when several learners train one run.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use comic_replay::home;
use parking_lot::Mutex;

use super::peer::Owner;

/// How long a rank may not know yet of an actor that was sent to it.
const ON_THE_WAY: Duration = Duration::from_secs(5);
/// How long a rank may have no actor before that is said, and said again.
const ALONE: Duration = Duration::from_secs(60);
/// Most names that are remembered in each of two generations, as many as actors in the roster. When there are more, the older generation
/// is forgotten, but for the names that came again meanwhile.
const CAPACITY: usize = 65_536;
/// Most actors that count as on their way.
const MOST_ON_THE_WAY: usize = 65_536;

/// An actor's name, or for one without a name its incarnation, and who gave it: nobody decides where the actors of others go.
pub(super) type Owned = (Option<Owner>, String);

/// Sends every actor to its rank. An actor that has an index belongs to the rank that the index says, for ever. A new one goes where the
/// fewest are, or to the rank of the last process of its name, which then knows that it replaces it.
#[derive(Debug)]
pub struct Placement {
    rank: usize,
    /// Where actors reach each rank: host and port.
    addresses: Vec<String>,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// Actors of each rank, as it last said.
    actors: Vec<u64>,
    /// Actors that were sent to a rank lately, and how many they are for each rank.
    sent: VecDeque<(Instant, usize)>,
    on_the_way: Vec<u64>,
    /// The rank of each name; the younger generation first.
    names: [HashMap<Owned, usize>; 2],
    /// Since when a rank has no actor, or since the last warning of it.
    waits_since: Option<Instant>,
}

impl Placement {
    /// For the rank `rank`, when actors reach the ranks at these addresses.
    pub fn new(rank: usize, addresses: Vec<String>) -> Self {
        let none = vec![0; addresses.len()];
        let state = State { actors: none.clone(), on_the_way: none, ..State::default() };
        Self { rank, addresses, state: Mutex::new(state) }
    }

    /// Notes how many actors each rank has. Warns when one has had none for long while others have some: every batch waits for it.
    pub fn count(&self, actors: &[u64], now: Instant) {
        let mut state = self.state.lock();
        if actors.len() == state.actors.len() {
            state.actors.copy_from_slice(actors);
        }
        let waits = self.rank == 0 && actors.contains(&0) && actors.iter().any(|actors| *actors > 0);
        if !waits {
            state.waits_since = None;
        } else if now.duration_since(*state.waits_since.get_or_insert(now)) >= ALONE {
            state.waits_since = Some(now);
            tracing::warn!(?actors, "a rank has no actor, and every batch waits for its share: start more actors");
        }
    }

    /// Where an actor has to go; `None` if it belongs here. `name` stays the same when it asks again. Only rank 0 sends new actors
    /// elsewhere.
    pub(super) fn elsewhere(&self, name: Owned, index: Option<u64>, now: Instant) -> Option<&str> {
        let rank = match index {
            Some(index) => {
                let rank = home(index, self.addresses.len());
                self.state.lock().remember(name, rank);
                rank
            }
            None if self.rank == 0 => self.state.lock().place(name, now),
            None => self.rank,
        };
        self.addresses.get(rank).filter(|_| rank != self.rank).map(String::as_str)
    }
}

impl State {
    fn place(&mut self, name: Owned, now: Instant) -> usize {
        if let Some(rank) = self.names.iter().find_map(|names| names.get(&name)).copied() {
            self.remember(name, rank);
            return rank;
        }
        while let Some((_, rank)) = self.sent.pop_front_if(|(when, _)| now.duration_since(*when) >= ON_THE_WAY) {
            self.on_the_way[rank] -= 1;
        }
        let loads = self.actors.iter().zip(&self.on_the_way).map(|(here, sent)| here + sent);
        let rank = loads.zip(0..).min().map_or(0, |(_, rank)| rank);
        if self.sent.len() < MOST_ON_THE_WAY {
            self.sent.push_back((now, rank));
            self.on_the_way[rank] += 1;
        }
        self.remember(name, rank);
        rank
    }

    fn remember(&mut self, name: Owned, rank: usize) {
        let [younger, older] = &mut self.names;
        if younger.len() >= CAPACITY && !younger.contains_key(&name) {
            *older = std::mem::take(younger);
        }
        younger.insert(name, rank);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn placement(rank: usize) -> Placement {
        Placement::new(rank, ["a:1", "b:2", "c:3"].map(String::from).to_vec())
    }

    fn of(name: &str) -> Owned {
        (None, name.to_owned())
    }

    #[test]
    fn new_actors_go_where_the_fewest_are() {
        let (placement, now) = (placement(0), Instant::now());
        let names = ["1", "2", "3", "4", "5", "6"];
        let placed: Vec<_> = names.map(|name| placement.elsewhere(of(name), None, now)).to_vec();
        assert_eq!(placed, [None, Some("b:2"), Some("c:3"), None, Some("b:2"), Some("c:3")]);
        placement.count(&[9, 2, 8], now);
        let later = now + ON_THE_WAY;
        assert_eq!(placement.elsewhere(of("7"), None, later), Some("b:2"));
    }

    #[test]
    fn an_actor_with_an_index_belongs_to_one_rank_whoever_is_asked() {
        for rank in 0..3 {
            let found = placement(rank).elsewhere(of(""), Some(7), Instant::now()).map(str::to_owned);
            assert_eq!(found.as_deref(), (rank != 1).then_some("b:2"));
        }
    }

    #[test]
    fn a_process_goes_where_the_last_one_of_its_name_was() {
        let (placement, now) = (placement(0), Instant::now());
        assert_eq!(placement.elsewhere(of("one"), None, now), None);
        assert_eq!(placement.elsewhere(of("two"), None, now), Some("b:2"));
        placement.count(&[0, 50, 0], now);
        assert_eq!(placement.elsewhere(of("two"), None, now), Some("b:2"));
        // Also if rank 0 was started anew, and has only heard of the process that is replaced.
        let placement = self::placement(0);
        placement.elsewhere(of("three"), Some(5), now);
        assert_eq!(placement.elsewhere(of("three"), None, now), Some("c:3"));
    }

    #[test]
    fn a_name_in_use_outlives_any_number_of_others() {
        let (placement, now) = (placement(0), Instant::now());
        placement.elsewhere(of("one"), Some(2), now);
        for other in 0..3 * CAPACITY as u64 {
            placement.elsewhere(of(&other.to_string()), Some(other), now);
            if other.is_multiple_of(CAPACITY as u64 / 2) {
                assert_eq!(placement.elsewhere(of("one"), None, now), Some("c:3"), "after {other}");
            }
        }
        let names = placement.state.lock().names.each_ref().map(HashMap::len);
        assert!(names.iter().all(|names| *names <= CAPACITY), "{names:?}");
    }

    #[test]
    fn an_owner_cannot_decide_where_the_actors_of_another_one_go() {
        let (placement, now) = (placement(0), Instant::now());
        let [mine, theirs] = [1, 2].map(|owner| (Some([owner; 32]), "one".to_owned()));
        assert_eq!(placement.elsewhere(mine.clone(), Some(2), now), Some("c:3"));
        placement.elsewhere(theirs, Some(1), now);
        assert_eq!(placement.elsewhere(mine, None, now), Some("c:3"));
    }

    #[test]
    fn another_rank_than_the_first_keeps_the_new_actors_that_come_to_it() {
        assert_eq!(placement(2).elsewhere(of(""), None, Instant::now()), None);
    }
}
