//! The section `transfer`, and what a frozen low level changes in an experiment.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

use comic_experiment::{ACTION_SIZE, Experiment, TaskSpec, TransferPrior, resolve};

/// Go-to-target with a low level and these fields.
fn transfer(fields: &[&str]) -> Result<Experiment, comic_experiment::Error> {
    let fields = ["transfer.low_level=low_level.safetensors"].iter().chain(fields);
    resolve("transfer-go-to-target", &fields.map(|field| (*field).to_string()).collect::<Vec<_>>())
}

#[test]
fn without_a_low_level_nothing_is_transferred() {
    let experiment = resolve("go-to-target", &[]).unwrap();
    assert!(!experiment.transfer.is_on());
    let sizes = [experiment.action_size(), experiment.latent_size(), experiment.components()];
    assert_eq!(sizes, [ACTION_SIZE, experiment.network.latent.size, 1]);
}

#[test]
fn the_policys_action_is_the_latent_and_it_has_no_latent_and_no_memory_of_its_own() {
    let fields = ["network.latent.size=20", "network.low_level=lstm", "transfer.prior=state"];
    let experiment = transfer(&fields).unwrap();
    assert_eq!((experiment.action_size(), experiment.latent_size(), experiment.state_size()), (20, 0, 0));
    assert_eq!(TaskSpec::new(&experiment, Vec::new()).unwrap().action, 20);
    assert_eq!(experiment.transfer.prior, TransferPrior::State);
    // A frozen mixture acts by its most likely component; the new policy is one Gaussian.
    assert_eq!(transfer(&["network.low_level=mixture"]).unwrap().components(), 1);
}

#[test]
fn fields_that_make_no_sense_beside_a_low_level_are_refused() {
    for (field, remedy) in [
        ("network.initial_pose=reference-mean", "network.initial_pose"),
        (r#"joint=[{task="get-up", probability=0.1}]"#, "joint"),
        ("transfer.sha256=12", "64 hexadecimal digits"),
        ("transfer.latent_limit=0", "transfer.latent_limit"),
        ("transfer.mean_scale=-1", "transfer.mean_scale"),
    ] {
        let refused = transfer(&[field]).expect_err(field).to_string();
        assert!(refused.contains(remedy), "{field}: {refused}");
    }
}
