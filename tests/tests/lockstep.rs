//! In lockstep the seed decides every parameter, bit for bit, whatever actors share the environments and whatever happens
//! to them and to their connections on the way.

use std::io::{self, Read as _, Write as _};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use comic_tests::lockstep::{
    ALL, SLOW_BYTES_PER_SECOND, UPDATES, is_over, learnt, learnt_by, lockstep, lockstep_with, train,
};
use comic_tests::relay::Relay;
use comic_tests::steps::{LIMIT, accounting, trains_on};

const MEMORY_AND_TWO_TASKS: [&str; 4] = [
    "network.low_level=lstm",
    "network.lstm.units=[12, 8]",
    r#"joint=[{task="get-up", probability=0.3}]"#,
    "get_up.lying_share=0",
];

#[tokio::test]
async fn one_actor_or_two_learn_the_same_and_another_seed_something_else() -> Result<()> {
    let one = learnt_by(&[ALL], &[]).await?;
    ensure!(one == learnt_by(&[3, 5], &[]).await?, "two actors learnt something else than one");
    ensure!(one != learnt_by(&[ALL], &["seed=2"]).await?, "another seed led to the same");
    Ok(())
}

#[tokio::test]
async fn with_a_memory_and_two_tasks_too() -> Result<()> {
    let one = learnt_by(&[ALL], &MEMORY_AND_TWO_TASKS).await?;
    ensure!(one == learnt_by(&[5, 3], &MEMORY_AND_TWO_TASKS).await?, "two actors learnt something else than one");
    Ok(())
}

#[tokio::test]
async fn a_paused_actor_and_broken_connections_change_nothing() -> Result<()> {
    let mut system = lockstep(&[])?;
    system.start_learner(LIMIT).await?;
    let mut paused = system.start_actor_of(5, &system.url())?;
    paused.until_log_holds("joined the learner", LIMIT).await?;
    paused.pause()?;
    let mut cut = system.start_actor_of(3, &fragile_way(&system.url())?)?;
    let what = "the other environments' unrolls wait for the paused actor's";
    system.until(what, LIMIT, |status| (accounting(status).in_flight >= 3).then_some(())).await?;
    paused.resume()?;
    cut.until_log_holds("reconnected to the learner", LIMIT).await?;
    is_over(&mut system, &mut [paused, cut]).await?;
    ensure!(learnt(&system)? == learnt_by(&[ALL], &[]).await?, "a pause or a broken connection changed something");
    Ok(())
}

#[tokio::test]
async fn a_slow_line_strangers_and_nonsense_change_nothing() -> Result<()> {
    let mut system = lockstep_with(&["--metrics-port", "0"], &[])?;
    system.start_learner(LIMIT).await?;
    let relay = Relay::start(system.address(), SLOW_BYTES_PER_SECOND).await?;
    let mut actors = [system.start_actor_of(5, &relay.url)?, system.start_actor_of(3, &system.url())?];
    for actor in &mut actors {
        actor.until_log_holds("joined the learner", LIMIT).await?;
    }
    // The line is still busy with the first parameters: nothing is learnt before they are through.
    let strangers = system.start_crowd(20)?;
    let nonsense = babble(system.address());
    let deadline = Instant::now() + LIMIT;
    while stand_by(&system.metrics_page()?)? == 0 {
        ensure!(Instant::now() < deadline, "no stranger wanted to join");
        // The slow line is this thread's, too.
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    is_over(&mut system, &mut actors).await?;
    drop(strangers);
    ensure!(nonsense.join().is_ok_and(|said| said > 0), "nobody heard the nonsense");
    ensure!(learnt(&system)? == learnt_by(&[ALL], &[]).await?, "somebody who is no actor changed something");
    Ok(())
}

#[tokio::test]
async fn a_resumed_run_hangs_on_where_it_was_interrupted_and_on_nothing_else() -> Result<()> {
    resumes_alike(&[]).await
}

#[tokio::test]
async fn so_does_one_with_a_memory_and_two_tasks() -> Result<()> {
    resumes_alike(&MEMORY_AND_TWO_TASKS).await
}

/// Interrupts a run, and lets other actors go on with it.
async fn resumes_alike(overrides: &[&str]) -> Result<()> {
    let interrupted = async |before: &[u32], after: &[u32]| {
        let mut system = lockstep(&[&["budget.updates=3"], overrides].concat())?;
        train(&mut system, before).await?;
        system.set(&format!("budget.updates={UPDATES}"));
        train(&mut system, after).await?;
        learnt(&system)
    };
    let one = interrupted(&[ALL], &[3, 5]).await?;
    ensure!(one == interrupted(&[5, 3], &[ALL]).await?, "other actors learnt something else");
    Ok(())
}

#[tokio::test]
async fn actors_of_a_killed_learner_leave_and_new_ones_take_their_place() -> Result<()> {
    let mut system = lockstep(&["budget.updates=0"])?;
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor_of(ALL, &system.url())?;
    trains_on(&mut system, "the first actor's unrolls are trained on").await?;
    system.learner.take().context("no learner")?.kill()?;
    system.start_learner(LIMIT).await?;
    let status = actor.until_it_ends(LIMIT).await?;
    ensure!(status.code() == Some(1), "an actor that is to start again ends with {status}");
    ensure!(actor.log().contains("start the actor again"), "{}", actor.log());
    let _actor = system.start_actor_of(ALL, &system.url())?;
    trains_on(&mut system, "a new actor's unrolls are trained on").await
}

/// How often somebody was told that there is nothing to do.
fn stand_by(page: &str) -> Result<u64> {
    let line = page.lines().find_map(|line| line.strip_prefix("comic_joins_total{result=\"full\"} "));
    line.context("no such metric")?.parse().context("no number")
}

/// Connections that speak no protocol, one after another until nobody listens any more; how many there were.
fn babble(learner: String) -> thread::JoinHandle<u64> {
    const SAYINGS: [&[u8]; 3] =
        [b"GET / HTTP/1.1\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\xff\xff\xff\0", &[0x80; 4096]];
    thread::spawn(move || {
        let mut said = 0;
        for saying in SAYINGS.iter().cycle() {
            let Ok(mut learner) = TcpStream::connect(&learner) else { break };
            let _ = learner.write_all(saying);
            // Until the learner has had enough of it.
            let _ = io::copy(&mut learner, &mut io::sink());
            said += 1;
        }
        said
    })
}

/// A way to the learner on which the first connections break in the middle of an unroll.
fn fragile_way(learner: &str) -> Result<String> {
    const FRAGILE: usize = 3;
    const BYTES: u64 = 50_000;
    let learner = learner.trim_start_matches("http://").to_owned();
    let listener = TcpListener::bind("127.0.0.1:0").context("no port")?;
    let url = format!("http://{}", listener.local_addr()?);
    thread::spawn(move || {
        for (number, actor) in listener.incoming().enumerate() {
            let (Ok(actor), Ok(learner)) = (actor, TcpStream::connect(&learner)) else { continue };
            let bytes = if number < FRAGILE { BYTES } else { u64::MAX };
            thread::spawn(move || carry(&actor, &learner, bytes));
        }
    });
    Ok(url)
}

/// Carries everything down and so many bytes up.
fn carry(actor: &TcpStream, learner: &TcpStream, bytes: u64) {
    thread::scope(|scope| {
        scope.spawn(|| pour(learner, actor, u64::MAX));
        pour(actor, learner, bytes);
    });
}

/// So many bytes from one side to the other; then, and when either side ends, the connection breaks.
fn pour(from: &TcpStream, mut to: &TcpStream, bytes: u64) {
    let _ = io::copy(&mut from.take(bytes), &mut to);
    for side in [from, to] {
        let _ = side.shutdown(Shutdown::Both);
    }
}
