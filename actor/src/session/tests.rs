//! The session with a scripted learner, over real sockets.

mod learner;

use bytes::Bytes;
use comic_proto::v1::Environments;

use super::*;
use crate::mailbox::Directive;
use learner::{FakeLearner, Script};

const LIMITS: ExchangeLimits = ExchangeLimits { window: 4, parameters: 1000, flush: Duration::from_secs(60) };

fn options_for(learner: impl Into<String>) -> JoinSettings {
    JoinSettings {
        learner: learner.into(),
        access: Access::default(),
        cache: None,
        name: None,
        threads: None,
        environments: None,
        give_up_after: None,
    }
}

/// An unroll whose version is its number.
fn unroll(number: u64) -> FinishedUnroll {
    FinishedUnroll {
        payload: Bytes::from(vec![7; 100]),
        learner_epoch: 1,
        version: number,
        episodes: Vec::new(),
        environment: 0,
        task: 0,
        ticket: None,
    }
}

struct Running {
    unrolls: mpsc::Sender<FinishedUnroll>,
    mailbox: Arc<Mailbox>,
    stop: watch::Sender<bool>,
    session: tokio::task::JoinHandle<Result<Settled, Error>>,
}

async fn start(learner: &FakeLearner) -> Running {
    let (stop, stopped) = watch::channel(false);
    let options = options_for(learner.address());
    let joined = join(&options, stopped.clone()).await.unwrap();
    let (unrolls, receiver) = mpsc::channel(1);
    let mailbox = Arc::new(Mailbox::default());
    let session = tokio::spawn(joined.run(LIMITS, receiver, Arc::clone(&mailbox), stopped));
    Running { unrolls, mailbox, stop, session }
}

async fn first_directive(mailbox: &Arc<Mailbox>) -> Arc<Directive> {
    let mailbox = Arc::clone(mailbox);
    tokio::task::spawn_blocking(move || mailbox.wait()).await.unwrap().unwrap()
}

#[tokio::test]
async fn connections_dropped_in_mid_stream_lose_nothing_repeat_nothing_and_keep_the_order() {
    // Each connection breaks after some unrolls. Some of them were taken without an acknowledgement.
    let script = Script { breaks: vec![(3, 1), (1, 1), (5, 5), (0, 0), (2, 0)], ..Script::default() };
    let learner = FakeLearner::start(script).await;
    let running = start(&learner).await;
    for number in 0..40 {
        running.unrolls.send(unroll(number)).await.unwrap();
    }
    drop(running.unrolls);
    let settled = running.session.await.unwrap().unwrap();

    let seen = learner.seen();
    assert_eq!(seen.taken, (0..40).map(|number| (number, number)).collect::<Vec<_>>(), "sequence and content");
    // 2 + 0 + 0 + 0 + 2 unrolls were taken without an acknowledgement and sent again.
    assert_eq!((settled.taken, settled.duplicate), (36, 4));
    assert_eq!(seen.joins.len(), 6);
    assert!(
        seen.joins.iter().all(|join| join.incarnation == seen.joins[0].incarnation),
        "one process, one incarnation"
    );
    assert_eq!((seen.joins[0].actor, seen.joins[0].run), (None, None));
    let acknowledged: Vec<_> = seen.joins.iter().map(|join| join.acknowledged).collect();
    assert_eq!(acknowledged, [0, 1, 2, 7, 7, 7], "the number below which all were acknowledged");
    assert!(seen.joins[1..].iter().all(|join| (join.actor, join.run) == (Some(learner::ACTOR), Some(learner::RUN))));
}

#[tokio::test]
async fn an_actor_sends_its_name_and_superseding_it_is_no_configuration_error() {
    let learner = FakeLearner::start(Script { superseded: true, ..Script::default() }).await;
    let options = JoinSettings { name: Some("pod-0".into()), ..options_for(learner.address()) };
    let (_stop, stopped) = watch::channel(false);
    let error = join(&options, stopped).await.unwrap_err();
    assert!(matches!(error, Error::Superseded { .. }) && !error.is_configuration(), "{error}");
    assert_eq!(learner.seen().joins[0].name, "pod-0");
}

/// A learner that sends every actor to another one.
async fn sends_to(other: &FakeLearner) -> FakeLearner {
    let elsewhere = other.address().strip_prefix("http://").map(str::to_owned);
    FakeLearner::start(Script { elsewhere, ..Script::default() }).await
}

#[tokio::test]
async fn an_actor_joins_the_learner_that_it_is_sent_to_and_comes_back_to_that_one() {
    let home = FakeLearner::start(Script { breaks: vec![(1, 1)], ..Script::default() }).await;
    let first = sends_to(&home).await;
    let running = start(&first).await;
    for number in 0..3 {
        running.unrolls.send(unroll(number)).await.unwrap();
    }
    drop(running.unrolls);
    assert_eq!(running.session.await.unwrap().unwrap().taken, 3);
    let (asked, joined) = (first.seen().joins, home.seen().joins);
    assert_eq!((asked.len(), joined.len()), (1, 2));
    assert_eq!(joined[1].actor, Some(learner::ACTOR));
}

#[tokio::test]
async fn an_actor_that_loses_the_learner_that_it_was_sent_to_begins_at_the_first_again() {
    let machine = tokio::runtime::Runtime::new().unwrap();
    let home = machine.spawn(FakeLearner::start(Script::default())).await.unwrap();
    let first = sends_to(&home).await;
    let running = start(&first).await;
    machine.shutdown_background();
    first.until(|seen| seen.joins.len() > 1).await;
    assert_eq!(first.seen().joins[1].actor, Some(learner::ACTOR), "it says who it was");
    running.stop.send_replace(true);
    running.session.abort();
}

#[tokio::test]
async fn learners_that_send_an_actor_around_are_asked_again_later() {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let elsewhere = Some(listener.local_addr().unwrap().to_string());
    let learner = FakeLearner::serve(listener, Script { elsewhere, ..Script::default() });
    let options = options_for(learner.address());
    let (stop, stopped) = watch::channel(false);
    let joining = tokio::spawn(async move { join(&options, stopped).await });
    learner.until(|seen| seen.joins.len() > 6).await;
    stop.send_replace(true);
    assert!(matches!(joining.await.unwrap(), Err(Error::Stopped)));
}

/// No server listens at port 1.
const NOBODY: &str = "http://127.0.0.1:1";

#[tokio::test]
async fn an_actor_gives_up_on_a_learner_that_never_answers() {
    let options = JoinSettings { give_up_after: Some(Duration::from_millis(300)), ..options_for(NOBODY) };
    let (_stop, stopped) = watch::channel(false);
    let error = join(&options, stopped).await.unwrap_err();
    assert!(matches!(error, Error::GaveUp { .. }) && error.exit_code() == 3, "{error}");
    assert!(error.to_string().contains("has not answered for 0.3 s"), "{error}");
}

#[tokio::test]
async fn an_actor_gives_up_on_a_learner_that_went_away_without_a_farewell() {
    // The learner's machine, which is lost.
    let machine = tokio::runtime::Runtime::new().unwrap();
    let learner = machine.spawn(FakeLearner::start(Script::default())).await.unwrap();
    let options = JoinSettings { give_up_after: Some(Duration::from_millis(300)), ..options_for(learner.address()) };
    let (_stop, stopped) = watch::channel(false);
    let joined = join(&options, stopped.clone()).await.unwrap();
    machine.shutdown_background();
    let (_unrolls, receiver) = mpsc::channel(1);
    let error = joined.run(LIMITS, receiver, Arc::new(Mailbox::default()), stopped).await.unwrap_err();
    assert!(matches!(error, Error::GaveUp { .. }), "{error}");
}

#[tokio::test]
async fn an_actor_does_not_give_up_on_a_learner_that_answers_that_it_is_full() {
    let limit = Duration::from_millis(100);
    let learner = FakeLearner::start(Script { full_for: 5 * limit, ..Script::default() }).await;
    let options = JoinSettings { give_up_after: Some(limit), ..options_for(learner.address()) };
    let (_stop, stopped) = watch::channel(false);
    assert_eq!(join(&options, stopped).await.unwrap().actor, learner::ACTOR);
}

#[tokio::test]
async fn an_evaluator_gives_up_on_a_learner_that_never_answers() {
    let limit = Some(Duration::from_millis(300));
    let follower = Follower::new(NOBODY.into(), Access::default(), None, limit).unwrap();
    let error = follower.follow(&watch::channel(None).0).await.unwrap_err();
    assert!(matches!(error, Error::GaveUp { .. }), "{error}");
}

#[tokio::test]
async fn an_actor_joins_a_restarted_learner_again() {
    let learner = FakeLearner::start(Script { rejoin: true, ..Script::default() }).await;
    let running = start(&learner).await;
    running.unrolls.send(unroll(0)).await.unwrap();
    learner.until(|seen| seen.joins.len() == 2).await;
    running.unrolls.send(unroll(1)).await.unwrap();
    drop(running.unrolls);
    let settled = running.session.await.unwrap().unwrap();
    assert_eq!((settled.stale, settled.taken), (1, 1));
    assert_eq!(learner.seen().joins[1].acknowledged, 1);
}

#[tokio::test]
async fn without_acknowledgements_the_actor_stops_at_its_window() {
    let learner = FakeLearner::start(Script { silent: true, ..Script::default() }).await;
    let running = start(&learner).await;
    // The window and one unroll in the channel fill all room.
    for number in 0..LIMITS.window as u64 + 1 {
        running.unrolls.send(unroll(number)).await.unwrap();
    }
    learner.until(|seen| seen.taken.len() == LIMITS.window).await;
    assert!(running.unrolls.try_send(unroll(99)).is_err());
    running.session.abort();
}

#[tokio::test]
async fn parameters_reach_the_mailbox_and_the_end_of_the_run_ends_the_session() {
    let learner = FakeLearner::start(Script::default()).await;
    let running = start(&learner).await;
    learner.publish(5, b"parameters in pieces");
    let expected = Directive { learner_epoch: 1, version: 5, parameters: Bytes::from_static(b"parameters in pieces") };
    assert_eq!(*first_directive(&running.mailbox).await, expected);
    learner.end_run(6);
    assert!(running.session.await.unwrap().unwrap().over);
}

#[tokio::test]
async fn parameters_that_break_the_protocol_end_only_the_connection() {
    let learner = FakeLearner::start(Script::default()).await;
    let running = start(&learner).await;
    learner.publish(5, &[1; 2000]);
    learner.until(|seen| seen.joins.len() >= 2).await;
    learner.publish(6, b"small enough");
    assert_eq!(first_directive(&running.mailbox).await.version, 6);
    running.session.abort();
}

#[tokio::test]
async fn another_experiment_at_a_reconnect_is_no_configuration_error() {
    let learner = FakeLearner::start(Script { breaks: vec![(1, 1)], ..Script::default() }).await;
    let running = start(&learner).await;
    learner.change_experiment();
    running.unrolls.send(unroll(0)).await.unwrap();
    let error = running.session.await.unwrap().unwrap_err();
    assert!(matches!(error, Error::Changed), "{error}");
    assert!(!error.is_configuration());
}

#[tokio::test]
async fn stopping_sends_the_finished_unrolls() {
    let learner = FakeLearner::start(Script::default()).await;
    let running = start(&learner).await;
    for number in 0..3 {
        running.unrolls.send(unroll(number)).await.unwrap();
    }
    running.stop.send_replace(true);
    drop(running.unrolls);
    let settled = running.session.await.unwrap().unwrap();
    assert_eq!((settled.taken, settled.over), (3, false));
}

#[tokio::test]
async fn stopping_does_not_wait_for_a_silent_learner() {
    let learner = FakeLearner::start(Script { silent: true, ..Script::default() }).await;
    let (stop, stopped) = watch::channel(false);
    let options = options_for(learner.address());
    let joined = join(&options, stopped.clone()).await.unwrap();
    let (unrolls, receiver) = mpsc::channel(1);
    let limits = ExchangeLimits { flush: Duration::from_millis(20), ..LIMITS };
    let session = tokio::spawn(joined.run(limits, receiver, Arc::default(), stopped));
    unrolls.send(unroll(0)).await.unwrap();
    stop.send_replace(true);
    assert_eq!(session.await.unwrap().unwrap(), Settled::default());
}

#[tokio::test]
async fn an_actor_waits_for_a_learner_that_starts_later() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let (_stop, stopped) = watch::channel(false);
    let options = options_for(format!("http://{address}"));
    let joining = tokio::spawn(async move { join(&options, stopped).await });
    let listener = tokio::net::TcpListener::bind(address).await.unwrap();
    let _learner = FakeLearner::serve(listener, Script::default());
    assert_eq!(joining.await.unwrap().unwrap().actor, learner::ACTOR);
}

#[tokio::test]
async fn the_reason_that_an_actor_logs_without_a_learner_names_the_remedy() {
    let mut connector = Connector::new(&options_for(NOBODY)).unwrap();
    let failure = connector.connect(0).await.unwrap_err();
    assert!(matches!(&failure, Failure::Lost(reason) if reason.contains("is the learner running")), "{failure:?}");
}

#[tokio::test]
async fn a_refusal_is_a_configuration_error_and_stopping_ends_the_wait() {
    let refused = |script| async {
        let learner = FakeLearner::start(script).await;
        let options = options_for(learner.address());
        let (_stop, stopped) = watch::channel(false);
        join(&options, stopped).await.unwrap_err()
    };
    let error = refused(Script { refuse: true, ..Script::default() }).await;
    assert!(matches!(error, Error::Refused { .. }) && error.is_configuration(), "{error}");
    let error = refused(Script { wrong_layout: true, ..Script::default() }).await;
    assert!(matches!(error, Error::Disagreement { .. }) && error.is_configuration(), "{error}");

    let (stop, stopped) = watch::channel(false);
    stop.send_replace(true);
    let options = options_for(NOBODY);
    assert!(matches!(join(&options, stopped).await, Err(Error::Stopped)));
}

#[tokio::test]
async fn the_learner_assigns_existing_environments_in_lockstep_only() {
    let told = |lockstep, environments: Option<(u32, u32)>| async move {
        let environments = environments.map(|(first, count)| Environments { first, count });
        let learner = FakeLearner::start(Script { lockstep, environments, ..Script::default() }).await;
        let (_stop, stopped) = watch::channel(false);
        join(&options_for(learner.address()), stopped).await.map(|joined| joined.environments)
    };
    let batch = Experiment::default().unroll.batch as u32;
    assert_eq!(told(false, None).await.unwrap(), None);
    assert_eq!(told(true, Some((3, batch - 3))).await.unwrap(), Some(3..batch));
    for (lockstep, environments) in [
        (false, Some((0, 1))),
        (true, None),
        (true, Some((3, 0))),
        (true, Some((3, batch))),
        (true, Some((3, u32::MAX))),
    ] {
        let error = told(lockstep, environments).await.unwrap_err();
        assert!(matches!(error, Error::Disagreement { .. }), "{environments:?}: {error}");
    }
}

#[tokio::test]
async fn an_invalid_address_is_refused_at_once() {
    let (_stop, stopped) = watch::channel(false);
    for learner in ["host:7070", "https://host:7070", "", "http://", "not a url"] {
        let options = options_for(learner);
        let error = join(&options, stopped.clone()).await.unwrap_err();
        assert!(matches!(error, Error::Access(_)) && error.is_configuration(), "{learner}: {error}");
    }
}

mod assets {
    use super::*;

    async fn fetch(learner: &FakeLearner, cache: &std::path::Path) -> Result<HashMap<String, PathBuf>, Error> {
        let (_stop, stopped) = watch::channel(false);
        let options = JoinSettings { cache: Some(cache.to_path_buf()), ..options_for(learner.address()) };
        Ok(join(&options, stopped).await?.assets)
    }

    #[tokio::test]
    async fn are_fetched_once_and_a_damaged_copy_again() {
        let learner = FakeLearner::start(Script { asset: Some(b"clips".to_vec()), ..Script::default() }).await;
        let cache = tempfile::tempdir().unwrap();
        let located = fetch(&learner, cache.path()).await.unwrap();
        let path = &located["walks.h5"];
        assert_eq!(std::fs::read(path).unwrap(), b"clips");
        fetch(&learner, cache.path()).await.unwrap();
        assert_eq!(learner.seen().assets, 1);

        std::fs::write(path, b"clipz").unwrap();
        fetch(&learner, cache.path()).await.unwrap();
        assert_eq!(std::fs::read(path).unwrap(), b"clips");
        assert_eq!(learner.seen().assets, 2);
        assert_eq!(std::fs::read_dir(cache.path().join("assets")).unwrap().count(), 1, "no temporary file stays");
    }

    #[tokio::test]
    async fn that_differ_from_the_announcement_are_refused() {
        for sent in [b"clipz".as_slice(), b"longer than announced"] {
            let asset = Some(b"clips".to_vec());
            let learner =
                FakeLearner::start(Script { asset, asset_sent: Some(sent.to_vec()), ..Script::default() }).await;
            let cache = tempfile::tempdir().unwrap();
            let error = fetch(&learner, cache.path()).await.unwrap_err();
            assert!(matches!(error, Error::Asset { .. }), "{error}");
            assert_eq!(std::fs::read_dir(cache.path().join("assets")).unwrap().count(), 0);
        }
    }
}

/// A learner whose checkpoint has these bytes as experiment, as policy and as clips, and what follows it.
async fn followed(asset: &[u8], sent: Option<&[u8]>) -> (FakeLearner, Follower, comic_proto::v1::Checkpoint) {
    let script = Script { asset: Some(asset.to_vec()), asset_sent: sent.map(<[u8]>::to_vec), ..Script::default() };
    let learner = FakeLearner::start(script).await;
    let cache = tempfile::tempdir().unwrap().keep();
    let follower = Follower::new(learner.address(), Access::default(), Some(cache), None).unwrap();
    let (sender, mut newest) = watch::channel(None);
    let following = follower.clone();
    let following = tokio::spawn(async move { following.follow(&sender).await });
    let checkpoint = newest.wait_for(Option::is_some).await.unwrap().clone().unwrap();
    following.abort();
    (learner, follower, checkpoint)
}

#[tokio::test]
async fn a_checkpoint_is_fetched_without_joining_and_its_clips_only_if_they_are_wanted() {
    let text = Experiment::default().to_toml().unwrap().into_bytes();
    let (learner, follower, checkpoint) = followed(&text, None).await;
    for (wanted, files) in [(false, 0), (true, 1)] {
        let fetched = follower.fetch(&checkpoint, |_| wanted).await.unwrap();
        assert_eq!((fetched.experiment, fetched.policy), (Experiment::default(), text.clone()));
        assert_eq!(fetched.assets.len(), files);
        assert!(fetched.assets.values().all(|file| std::fs::read(file).unwrap() == text));
    }
    assert!(learner.seen().joins.is_empty());
}

#[tokio::test]
async fn a_checkpoint_that_breaks_off_is_tried_again_and_a_damaged_one_is_refused() {
    let text = Experiment::default().to_toml().unwrap().into_bytes();
    let (_learner, follower, checkpoint) = followed(&text, Some(&text[1..])).await;
    let failure = follower.fetch(&checkpoint, |_| true).await.unwrap_err();
    assert!(matches!(&failure, Failure::Lost(_)), "{failure:?}");
    let damaged: Vec<u8> = text.iter().map(|byte| byte ^ 1).collect();
    let (_learner, follower, checkpoint) = followed(&text, Some(&damaged)).await;
    let failure = follower.fetch(&checkpoint, |_| true).await.unwrap_err();
    assert!(matches!(&failure, Failure::Fatal(Error::Asset { .. })), "{failure:?}");
}
