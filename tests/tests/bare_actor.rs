//! An actor needs its program, its libraries and the learner's address: no file of the repository, and no directory of its own.

use std::fs;

use anyhow::{Result, ensure};
use comic_proto::Access;
use comic_tests::steps::{LIMIT, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System, program};

#[test]
fn the_programs_name_no_folder_that_set_up_took_the_humanoid_to() -> Result<()> {
    for name in ["comic-actor", "comic-learner"] {
        let bytes = fs::read(program(name)?)?;
        for folder in [".deps/dm_control", "humanoid_CMU_V2020.xml"] {
            let found = bytes.windows(folder.len()).any(|window| window == folder.as_bytes());
            ensure!(!found, "{name} names {folder}, which another machine does not have");
        }
    }
    Ok(())
}

#[tokio::test]
async fn an_actor_in_an_empty_directory_without_a_home_trains() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let empty = tempfile::tempdir()?;
    let actor = system.start_actor_with(&Access::default(), |actor| {
        actor.current_dir(empty.path()).env_clear();
    })?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;
    leaves(actor).await?;
    ensure!(fs::read_dir(empty.path())?.next().is_none(), "the actor left something behind");
    the_accounting_balances_at_the_end(system).await
}
