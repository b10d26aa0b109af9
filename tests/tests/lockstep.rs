//! In lockstep the seed decides every parameter, bit for bit. Neither the distribution of environments over actors nor
//! faults of actors and connections change them.

use std::io::{self, Read as _, Write as _};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use comic_tests::lockstep::{
    ALL, SLOW_BYTES_PER_SECOND, UPDATES, final_state, final_state_of, is_over, lockstep, lockstep_with, train,
};
use comic_tests::relay::Relay;
use comic_tests::steps::{LIMIT, accounting, trains_on};

const LSTM_AND_TWO_TASKS: [&str; 4] = [
    "network.low_level=lstm",
    "network.lstm.units=[12, 8]",
    r#"joint=[{task="get-up", probability=0.3}]"#,
    "get_up.lying_share=0",
];

#[tokio::test]
async fn one_actor_or_two_give_the_same_parameters_and_another_seed_gives_others() -> Result<()> {
    let one = final_state_of(&[ALL], &[]).await?;
    ensure!(one == final_state_of(&[3, 5], &[]).await?, "two actors gave other parameters than one");
    ensure!(one != final_state_of(&[ALL], &["seed=2"]).await?, "another seed gave the same parameters");
    Ok(())
}

#[tokio::test]
async fn one_actor_or_two_give_the_same_parameters_with_an_lstm_and_two_tasks() -> Result<()> {
    let one = final_state_of(&[ALL], &LSTM_AND_TWO_TASKS).await?;
    ensure!(one == final_state_of(&[5, 3], &LSTM_AND_TWO_TASKS).await?, "two actors gave other parameters than one");
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
    ensure!(
        final_state(&system)? == final_state_of(&[ALL], &[]).await?,
        "a pause or a broken connection changed the parameters"
    );
    Ok(())
}

#[tokio::test]
async fn a_slow_line_other_clients_and_random_bytes_change_nothing() -> Result<()> {
    let mut system = lockstep_with(&["--metrics-port", "0"], &[])?;
    system.start_learner(LIMIT).await?;
    let relay = Relay::start(system.address(), SLOW_BYTES_PER_SECOND).await?;
    let mut actors = [system.start_actor_of(5, &relay.url)?, system.start_actor_of(3, &system.url())?];
    for actor in &mut actors {
        actor.until_log_holds("joined the learner", LIMIT).await?;
    }
    // The slow line still carries the first parameters. Training begins only after them.
    let strangers = system.start_crowd(20)?;
    let nonsense = babble(system.address());
    let deadline = Instant::now() + LIMIT;
    while stand_by(&system.metrics_page()?)? == 0 {
        ensure!(Instant::now() < deadline, "no other client tried to join");
        // This thread also runs the slow line.
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    is_over(&mut system, &mut actors).await?;
    drop(strangers);
    ensure!(nonsense.join().is_ok_and(|said| said > 0), "the learner accepted none of the random bytes");
    ensure!(
        final_state(&system)? == final_state_of(&[ALL], &[]).await?,
        "a client that is no actor changed the parameters"
    );
    Ok(())
}

#[tokio::test]
async fn a_resumed_run_depends_only_on_where_it_was_interrupted() -> Result<()> {
    resumes_alike(&[]).await
}

#[tokio::test]
async fn a_resumed_run_with_an_lstm_and_two_tasks_depends_only_on_where_it_was_interrupted() -> Result<()> {
    resumes_alike(&LSTM_AND_TWO_TASKS).await
}

/// Interrupts a run and resumes it with other actors.
async fn resumes_alike(overrides: &[&str]) -> Result<()> {
    let interrupted = async |before: &[u32], after: &[u32]| {
        let mut system = lockstep(&[&["budget.updates=3"], overrides].concat())?;
        train(&mut system, before).await?;
        system.set(&format!("budget.updates={UPDATES}"));
        train(&mut system, after).await?;
        final_state(&system)
    };
    let one = interrupted(&[ALL], &[3, 5]).await?;
    ensure!(one == interrupted(&[5, 3], &[ALL]).await?, "other actors gave other parameters");
    Ok(())
}

#[tokio::test]
async fn actors_of_a_killed_learner_end_and_new_ones_replace_them() -> Result<()> {
    let mut system = lockstep(&["budget.updates=0"])?;
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor_of(ALL, &system.url())?;
    trains_on(&mut system, "the first actor's unrolls are trained on").await?;
    system.learner.take().context("no learner")?.kill()?;
    system.start_learner(LIMIT).await?;
    let status = actor.until_it_ends(LIMIT).await?;
    ensure!(status.code() == Some(1), "an actor that must be restarted ended with {status}");
    ensure!(actor.log().contains("start the actor again"), "{}", actor.log());
    let _actor = system.start_actor_of(ALL, &system.url())?;
    trains_on(&mut system, "a new actor's unrolls are trained on").await
}

/// Number of answers that there is no free environment.
fn stand_by(page: &str) -> Result<u64> {
    let line = page.lines().find_map(|line| line.strip_prefix("comic_joins_total{result=\"full\"} "));
    line.context("no such metric")?.parse().context("no number")
}

/// Opens connections that send random bytes, one after another, until the learner no longer listens. Returns their number.
fn babble(learner: String) -> thread::JoinHandle<u64> {
    const SAYINGS: [&[u8]; 3] =
        [b"GET / HTTP/1.1\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\xff\xff\xff\0", &[0x80; 4096]];
    thread::spawn(move || {
        let mut said = 0;
        for saying in SAYINGS.iter().cycle() {
            let Ok(mut learner) = TcpStream::connect(&learner) else { break };
            let _ = learner.write_all(saying);
            // The learner closes the connection at some point.
            let _ = io::copy(&mut learner, &mut io::sink());
            said += 1;
        }
        said
    })
}

/// A relay to the learner. Its first connections break in the middle of an unroll.
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

/// Carries everything from the learner, and this number of bytes to it.
fn carry(actor: &TcpStream, learner: &TcpStream, bytes: u64) {
    thread::scope(|scope| {
        scope.spawn(|| pour(learner, actor, u64::MAX));
        pour(actor, learner, bytes);
    });
}

/// Carries this number of bytes from one side to the other. Then, or when either side ends, the connection breaks.
fn pour(from: &TcpStream, mut to: &TcpStream, bytes: u64) {
    let _ = io::copy(&mut from.take(bytes), &mut to);
    for side in [from, to] {
        let _ = side.shutdown(Shutdown::Both);
    }
}
