//! The field `algorithm`: what the chosen algorithm does not read is refused.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

use comic_experiment::{AlgorithmName, Experiment, resolve};

fn set(preset: &str, overrides: &[&str]) -> Result<Experiment, String> {
    let overrides: Vec<String> = overrides.iter().map(|argument| argument.to_string()).collect();
    resolve(preset, &overrides).map_err(|error| error.to_string())
}

#[test]
fn the_papers_tracking_learns_by_vmpo() {
    assert_eq!(Experiment::default().algorithm, AlgorithmName::Vmpo);
    assert!(Experiment::default().learns_low_level());
}

#[test]
fn a_field_that_the_algorithm_does_not_read_is_refused_with_the_reason() {
    for (algorithm, argument) in [
        ("vmpo", "svg0.burn_in=4"),
        ("vmpo", "replay.samples_per_insert=8"),
        ("svg0", "vmpo.lambda=0.5"),
        ("svg0", "network.value=[32]"),
        ("svg0", "network.final_std=0.1"),
        ("svg0", "network.initial_pose=reference-mean"),
        ("svg0", "network.mlp.hidden=[32]"),
        ("svg0", "optimiser.multiplier_learning_rate=0.1"),
        ("svg0", "unroll.max_staleness=9"),
        ("svg0", r#"joint=[{task="get-up", probability=0.1}]"#),
    ] {
        let chosen = format!("algorithm={algorithm}");
        let refused = set("tracking-mlp", &[&chosen, argument]).expect_err(argument);
        let field = argument.split('=').next().unwrap();
        let reason = format!("algorithm = \"{algorithm}\" does not read it");
        assert!(refused.starts_with("--set ") && refused.contains(field) && refused.contains(&reason), "{refused}");
    }
}

#[test]
fn a_file_is_refused_with_the_line_of_such_a_field() {
    let text = "algorithm = \"svg0\"\n[vmpo]\nlambda = 0.5\n";
    let refused = Experiment::from_toml("run.toml", text).unwrap_err().to_string();
    assert_eq!(refused, "run.toml:3: vmpo.lambda = 0.5: algorithm = \"svg0\" does not read it; leave it at 1.0");
}

#[test]
fn with_a_low_level_the_fields_that_describe_it_are_read() {
    let fields = ["algorithm=svg0", "network.mlp.hidden=[32]", "network.latent.size=20"];
    assert!(set("go-to-target", &fields).is_err());
    let with_low_level = [&fields[..], &["transfer.low_level=low_level.safetensors"]].concat();
    assert_eq!(set("go-to-target", &with_low_level).unwrap().action_size(), 20);
}

/// A preset for V-MPO serves as the beginning of an experiment with SVG(0).
#[test]
fn an_override_of_the_algorithm_gives_what_it_does_not_read_the_default_and_keeps_the_rest() {
    let preset = set("quickstart", &[]).unwrap();
    for overrides in [["algorithm=svg0", "svg0.core=32"], ["svg0.core=32", "algorithm=svg0"]] {
        let experiment = set("quickstart", &overrides).unwrap();
        let Experiment { vmpo, network, optimiser, tracking, svg0, .. } = experiment;
        let defaults = Experiment::default();
        assert_eq!((vmpo, network.value, network.final_std), (defaults.vmpo, defaults.network.value, 0.0));
        assert_eq!((optimiser.learning_rate, tracking), (preset.optimiser.learning_rate, preset.tracking.clone()));
        assert_eq!(svg0.core, 32);
    }
    // In whatever order: a field that the new algorithm does not read is never dropped in silence.
    assert!(set("quickstart", &["vmpo.lambda=0.5", "algorithm=svg0"]).is_err());
}

#[test]
fn the_replay_is_refused_where_neither_side_could_move() {
    let small = ["algorithm=svg0", "svg0.minibatch_sequences=8", "replay.samples_per_insert=4"];
    let with = |field: &str| set("tracking-mlp", &[&small[..], &[field]].concat());
    for (field, remedy) in [
        ("replay.error_buffer=7", "8 at least"),
        ("replay.max_size=255", "256 environment steps"),
        ("replay.min_size=2000000", "at most replay.max_size"),
        ("replay.samples_per_insert=0", "must be 0.001 to 10000"),
    ] {
        let refused = with(field).expect_err(field);
        assert!(refused.contains(remedy), "{refused}");
    }
    let replay = with("replay.min_size=3200").unwrap().replay;
    // 100 sequences, a tenth of them, sampled 4 times each.
    assert_eq!((replay.min_sequences(32, 8), replay.error_buffer(32, 8)), (100, 40.0));
    assert_eq!(with("replay.min_size=0").unwrap().replay.error_buffer(32, 8), 8.0);
}

#[test]
fn an_unroll_may_be_late_by_the_updates_of_max_staleness_in_whole_versions_and_in_lockstep_by_none() {
    for (staleness, period, versions) in [(400, 100, 4), (401, 100, 5), (1, 100, 1), (0, 100, 0), (32, 1, 32)] {
        let overrides = [format!("unroll.max_staleness={staleness}"), format!("vmpo.target_period={period}")];
        let overrides = [&overrides[0], overrides[1].as_str()];
        assert_eq!(set("tracking-mlp", &overrides).unwrap().max_versions_late(), versions, "{overrides:?}");
        let lockstep = [&overrides[..], &["unroll.lockstep=true", "unroll.ahead=0", "budget.minutes=0"]].concat();
        assert_eq!(set("tracking-mlp", &lockstep).unwrap().max_versions_late(), 0, "{overrides:?}");
    }
    let lockstep = ["algorithm=svg0", "unroll.lockstep=true", "unroll.ahead=0"];
    assert_eq!(set("transfer-paper", &lockstep[..1]).unwrap().max_versions_late(), u64::MAX);
    assert_eq!(set("transfer-paper", &lockstep).unwrap().max_versions_late(), 0);
}

#[test]
fn several_learners_share_batches_and_minibatches_and_refuse_what_they_cannot_share() {
    let share = |preset: &str, set: &[&str], ranks: usize| {
        self::set(preset, set).unwrap().share(ranks).map_err(|error| error.to_string())
    };
    let half = share("quickstart", &[], 2).unwrap();
    let whole = resolve("quickstart", &[]).unwrap();
    assert_eq!(half.unroll.batch * 2, whole.unroll.batch);
    assert_eq!(half.vmpo.minibatch_unrolls * 2, whole.vmpo.minibatch_unrolls);
    assert_eq!(share("quickstart", &[], 1).unwrap(), whole);
    for (preset, set, ranks, part) in [
        ("quickstart", &["unroll.batch=9", "vmpo.minibatch_unrolls=9"][..], 2, "unroll.batch = 9"),
        ("quickstart", &["unroll.batch=12", "vmpo.minibatch_unrolls=3"], 2, "vmpo.minibatch_unrolls = 3"),
        ("quickstart", &["unroll.lockstep=true", "unroll.ahead=0", "budget.minutes=0"], 2, "unroll.lockstep"),
        ("quickstart", &[], 0, "unroll.batch"),
        ("transfer-go-to-target", &["algorithm=svg0"], 2, "algorithm"),
    ] {
        let refused = share(preset, set, ranks).unwrap_err();
        assert!(refused.contains(part) && refused.contains("learners together"), "no `{part}` in {refused}");
    }
}
