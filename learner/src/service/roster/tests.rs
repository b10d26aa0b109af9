//! The roster's rules.

use super::*;

/// The name of an actor without a certificate.
fn name(text: &str) -> Name<'_> {
    Name { text, owner: None }
}

fn census(roster: &Roster, now: Instant) -> (u64, u64, u64, u64) {
    let Census { alive, slow, lost, waiting } = roster.census(now);
    (alive, slow, lost, waiting)
}

fn joins(roster: &Roster, incarnation: u64, now: Instant) -> bool {
    roster.join(incarnation, name(""), None, now) == Joined::Welcome
}

#[test]
fn an_actor_is_alive_then_slow_then_lost_then_forgotten() {
    let (roster, start) = (Arc::new(Roster::new(10)), Instant::now());
    assert!(joins(&roster, 1, start));
    assert_eq!(census(&roster, start), (1, 0, 0, 0));
    let watching = roster.open_stream(1);
    assert_eq!(census(&roster, start + SLOW), (0, 1, 0, 0));
    let waiting = roster.begin_waiting(1);
    assert_eq!(census(&roster, start + SLOW), (1, 0, 0, 1), "the actor waits for the learner");
    drop(waiting);
    roster.heard(1, start + SLOW);
    assert_eq!(census(&roster, start + SLOW), (1, 0, 0, 0));
    drop(watching);
    assert_eq!(census(&roster, Instant::now()), (0, 0, 1, 0));
    assert_eq!(census(&roster, Instant::now() + REMEMBERED), (0, 0, 0, 0));
}

#[test]
fn an_actor_keeps_its_name_when_its_certificate_gets_another_subject() {
    let (roster, start) = (Arc::new(Roster::new(10)), Instant::now());
    let join = |incarnation, owner| {
        roster.join(incarnation, Name { text: "walker", owner: Some([owner; 32]) }, Some(incarnation), start)
    };
    assert_eq!(join(1, 7), Joined::Welcome);
    assert_eq!(join(2, 8), Joined::Foreign);
    assert_eq!(join(1, 8), Joined::Welcome, "the same process");
    assert_eq!((join(2, 8), join(3, 7)), (Joined::Welcome, Joined::Foreign), "the name belongs to the new certificate");
}

#[test]
fn an_actor_without_a_stream_is_absent_until_it_has_opened_one() {
    let (roster, start) = (Arc::new(Roster::new(10)), Instant::now());
    assert!(joins(&roster, 1, start) && joins(&roster, 2, start));
    let watching = roster.open_stream(1);
    let mut absent = roster.absent(start);
    assert!(absent.remain(), "the second one never opened a stream");
    drop(watching);
    assert!(absent.remain(), "only the first one was there");
    drop(roster.open_stream(2));
    roster.heard(2, Instant::now());
    assert!(!absent.remain(), "the second one was here, and has left");
    assert!(roster.absent(Instant::now()).remain(), "both have left");
    assert!(!roster.absent(Instant::now() + GRACE).remain(), "they left long ago");
}

#[test]
fn the_limit_counts_present_actors_and_lets_them_reconnect() {
    let (roster, start) = (Arc::new(Roster::new(2)), Instant::now());
    assert!(joins(&roster, 1, start) && joins(&roster, 2, start));
    assert!(!joins(&roster, 3, start));
    assert!(joins(&roster, 1, start), "a reconnection");
    assert!(joins(&roster, 3, start + GRACE), "an actor that joins and opens no stream loses its place");
}

#[test]
fn a_newer_process_supersedes_older_ones_of_its_name_for_ever() {
    let (roster, start) = (Arc::new(Roster::new(2)), Instant::now());
    assert_eq!(roster.join(1, name("pod-0"), None, start), Joined::Welcome);
    assert_eq!(roster.join(2, name("pod-1"), None, start), Joined::Welcome);
    let _watching = roster.open_stream(1);
    assert_eq!(roster.join(3, name("pod-2"), None, start), Joined::Full);
    assert_eq!(roster.join(4, name("pod-0"), None, start), Joined::Welcome, "it replaces an actor that counted");
    assert!(!roster.heard(1, start) && roster.heard(4, start));
    roster.set_index(4, 4);
    assert!(roster.is_superseded(1) && !roster.is_superseded(2) && !roster.is_superseded(4));
    assert!(!roster.expects(1, start) && roster.expects(4, start));
    assert_eq!(roster.join(1, name("pod-0"), None, start), Joined::Superseded);
    assert_eq!(roster.join(4, name("pod-0"), None, start), Joined::Welcome, "a reconnection");
    assert_eq!(roster.join(2, name("pod-1"), None, start), Joined::Welcome);
}

#[test]
fn the_indices_tell_the_newer_process_after_the_roster_forgot_both() {
    let later = Instant::now() + REMEMBERED * 2;
    for order in [[(1, 3), (2, 7)], [(2, 7), (1, 3)]] {
        let roster = Roster::new(2);
        let joined = order.map(|(incarnation, had)| roster.join(incarnation, name("pod-0"), Some(had), later));
        assert_eq!(joined[0], Joined::Welcome);
        assert_eq!(roster.is_superseded(1), order[0].0 == 1, "the older one goes");
        assert_eq!(joined[1], if order[1].0 == 2 { Joined::Welcome } else { Joined::Superseded });
        assert!(!roster.is_superseded(2) && roster.heard(2, later));
    }
}

#[test]
fn actors_without_a_name_do_not_supersede_each_other() {
    let (roster, start) = (Roster::new(2), Instant::now());
    assert!(joins(&roster, 1, start) && joins(&roster, 2, start));
    assert!(roster.heard(1, start) && roster.heard(2, start));
}

#[test]
fn an_actor_that_sends_is_present_without_a_stream_of_parameters() {
    let (roster, start) = (Arc::new(Roster::new(1)), Instant::now());
    assert!(joins(&roster, 1, start));
    drop(roster.open_stream(1));
    let later = Instant::now();
    roster.heard(1, later);
    assert_eq!(roster.join(2, name(""), None, later), Joined::Full);
}

#[test]
fn an_actor_is_expected_while_it_is_present_and_for_the_grace_period() {
    let (roster, start) = (Arc::new(Roster::new(10)), Instant::now());
    assert!(!roster.expects(1, start));
    assert!(joins(&roster, 1, start) && roster.expects(1, start));
    let watching = roster.open_stream(1);
    assert!(roster.expects(1, start + GRACE * 2));
    drop(watching);
    let gone = Instant::now();
    assert!(roster.expects(1, gone) && !roster.expects(1, gone + GRACE));
}

#[test]
fn an_actor_that_stands_by_is_not_present_and_can_be_superseded() {
    let (roster, start) = (Arc::new(Roster::new(1)), Instant::now());
    let join = |incarnation| roster.join(incarnation, name("comic-actor-0"), None, start);
    assert_eq!(join(1), Joined::Welcome);
    roster.stand_by(1);
    assert_eq!(census(&roster, start), (0, 0, 0, 0));
    assert!(roster.open_stream(1).is_none() && !roster.expects(1, start));
    assert!(joins(&roster, 2, start), "an actor that stands by takes no place");
    roster.stand_by(2);
    assert_eq!(join(1), Joined::Welcome, "it joins again");
    roster.stand_by(1);
    assert_eq!(join(3), Joined::Welcome);
    assert_eq!(join(1), Joined::Superseded);
    assert!(roster.open_stream(3).is_some());
}

#[test]
fn an_actor_that_has_not_joined_is_not_counted_and_memory_is_bounded() {
    let roster = Arc::new(Roster::new(10));
    drop((roster.open_stream(7), roster.begin_waiting(7)));
    assert_eq!(roster.actors.lock().len(), 0);
    let start = Instant::now();
    for incarnation in 0..100 {
        assert!(joins(&roster, incarnation, start + (GRACE + REMEMBERED) * incarnation as u32));
    }
    assert!(roster.actors.lock().len() < 3);
}

#[test]
fn a_name_is_its_owners_until_the_last_actor_under_it_is_forgotten() {
    let (roster, start) = (Arc::new(Roster::new(10)), Instant::now());
    let join = |incarnation, text, owner, now| roster.join(incarnation, Name { text, owner }, None, now);
    assert_eq!(join(1, "pod-0", Some([1; 32]), start), Joined::Welcome);
    assert_eq!(join(2, "pod-0", Some([2; 32]), start), Joined::Foreign);
    assert_eq!(join(2, "pod-0", None, start), Joined::Foreign);
    assert!(!roster.is_superseded(1));
    assert_eq!(join(2, "pod-1", Some([2; 32]), start), Joined::Welcome);
    assert_eq!(join(3, "pod-0", Some([1; 32]), start), Joined::Welcome, "the owner's next process");
    assert_eq!(join(4, "", Some([1; 32]), start), Joined::Welcome, "no name is nobody's");
    assert_eq!(join(5, "", Some([2; 32]), start), Joined::Welcome);
    assert_eq!(join(6, "pod-0", Some([2; 32]), start + GRACE + REMEMBERED), Joined::Welcome);
}
