//! One learner and two actors as real processes with real sockets, with every other low level and with two tasks. The
//! learner trains on the unrolls of each actor, new parameters reach each of them, and a killed learner resumes from its
//! checkpoint, whatever recurrent states are in flight.

use anyhow::{Result, ensure};
use comic_proto::v1::Status;
use comic_tests::accounting::balance_of_json;
use comic_tests::steps::{
    EVERY_UNROLL, LIMIT, kill_and_restart_the_learner, leaves, the_accounting_balances_at_the_end, trains_on,
    trains_on_each,
};
use comic_tests::system::{SMALL, System};

async fn two_actors_learn(overrides: &[&str], check: fn(&Status) -> Option<()>) -> Result<()> {
    let arguments = overrides.iter().flat_map(|field| ["--set", *field]);
    let mut system = System::new(&SMALL.into_iter().chain(arguments).collect::<Vec<_>>())?;
    system.log_level = Some(EVERY_UNROLL.into());
    let begun = system.start_learner(LIMIT).await?;
    let mut actors = [system.start_actor()?, system.start_actor()?];
    for actor in &mut actors {
        actor.until_log_holds("joined the learner", LIMIT).await?;
    }
    trains_on(&mut system, "the actors' unrolls are trained on").await?;
    trains_on_each(&mut system, &actors, "both act with new parameters").await?;
    system.until("the metrics say so", LIMIT, check).await?;
    let resumed = kill_and_restart_the_learner(&mut system).await?;
    ensure!(resumed.learner_epoch > begun.learner_epoch, "a restarted learner must begin a new epoch");
    for actor in &mut actors {
        actor.until_log_holds(&format!("learner_epoch={}", resumed.learner_epoch), LIMIT).await?;
    }
    trains_on(&mut system, "training continues after the restart").await?;
    trains_on_each(&mut system, &actors, "both act with the restarted learner's parameters").await?;
    system.until("the metrics say so again", LIMIT, check).await?;
    for actor in actors {
        leaves(actor).await?;
    }
    the_accounting_balances_at_the_end(system).await
}

#[tokio::test]
async fn with_an_lstm_and_a_recurrent_value_function() -> Result<()> {
    two_actors_learn(&["network.low_level=lstm", "network.lstm.units=[12, 8]", "network.value_lstm=[8]"], |_| Some(()))
        .await
}

#[tokio::test]
async fn with_a_mixture_of_primitives() -> Result<()> {
    let sizes = ["network.primitives.torso=[32]", "network.primitives.hidden=16", "vmpo.control_variate=0"];
    two_actors_learn(&[&["network.low_level=mixture"][..], &sizes].concat(), |_| Some(())).await
}

#[tokio::test]
async fn with_a_product_of_primitives_and_no_bottleneck() -> Result<()> {
    let sizes = ["network.primitives.torso=[32]", "network.primitives.hidden=16", "network.latent.size=0"];
    two_actors_learn(&[&["network.low_level=product"][..], &sizes].concat(), |_| Some(())).await
}

#[tokio::test]
async fn with_two_tasks() -> Result<()> {
    let overrides = [r#"joint=[{task="get-up", probability=0.3}]"#, "get_up.lying_share=0"];
    two_actors_learn(&overrides, |status| {
        let metrics: serde_json::Value = serde_json::from_str(&status.metrics_json).ok()?;
        let of = |task: &str, name: &str| metrics["tasks"][task][name].as_f64().unwrap_or_default();
        let both = ["tracking", "get-up"];
        let trained = both.iter().all(|task| of(task, "environment_steps") > 0.0 && of(task, "unrolls") > 0.0);
        let padded = both.iter().any(|task| of(task, "padding_share") > 0.0);
        let ended = both.iter().any(|task| of(task, "head_height") > 0.0);
        for task in both {
            let (own, all) = (&metrics["tasks"][task]["accounting"], &metrics["accounting"]);
            assert!(balance_of_json(own), "{task}: {own}");
            let trained = own["trained"].as_u64().unwrap();
            assert!(Some(trained) <= all["trained"].as_u64(), "{task}: {own} of {all}");
        }
        (trained && padded && ended).then_some(())
    })
    .await
}
