//! Runs whose logs and checkpoints are made up.

use std::fmt::Write as _;
use std::ops::Range;

use tempfile::TempDir;

use super::*;
use crate::train;

/// Environments of an actor.
const ENVIRONMENTS: u64 = 4;
/// The checkpoints, with the seconds of their snapshots. A killed learner is resumed from the second one.
const EARLIER: (u64, &str) = (8, "checkpoint-0000000003");
const RESUMED: (u64, &str) = (10, "checkpoint-0000000007");
const LAST: (u64, &str) = (40, "checkpoint-0000000009");
/// The seconds at which a killed learner is started again, and at which the run ends.
const RESTARTED: u64 = 20;
const ENDED: u64 = 50;

/// What the files of a run say.
struct Run {
    directory: TempDir,
    learner_killed: bool,
    actors: Vec<Actor>,
    /// Unrolls in flight in the checkpoint from which the learner is resumed.
    in_flight: u64,
    /// What the last checkpoint counts as lost at restart; and the one from which the learner is resumed.
    lost: u64,
    lost_before: u64,
    /// Unrolls that arrive after the last checkpoint.
    arrive: u64,
}

/// One actor with one process.
struct Actor {
    log: String,
    incarnation: u64,
    /// Whether it joins the learner that was started again.
    joins_again: bool,
    /// Its unrolls that the two checkpoints have.
    before: u64,
    counted: u64,
}

impl Actor {
    /// An actor that has joined. The checkpoints have so many of its unrolls.
    fn new(incarnation: u64, before: u64, counted: u64) -> Self {
        let mut actor = Self { log: String::new(), incarnation, joins_again: false, before, counted };
        actor.says(0, "INFO joined the learner actor=0 learner_epoch=1");
        let acting = "INFO acting experiment=\"quickstart\" threads=1";
        actor.says(0, &format!("{acting} environments={ENVIRONMENTS} pace=Free"));
        actor
    }

    fn says(&mut self, second: u64, text: &str) {
        writeln!(self.log, "2026-01-01T00:00:{second:02}.000000Z  {text}").unwrap();
    }

    fn unrolls(&mut self, second: u64, numbers: Range<u64>, event: &str) {
        for sequence in numbers {
            let incarnation = format!("{:016x}", self.incarnation);
            let unroll = format!("unroll{{incarnation={incarnation} sequence={sequence} version=1 environment=0}}");
            self.says(second, &format!("DEBUG {unroll}: {event}"));
        }
    }

    fn makes(mut self, second: u64, numbers: Range<u64>) -> Self {
        self.unrolls(second, numbers, "made");
        self
    }

    fn hears(mut self, second: u64, numbers: Range<u64>) -> Self {
        self.unrolls(second, numbers, "acknowledged verdict=Taken");
        self
    }

    fn joins_again(mut self) -> Self {
        self.joins_again = true;
        self.says(RESTARTED + 1, "INFO joined the learner actor=0 learner_epoch=2");
        self
    }

    /// It ends by itself, and says that so many unrolls have no acknowledgement.
    fn exits(mut self, left: u64) -> Self {
        if left > 0 {
            self.says(ENDED, &format!("WARN some unrolls were not acknowledged in time unrolls={left}"));
        }
        self.says(ENDED, "INFO exiting steps=7990 settled=Settled { taken: 0, over: true }");
        self
    }
}

impl Run {
    /// A run in which nothing is killed.
    fn quiet(actors: impl Into<Vec<Actor>>) -> Self {
        Self {
            directory: tempfile::tempdir().unwrap(),
            learner_killed: false,
            actors: actors.into(),
            in_flight: 0,
            lost: 0,
            lost_before: 0,
            arrive: 0,
        }
    }

    /// A run whose learner is killed. So many unrolls are lost at its restart.
    fn preempted(actors: impl Into<Vec<Actor>>, lost: u64) -> Self {
        Self { learner_killed: true, lost, ..Self::quiet(actors) }
    }

    fn job(&self) -> Job {
        let has_run = self.directory.path().join("run/checkpoints").is_dir();
        Job::new(train::Options {
            preset: "quickstart".into(),
            clips: Vec::new(),
            overrides: Vec::new(),
            actors: self.actors.len() as u16,
            run: Some(self.directory.path().join("run")),
            port: None,
            minutes: None,
            episodes: None,
            no_evaluator: true,
            resume: has_run,
        })
        .unwrap()
    }

    fn checkpoint(&self, name: &str, lost: u64, in_flight: u64, unrolls: impl Fn(&Actor) -> u64) {
        let path = self.directory.path().join("run/checkpoints").join(name);
        fs::create_dir_all(&path).unwrap();
        let counted: Vec<_> = self.actors.iter().map(|actor| (actor.incarnation, unrolls(actor))).collect();
        let produced = counted.iter().map(|(_, unrolls)| unrolls).sum::<u64>();
        let accounts =
            counted.iter().map(|(incarnation, next)| json!({"incarnation": incarnation, "next_sequence": next}));
        let accounting = json!({
            "produced": produced, "trained": produced - lost - in_flight, "in_flight": in_flight,
            "dropped": { "stale": 0, "lost_at_restart": lost },
        });
        let ledger = json!({ "accounting": accounting, "accounts": accounts.collect::<Vec<_>>() });
        fs::write(path.join("accounting.json"), ledger.to_string()).unwrap();
    }

    fn learner_log(&self) -> String {
        let checkpoints = self.directory.path().join("run/checkpoints");
        let joins = |actor: &Actor| format!("actor joined actor=0 incarnation={:016x} peer=None", actor.incarnation);
        let taken = |(second, name): (u64, &str)| (second, format!("taking a snapshot checkpoint={name}"));
        let serving = "serving address=127.0.0.1:7070 epoch=1 rank=0".to_owned();
        let mut lines = vec![(0, serving), taken((0, "initial"))];
        lines.extend(self.actors.iter().map(|actor| (1, joins(actor))));
        lines.extend([EARLIER, RESUMED].map(taken));
        if self.learner_killed {
            let resuming = format!("resuming checkpoint={}", checkpoints.join(RESUMED.1).display());
            lines.push((RESTARTED, resuming));
            lines.push((RESTARTED, "serving address=127.0.0.1:7070 epoch=2 rank=0".to_owned()));
            let again = self.actors.iter().filter(|actor| actor.joins_again);
            lines.extend(again.map(|actor| (RESTARTED + 1, joins(actor))));
        }
        let at_end = self.actors.iter().map(|actor| actor.counted).sum::<u64>() + self.arrive;
        let end = format!("the budget is used up accounting=Accounting {{ produced: {at_end}, trained: 1 }}");
        lines.extend([taken(LAST), (ENDED, end)]);
        let line = |(second, text)| format!("2026-01-01T00:00:{second:02}.000000Z  INFO comic_learner::run: {text}\n");
        lines.into_iter().map(line).collect()
    }

    /// Writes the files and reads them.
    fn unrolls(&self) -> Result<Unrolls> {
        let job = self.job();
        if self.learner_killed {
            self.checkpoint(RESUMED.1, self.lost_before, self.in_flight, |actor| actor.before);
        }
        self.checkpoint(LAST.1, self.lost, 0, |actor| actor.counted);
        fs::write(job.learner_log(), self.learner_log()).unwrap();
        for (path, actor) in job.actor_logs().iter().zip(&self.actors) {
            fs::write(path, &actor.log).unwrap();
        }
        let line = r#"{"accounting":{"produced":3,"trained":2,"dropped":{"stale":1},"in_flight":0}}"#;
        fs::write(job.metrics(), format!("{line}\n")).unwrap();
        Unrolls::of(&job)
    }

    /// What the benchmark says at its end; nothing if it has found every unroll.
    fn fault(&self) -> String {
        let checked = self.unrolls().and_then(|unrolls| unrolls.check(self.learner_killed));
        checked.err().map_or_else(String::new, |error| format!("{error:#}"))
    }
}

/// An actor all of whose 100 unrolls are counted.
fn steady() -> Actor {
    Actor::new(1, 100, 100).makes(1, 0..100).hears(1, 0..100)
}

#[test]
fn a_quiet_run_of_which_every_unroll_is_found_passes() {
    // One was killed, and its last acknowledgement was lost. The other one's last two came when the run was over.
    let killed = Actor::new(1, 0, 97).makes(1, 0..100).hears(1, 0..96);
    let exited = Actor::new(2, 0, 67).makes(1, 0..70).hears(1, 0..69).exits(1);
    let run = Run { arrive: 2, ..Run::quiet([killed, exited]) };
    let found = run.unrolls().unwrap();
    assert_eq!((found.made, found.late, found.forgotten, found.unheard), (170, 2, 0, 4));
    assert_eq!(found.made, found.last.produced + found.late + found.forgotten + found.unheard);
    assert_eq!(run.fault(), "");
}

#[test]
fn an_unroll_that_an_actor_never_sends_is_a_fault() {
    let actor = Actor::new(1, 0, 100).makes(1, 0..100).hears(1, 0..10).hears(1, 21..100).exits(0);
    // The learner counts what it never sees as lost at restart.
    let run = Run { lost: 11, ..Run::quiet([actor]) };
    let fault = run.fault();
    assert!(fault.contains("later acknowledgements, and none of the unrolls 10 to 20"), "{fault}");
    assert!(fault.contains("11 unrolls are counted as lost at restart, and by the logs there are 0"), "{fault}");
}

#[test]
fn unrolls_that_a_living_learner_counts_as_lost_are_a_fault() {
    let run = Run { lost: 11, ..Run::quiet([steady().exits(0)]) };
    assert!(run.fault().contains("11 unrolls are counted as lost at restart"), "{}", run.fault());
}

/// An actor with 60 unrolls in the checkpoint from which the learner is resumed. Nine more were acknowledged before the kill, and
/// one was sent again.
fn survivor() -> Actor {
    let before = Actor::new(1, 60, 100).makes(5, 0..60).hears(5, 0..60).makes(15, 60..70).hears(15, 60..69);
    before.joins_again().makes(30, 70..100).hears(30, 69..100)
}

#[test]
fn what_the_killed_learner_acknowledged_after_its_checkpoint_is_lost_and_counted() {
    let run = Run { in_flight: 8, ..Run::preempted([survivor().exits(0)], 9 + 8) };
    let found = run.unrolls().unwrap();
    assert_eq!((found.explained, found.late, found.forgotten, found.unheard), (17, 0, 0, 0));
    assert_eq!(run.fault(), "");
}

#[test]
fn a_restart_that_loses_more_or_less_than_the_logs_say_is_a_fault() {
    for lost in [16, 18] {
        let fault = Run { in_flight: 8, ..Run::preempted([survivor().exits(0)], lost) }.fault();
        assert!(fault.contains(&format!("{lost} unrolls are counted as lost at restart")), "{fault}");
        assert!(fault.contains("by the logs there are 17"), "{fault}");
    }
}

#[test]
fn unrolls_that_were_lost_before_the_learner_was_killed_are_a_fault() {
    // They are among the 17 of the last checkpoint.
    let fault = Run { in_flight: 8, lost_before: 3, ..Run::preempted([survivor().exits(0)], 17) }.fault();
    assert!(fault.contains("3 unrolls were lost at restart before the learner was killed"), "{fault}");
}

/// An actor that is killed with unrolls that the killed learner acknowledged after its checkpoint.
fn forgotten() -> Actor {
    Actor::new(2, 40, 40).makes(5, 0..40).hears(5, 0..40).makes(15, 40..50).hears(15, 40..46)
}

#[test]
fn an_actor_that_is_killed_before_it_joins_again_takes_its_newest_unrolls_with_it() {
    let run = Run::preempted([survivor().exits(0), forgotten()], 9);
    let found = run.unrolls().unwrap();
    assert_eq!((found.late, found.forgotten, found.unheard), (0, 6, 4));
    assert_eq!(run.fault(), "");
}

#[test]
fn an_actor_that_has_joined_again_may_forget_nothing() {
    // Joining, it told the new learner about its 46 unrolls.
    let killed = forgotten().joins_again();
    let fault = Run::preempted([survivor().exits(0), killed], 9).fault();
    assert!(fault.contains("6 unrolls were acknowledged and are not in the last checkpoint"), "{fault}");
    // Ten seconds later it has more, which the new learner acknowledged.
    let killed = forgotten().joins_again().hears(30, 46..50);
    let fault = Run::preempted([survivor().exits(0), killed], 9).fault();
    assert!(fault.contains("10 unrolls were acknowledged and are not in the last checkpoint"), "{fault}");
}

#[test]
fn an_actor_that_was_not_killed_may_forget_nothing() {
    let fault = Run::preempted([survivor().exits(0), forgotten().exits(4)], 9).fault();
    assert!(fault.contains("6 unrolls were acknowledged and are not in the last checkpoint"), "{fault}");
}

#[test]
fn only_what_was_acknowledged_after_the_checkpoint_may_be_forgotten() {
    let killed = Actor::new(2, 10, 10).makes(5, 0..10).hears(5, 0..10).makes(11, 10..40).hears(11, 10..40);
    assert_eq!(Run::preempted([survivor().exits(0), killed], 9).fault(), "");
    // It has no reason to lack older ones: the learner acknowledged them, and counted them nowhere.
    let killed = Actor::new(2, 10, 10).makes(9, 0..40).hears(9, 0..40);
    let fault = Run::preempted([survivor().exits(0), killed], 9).fault();
    let text =
        "had 40 acknowledged unrolls before the snapshot was taken from which the learner was resumed, which has 10";
    assert!(fault.contains(text), "{fault}");
}

#[test]
fn an_account_does_not_shrink() {
    let fault = Run::preempted([survivor().exits(0), Actor { counted: 39, ..forgotten() }], 9).fault();
    assert!(fault.contains("had 40 unrolls when the learner was resumed, and has 39"), "{fault}");
}

#[test]
fn a_killed_actor_has_at_most_one_unanswered_unroll_of_each_environment() {
    let ended_with = |unanswered: u64| Actor::new(1, 0, 50).makes(1, 0..50 + unanswered).hears(1, 0..50);
    assert_eq!(Run::quiet([ended_with(ENVIRONMENTS)]).fault(), "");
    let fault = Run::quiet([ended_with(ENVIRONMENTS + 1)]).fault();
    assert!(fault.contains("ended with 5 unrolls without acknowledgement, and has 4 environments"), "{fault}");
}

#[test]
fn an_actor_that_ends_by_itself_names_every_unroll_that_it_leaves() {
    let actor = || Actor::new(1, 0, 50).makes(1, 0..53).hears(1, 0..50);
    assert_eq!(Run::quiet([actor().exits(3)]).fault(), "");
    for named in [0, 2, 4] {
        let fault = Run::quiet([actor().exits(named)]).fault();
        let expected = format!("ended with 3 unrolls without acknowledgement, and says that there were {named}");
        assert!(fault.contains(&expected), "{fault}");
    }
}

#[test]
fn an_acknowledged_unroll_that_no_learner_has_counted_is_a_fault() {
    let actor = || Actor::new(1, 0, 90).makes(1, 0..100).hears(1, 0..100).exits(0);
    assert_eq!(Run { arrive: 10, ..Run::quiet([actor()]) }.fault(), "");
    let fault = Run { arrive: 9, ..Run::quiet([actor()]) }.fault();
    assert!(fault.contains("10 unrolls were acknowledged and are not in the last checkpoint, and only 9"), "{fault}");
}

#[test]
fn a_learner_that_starts_again_by_itself_is_a_fault() {
    let error = Run::preempted([survivor().exits(0)], 9).unrolls().unwrap().check(false).unwrap_err().to_string();
    assert!(error.contains("the learner was started 2 times"), "{error}");
    let error = Run::quiet([steady()]).unrolls().unwrap().check(true).unwrap_err().to_string();
    assert!(error.contains("the learner was started 1 times"), "{error}");
}

#[test]
fn a_checkpoint_that_was_resumed_and_is_gone_is_named() {
    let run = Run::preempted([survivor().exits(0)], 9);
    run.unrolls().unwrap();
    let job = run.job();
    fs::remove_dir_all(run.directory.path().join("run/checkpoints").join(RESUMED.1)).unwrap();
    let error = format!("{:#}", Unrolls::of(&job).unwrap_err());
    assert!(error.contains("it has to be kept") && error.contains(RESUMED.1), "{error}");
}

#[test]
fn accounts_that_contradict_themselves_or_the_actors_are_faults() {
    let fault = Run::quiet([Actor::new(1, 0, 51).makes(1, 0..50).hears(1, 0..50)]).fault();
    assert!(fault.contains("made 50 unrolls, and 51 are counted"), "{fault}");
    let fault = Run::quiet([steady(), Actor::new(3, 0, 9)]).fault();
    assert!(fault.contains("9 unrolls are of the actor 0000000000000003, which has no log"), "{fault}");

    let run = Run::quiet([steady()]);
    run.unrolls().unwrap();
    let job = run.job();
    let unbalanced = r#"{"accounting":{"produced":3,"trained":2,"dropped":{},"in_flight":0}}"#;
    fs::write(job.metrics(), format!("{unbalanced}\n{{}}\n")).unwrap();
    let accounts = json!([{ "incarnation": 1, "next_sequence": 100 }]);
    let ledger = json!({ "accounting": { "produced": 99, "trained": 98 }, "accounts": accounts });
    fs::write(job.newest_checkpoint().unwrap().join("accounting.json"), ledger.to_string()).unwrap();
    let fault = Unrolls::of(&job).unwrap().check(false).unwrap_err().to_string();
    for expected in [
        "line 1 of metrics.jsonl does not balance",
        "line 2 of metrics.jsonl does not balance",
        "the last checkpoint does not balance",
        "100 unrolls in all",
    ] {
        assert!(fault.contains(expected), "{fault}");
    }
}
