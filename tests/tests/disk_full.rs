//! A full disk: training continues and logs the errors; checkpoints are written again as soon as there is room.
//!
//! The learner gets its own disk, which needs root. On a machine where that is impossible, `cargo xtask test` says that
//! these tests are not run.

use std::fs::{self, File, OpenOptions};
use std::io::Write as _;
use std::os::fd::AsRawFd as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use comic_proto::v1::Status;
use comic_tests::lockstep::{ALL, SLOW_BYTES_PER_SECOND, UPDATES, final_state_in, final_state_of, is_over, lockstep};
use comic_tests::relay::Relay;
use comic_tests::steps::{
    LIMIT, checkpoint_in, half_written, leaves, now, the_accounting_balances_at_the_end, trains_on,
};
use comic_tests::system::{SMALL, System, metric, python};
use comic_tests::tensorboard::curves;

/// Room for a few dozen checkpoints.
const DISK: u64 = 64 << 20;
/// The learner's log line for every checkpoint that could not be written.
const REFUSED: &str = "checkpoint not written";

#[tokio::test]
async fn on_a_full_disk_only_checkpoints_are_lost() -> Result<()> {
    // Without this file no one could read the curves below.
    python()?;
    let mut system = System::new(&[&SMALL[..], &["--metrics-port", "0"]].concat())?;
    system.disk = Some(DISK);
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;
    let learner = system.learner.as_ref().context("no learner")?;
    let run = learner.sees(&system.run());
    system.until("a checkpoint is written", LIMIT, |_| checkpoint_in(&run)).await?;

    let filler = run.join("filler");
    fill_until_refused(&mut system, &filler, 2).await?;
    let page = system.metrics_page()?;
    let failed = page.lines().find_map(|line| line.strip_prefix("comic_checkpoints_total{result=\"failed\"} "));
    ensure!(failed.context("no metric")?.parse::<u64>()? >= 2, "{page}");
    trains_on(&mut system, "training continues").await?;
    system.until("what is half-written goes away", LIMIT, |_| (half_written(&run)? == 0).then_some(())).await?;

    let before = checkpoint_in(&run);
    fs::remove_file(&filler)?;
    system.until("checkpoints are written again", LIMIT, |_| (checkpoint_in(&run) > before).then_some(())).await?;
    let step = system.until("an answer", LIMIT, |status| Some(metric(status, "environment_steps"))).await?;
    // TensorBoard would stop at a line that was only half written.
    let last = |run: &Path| Some(curves(&run.join("tensorboard")).ok()?.get("updates")?.last()?.0 as f64);
    system.until("TensorBoard sees newer updates", LIMIT, |_| (last(&run)? > step).then_some(())).await?;
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}

#[tokio::test]
async fn on_a_full_disk_the_parameters_are_the_same() -> Result<()> {
    let mut system = lockstep(&[])?;
    system.disk = Some(DISK);
    system.start_learner(LIMIT).await?;
    let seen = system.learner.as_ref().context("no learner")?.sees(&system.run());
    // The open directory keeps the disk after the learner has ended.
    let disk = File::open(&seen)?;
    let run = PathBuf::from(format!("/proc/self/fd/{}", disk.as_raw_fd()));
    system
        .until("the first checkpoint is written", LIMIT, |_| run.join("checkpoints/initial").exists().then_some(()))
        .await?;
    let filler = run.join("filler");
    fill(&filler)?;
    let relay = Relay::start(system.address(), SLOW_BYTES_PER_SECOND).await?;
    let actor = system.start_actor_of(ALL, &relay.url)?;
    // One falls at the beginning of training, the other one in the middle.
    fill_until_refused(&mut system, &filler, 1).await?;
    let updates = |status: &Status| metric(status, "updates");
    system.until("an update", LIMIT, |status| (updates(status) >= 1.0).then_some(())).await?;
    let refused = system.learner.as_ref().context("no learner")?.log().matches(REFUSED).count();
    fill_until_refused(&mut system, &filler, refused + 1).await?;
    let done = updates(&now(&mut system).await?);
    ensure!(done < UPDATES as f64, "the disk was full to the end: {done} updates");
    fs::remove_file(&filler)?;
    is_over(&mut system, &mut [actor]).await?;
    ensure!(final_state_in(&run)? == final_state_of(&[ALL], &[]).await?, "a full disk changed the parameters");
    Ok(())
}

/// Fills the disk again and again until this number of checkpoints could not be written.
async fn fill_until_refused(system: &mut System, filler: &Path, checkpoints: usize) -> Result<()> {
    let learner = system.learner.as_mut().context("no learner")?;
    let deadline = Instant::now() + LIMIT;
    while learner.log().matches(REFUSED).count() < checkpoints {
        fill(filler)?;
        ensure!(learner.ended()?.is_none(), "a full disk ended the learner: {}", learner.log());
        ensure!(Instant::now() < deadline, "no checkpoint was refused: {}", learner.log());
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    Ok(())
}

/// Fills the disk.
fn fill(path: &Path) -> Result<()> {
    let mut file = OpenOptions::new().create(true).append(true).open(path)?;
    let block = [0; 4096];
    loop {
        match file.write_all(&block) {
            Ok(()) => {}
            Err(error) if error.kind() == std::io::ErrorKind::StorageFull => return Ok(()),
            Err(error) => return Err(error.into()),
        }
    }
}
