//! From a preset or a file, and overrides, to an experiment; and the errors of bad documents.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

use comic_experiment::{
    ClipSource, Error, Experiment, InitialPose, LowLevelName, Prior, TRACKING_OBSERVATIONS, TerminationError, presets,
    resolve,
};
use proptest::prelude::*;

fn set(overrides: &[&str]) -> Result<Experiment, Error> {
    resolve("tracking-mlp", &overrides.iter().map(|argument| argument.to_string()).collect::<Vec<_>>())
}

/// The error of one `--set`.
fn refused(argument: &str) -> String {
    set(&[argument]).expect_err("must be refused").to_string()
}

/// The error of a document.
fn refused_text(text: &str) -> String {
    Experiment::from_toml("run.toml", text).expect_err("must be refused").to_string()
}

// Presets and defaults

#[test]
fn every_preset_has_its_files_name_and_survives_writing_and_reading() {
    for (name, _) in presets::ALL {
        let experiment = resolve(name, &[]).unwrap();
        assert_eq!(experiment.name, name);
        let text = experiment.to_toml().unwrap();
        assert_eq!(Experiment::from_toml("kept.toml", &text).unwrap(), experiment);
    }
}

#[test]
fn defaults_are_the_papers() {
    let Experiment { vmpo, optimiser, unroll, network, tracking, .. } = resolve("tracking-mlp", &[]).unwrap();
    // CoMic supplement, table 1 and section 1.
    assert_eq!((unroll.batch, unroll.length), (128, 32));
    assert_eq!(vmpo.discount, 0.95);
    assert_eq!((optimiser.learning_rate, optimiser.multiplier_learning_rate), (1e-4, 1e-4));
    assert_eq!((vmpo.epsilon_eta, vmpo.epsilon_mean, vmpo.epsilon_std), (0.1, 0.1, 1e-5));
    assert_eq!((vmpo.initial_temperature, vmpo.initial_alpha_mean, vmpo.initial_alpha_std), (1.0, 1.0, 1.0));
    assert_eq!(vmpo.top_fraction, 0.5);
    assert_eq!((network.encoder, network.encoder_linear_path), (vec![1024, 1024], true));
    assert_eq!((network.mlp.hidden, network.value), (vec![1024, 1024], vec![1024, 1024, 1024]));
    assert_eq!((network.low_level, network.value_lstm), (LowLevelName::Mlp, vec![]));
    assert_eq!(network.lstm.units, [384, 256]);
    assert_eq!((network.primitives.torso, network.primitives.hidden), (vec![512, 512], 256));
    assert_eq!((network.primitives.count, network.primitives.gate), (5, vec![400, 400]));
    assert_eq!((network.clip_embedding, network.latent.size, network.latent.beta), (30, 60, 5e-4));
    assert_eq!((tracking.reference_steps, tracking.termination_threshold), (vec![1, 2, 3, 4, 5], 0.3));
    // V-MPO: one gradient step on the whole batch, no entropy bonus, no clipping; a target network.
    assert_eq!((vmpo.gradient_steps, vmpo.minibatch_unrolls, vmpo.target_period), (1, 128, 100));
    assert_eq!((vmpo.entropy, optimiser.max_gradient_norm, vmpo.lambda), (0.0, 0.0, 1.0));
    // Additions to the paper are off.
    let Experiment { network, tracking, optimiser, .. } = Experiment::default();
    assert_eq!((network.normaliser_steps, tracking.preset_actuators), (0, false));
    assert_eq!((network.initial_pose, network.latent.prior), (InitialPose::MidRange, Prior::Standard));
    assert_eq!((tracking.termination_error, optimiser.final_learning_rate_share), (TerminationError::DmControl, 1.0));
}

#[test]
fn the_paper_preset_is_the_defaults() {
    assert_eq!(resolve("tracking-mlp", &[]).unwrap(), Experiment::default());
}

#[test]
fn the_other_low_levels_presets_are_the_papers() {
    let of = |preset: &str| {
        let Experiment { vmpo, network, .. } = resolve(preset, &[]).unwrap();
        let bottleneck = (network.latent.size, network.latent.beta, network.primitives.biases);
        (network.low_level, vmpo.epsilon_eta, vmpo.epsilon_mean, vmpo.epsilon_std, vmpo.epsilon_discrete, bottleneck)
    };
    // CoMic supplement, tables 1 to 4; ε_discrete is the mixture's alone.
    assert_eq!(of("tracking-lstm"), (LowLevelName::Lstm, 0.1, 0.1, 1e-5, 1e-3, (60, 5e-4, false)));
    assert_eq!(of("tracking-mixture"), (LowLevelName::Mixture, 0.1, 0.1, 1e-3, 1e-3, (0, 5e-4, true)));
    assert_eq!(of("tracking-product"), (LowLevelName::Product, 0.1, 0.1, 1e-3, 1e-3, (60, 5e-4, false)));
}

#[test]
fn contradictory_fields_are_refused() {
    let refused = |overrides: &[&str]| {
        let overrides: Vec<String> = overrides.iter().map(ToString::to_string).collect();
        resolve("quickstart", &overrides).unwrap_err().to_string()
    };
    let error = refused(&["vmpo.value_burn_in=2"]);
    assert!(error.contains("network.value_lstm"), "{error}");
    let error = refused(&["network.latent.size=0"]);
    assert!(error.contains("must be 1 to 4096"), "{error}");
    let error = refused(&["unroll.lockstep=true"]);
    assert!(error.contains("budget.minutes = 9.0") && error.contains("budget.updates"), "{error}");
    let error = refused(&["unroll.lockstep=true", "budget.minutes=0", "unroll.ahead=1"]);
    assert!(error.contains("unroll.ahead = 1: must be 0"), "{error}");
    resolve("quickstart", &["unroll.lockstep=true".into(), "budget.minutes=0".into()]).unwrap();
    resolve("quickstart", &["vmpo.value_burn_in=2".into(), "network.value_lstm=[8]".into()]).unwrap();
    let error = refused(&["network.low_level=mixture"]);
    assert!(error.contains("vmpo.control_variate = 1.0: must be 0") && error.contains("mixture"), "{error}");
    let error = refused(&["tracking.termination_error=supplement"]);
    assert!(error.contains("vmpo.action_gradient = 40.0: must be 0"), "{error}");
    let mixture = ["network.low_level=mixture", "network.latent.size=0", "vmpo.control_variate=0"];
    resolve("quickstart", &mixture.map(String::from)).unwrap();
}

#[test]
fn an_empty_document_is_the_defaults() {
    assert_eq!(Experiment::from_toml("empty.toml", "").unwrap(), Experiment::default());
}

// Files

#[test]
fn a_file_resolves_like_a_preset() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("mine.toml");
    std::fs::write(&path, "name = \"mine\"\n[[clips]]\nsource = \"builtin:run\"\nweight = 2\n").unwrap();
    let experiment = resolve(path.to_str().unwrap(), &["vmpo.discount=0.9".into()]).unwrap();
    let run = ClipSource { weight: 2.0, ..ClipSource::whole("builtin:run") };
    assert_eq!((experiment.name.as_str(), experiment.vmpo.discount, experiment.clips), ("mine", 0.9, vec![run]));
}

#[test]
fn the_error_of_an_unknown_document_lists_the_presets() {
    let message = resolve("trackin-mlp", &[]).unwrap_err().to_string();
    assert!(message.starts_with("no preset or file `trackin-mlp` ("), "{message}");
    assert!(
        message.ends_with(
            "presets are ball-catch, corridor, gaps, get-up, go-to-target, joint-ball, joint-get-up, low-level, \
             quickstart, quickstart-from-zero, tracking-lstm, tracking-mixture, tracking-mlp, tracking-product, \
             transfer-ball-catch, transfer-corridor, transfer-corridor-svg0, transfer-gaps, transfer-get-up, \
             transfer-go-to-target, transfer-paper, transfer-walls, walks-and-more, walls"
        ),
        "{message}"
    );
}

#[test]
fn bad_syntax_names_file_line_and_column() {
    let message = refused_text("name = \"mine\"\n\n[vmpo\ndiscount = 0.9\n");
    assert!(message.starts_with("run.toml: TOML parse error at line 3, column 6"), "{message}");
}

#[test]
fn a_wrong_type_names_file_line_and_field() {
    let message = refused_text("name = \"mine\"\n\n[vmpo]\ndiscount = \"much\"\n");
    assert!(message.starts_with("run.toml: TOML parse error at line 4, column 12"), "{message}");
    assert!(message.contains("discount = \"much\""), "{message}");
    assert!(message.ends_with("invalid type: string \"much\", expected f64"), "{message}");
    let message = refused_text("[unroll]\nlength = -1\n");
    assert!(message.contains("line 2") && message.contains("length = -1"), "{message}");
    let message = refused_text("[tracking]\ntermination_error = \"dmcontrol\"\n");
    assert!(message.contains("line 2") && message.contains("`dm-control`"), "{message}");
    let message = refused_text("[[clips]]\nids = [\"CMU_007_01\"]\n");
    assert!(message.contains("missing field `source`"), "{message}");
}

// Unknown fields

#[test]
fn an_unknown_field_is_refused_with_line_and_nearest_name() {
    for (text, expected) in [
        ("sead = 1", "run.toml:1: unknown field `sead`; did you mean `seed`?"),
        (
            "[vmpo]\nepsilon_eta = 0.2\nepsilon_etaa = 0.2",
            "run.toml:3: unknown field `vmpo.epsilon_etaa`; did you mean `vmpo.epsilon_eta`?",
        ),
        (
            "[network.latent]\n\nsise = 3",
            "run.toml:3: unknown field `network.latent.sise`; did you mean `network.latent.size`?",
        ),
        ("vmpo = { discont = 0.9 }", "run.toml:1: unknown field `vmpo.discont`; did you mean `vmpo.discount`?"),
        (
            "network.latent.bata = 1",
            "run.toml:1: unknown field `network.latent.bata`; did you mean `network.latent.beta`?",
        ),
        ("\n[optimizer]\nbeta1 = 0.9", "run.toml:2: unknown field `optimizer`; did you mean `optimiser`?"),
    ] {
        assert_eq!(refused_text(text), expected);
    }
}

#[test]
fn an_unknown_field_of_a_clip_names_which_clip() {
    let clips = "[[clips]]\nsource = \"builtin:walk\"\n\n[[clips]]\nsource = \"builtin:run\"\nwieght = 2.0\n";
    assert_eq!(refused_text(clips), "run.toml:6: unknown field `clips.1.wieght`; did you mean `clips.1.weight`?");
    assert_eq!(
        refused_text("clips = [{ source = \"builtin:walk\", end = 5 }]"),
        "run.toml:1: unknown field `clips.0.end`; did you mean `clips.0.end_step`?"
    );
}

#[test]
fn the_error_of_a_field_in_the_wrong_section_names_the_right_one() {
    assert_eq!(
        refused_text("discount = 0.9"),
        "run.toml:1: unknown field `discount`; did you mean `svg0.discount` or `vmpo.discount`?"
    );
    assert_eq!(
        refused_text("[vmpo]\nbeta = 0.1"),
        "run.toml:2: unknown field `vmpo.beta`; did you mean `network.latent.beta`?"
    );
}

#[test]
fn the_error_of_an_unsimilar_field_lists_the_known_ones() {
    assert_eq!(
        refused_text("[budget]\nzzz = 1"),
        "run.toml:2: unknown field `budget.zzz`; known here are environment_steps, minutes, updates"
    );
}

#[test]
fn an_unknown_field_of_the_prior_is_refused() {
    let message = refused_text("[network.latent]\nprior = { ar1 = { alfa = 0.9 } }");
    assert!(message.contains("line 2") && message.contains("alfa, available keys: alpha"), "{message}");
}

// Overrides

#[test]
fn overrides_reach_every_depth_and_are_applied_in_order() {
    let experiment = set(&[
        "name=mine",
        "seed=7",
        "vmpo.epsilon_eta=0.2",
        " network.latent.size = 16 ",
        "network.encoder=[64, 64]",
        "vmpo.epsilon_eta=0.3",
        "network.initial_pose=reference-mean",
        "network.latent.prior.ar1.alpha=0.95",
        "tracking.termination_error=\"supplement\"",
    ])
    .unwrap();
    assert_eq!((experiment.name.as_str(), experiment.seed), ("mine", 7));
    assert_eq!((experiment.vmpo.epsilon_eta, experiment.network.latent.size), (0.3, 16));
    assert_eq!(
        (experiment.network.encoder, experiment.network.initial_pose),
        (vec![64, 64], InitialPose::ReferenceMean)
    );
    assert_eq!(experiment.network.latent.prior, Prior::Ar1 { alpha: 0.95 });
    assert_eq!(experiment.tracking.termination_error, TerminationError::Supplement);
}

#[test]
fn an_override_changes_no_other_field() {
    let mut expected = resolve("quickstart", &[]).unwrap();
    expected.vmpo.epsilon_eta = 0.2;
    assert_eq!(resolve("quickstart", &["vmpo.epsilon_eta=0.2".into()]).unwrap(), expected);
}

#[test]
fn a_real_field_takes_whole_numbers_and_a_string_takes_any_text() {
    assert_eq!(set(&["vmpo.discount=0", "vmpo.value_weight=2"]).unwrap().vmpo.value_weight, 2.0);
    for name in ["7", "true", "a = b", "[1]", "1\nseed = 2", ""] {
        assert_eq!(set(&[&format!("name={name}")]).unwrap().name, name);
    }
}

#[test]
fn overrides_replace_all_clips_or_single_fields_of_them() {
    let experiment =
        set(&["clips=[{source=\"builtin:run\"}, {source=\"cmu.h5\", subset=\"walk_tiny\"}]", "clips.1.weight=2"])
            .unwrap();
    let files = ClipSource { subset: Some("walk_tiny".into()), weight: 2.0, ..ClipSource::whole("cmu.h5") };
    assert_eq!(experiment.clips, [ClipSource::whole("builtin:run"), files]);
    assert_eq!(set(&["clips.0.source=builtin:jump"]).unwrap().clips, [ClipSource::whole("builtin:jump")]);
    assert_eq!(set(&["clips.0.end_step=40"]).unwrap().clips[0].end_step, Some(40));
    assert_eq!(refused("clips.3.weight=2"), "--set clips.3.weight=2: no element `clips.3.weight`");
}

#[test]
fn the_error_of_a_malformed_override_shows_the_form() {
    for argument in ["vmpo.discount", "=0.9", "vmpo..discount=0.9", ".name=x", "vmpo.=1", ""] {
        assert_eq!(
            refused(argument),
            format!("--set {argument}: expected FIELD=VALUE, for instance --set vmpo.epsilon_eta=0.2")
        );
    }
}

#[test]
fn the_error_of_an_unknown_override_names_it_and_the_nearest_field() {
    for (argument, nearest) in [
        ("vmpo.epsilon_etta=0.2", "vmpo.epsilon_eta"),
        ("epsilon_eta=0.2", "vmpo.epsilon_eta"),
        ("network.latent.beeta=1", "network.latent.beta"),
        ("clips.0.wait=2", "clips.0.weight"),
    ] {
        let field = argument.split_once('=').unwrap().0;
        assert_eq!(refused(argument), format!("--set {argument}: unknown field `{field}`; did you mean `{nearest}`?"));
    }
}

#[test]
fn the_error_of_an_override_of_the_wrong_type_names_it_and_the_field() {
    assert_eq!(
        refused("vmpo.discount=much"),
        "--set vmpo.discount=much: invalid type: string \"much\", expected f64 in `vmpo.discount`"
    );
    let message = refused("unroll.length=1.5");
    assert!(message.starts_with("--set unroll.length=1.5: invalid type: floating point"), "{message}");
    let message = refused("name.first=x");
    assert!(message.starts_with("--set name.first=x: invalid type: map"), "{message}");
}

#[test]
fn an_experiment_takes_overrides_as_a_document_does() {
    let overrides = |argument: &str| [argument.to_owned()];
    let checkpoint = || resolve("get-up", &[]).unwrap();
    let changed = checkpoint().with_overrides(&overrides("get_up.lying_share=1")).unwrap();
    assert_eq!(changed, resolve("get-up", &overrides("get_up.lying_share=1")).unwrap());
    assert_eq!(checkpoint().with_overrides(&[]).unwrap(), checkpoint());
    let error = checkpoint().with_overrides(&overrides("get_up.lying_share=2")).unwrap_err().to_string();
    assert!(error.contains("--set get_up.lying_share=2") && error.contains("must be in [0, 1]"), "{error}");
}

// Values

#[test]
fn meaningless_values_are_refused_with_field_and_remedy() {
    for (argument, remedy) in [
        ("clips=[]", "name at least one clip source"),
        ("clips.0.source=\"\"", "must be a file or builtin:NAME"),
        ("clips.0.weight=-1.0", "must be 0 or more"),
        ("clips.0.subset=\"walk\"", "must be one of walk_tiny, run_jump_tiny, get_up, locomotion_small, all"),
        ("clips.0.end_step=0", "must exceed start_step"),
        ("tracking.reference_steps=[]", "must be 1 to 64 numbers of frames ahead, each 0 to 1000"),
        ("tracking.reference_steps=[1001]", "must be 1 to 64 numbers of frames ahead, each 0 to 1000"),
        ("tracking.gradient.appendages=0.0", "must be in (0, 1]"),
        ("tracking.gradient.decay=1.5", "must be in [0, 1]"),
        ("tracking.gradient.root_velocity=-1.0", "must be 0 or more"),
        ("get_up.gradient.decay=1.5", "must be in [0, 1]"),
        ("get_up.gradient.balance=-1.0", "must be 0 or more"),
        ("network.final_std=0.0001", "must be 0, which is off, or from network.min_std to network.initial_std"),
        ("vmpo.control_variate=-1.0", "must be 0 or more"),
        ("tracking.min_steps=0", "must be 1 to 100000"),
        ("tracking.termination_threshold=0.0", "must be positive"),
        ("tracking.time_limit=-30.0", "must be positive seconds"),
        ("network.encoder=[]", "must be one or more layers of 1 to 16384 units"),
        ("network.value=[64, 0]", "must be one or more layers of 1 to 16384 units"),
        ("network.clip_embedding=0", "must be 1 to 4096"),
        ("network.initial_std=0.0", "must exceed network.min_std"),
        ("network.min_std=0.0", "must be at least 1e-6"),
        ("network.latent.size=0", "must be 1 to 4096"),
        ("network.latent.beta=-1.0", "must be 0 or more"),
        ("network.latent.initial_std=0.0001", "must exceed network.latent.min_std"),
        ("network.latent.prior.ar1.alpha=1.0", "must be in [0, 1)"),
        ("vmpo.discount=1.0", "must be in [0, 1)"),
        ("vmpo.lambda=1.5", "must be in [0, 1]"),
        ("vmpo.top_fraction=0.0", "must be in (0, 1]"),
        ("vmpo.epsilon_std=0.0", "must be positive"),
        ("vmpo.initial_temperature=0.0", "must be positive"),
        ("vmpo.target_period=0", "must be at least 1"),
        ("vmpo.gradient_steps=0", "must be at least 1"),
        ("vmpo.minibatch_unrolls=48", "must divide unroll.batch, 128"),
        ("vmpo.entropy=-0.1", "must be 0 or more"),
        ("optimiser.learning_rate=0.0", "must be positive"),
        ("optimiser.multiplier_learning_rate=inf", "must be positive"),
        ("optimiser.beta2=1.0", "must be in [0, 1)"),
        ("optimiser.final_learning_rate_share=2.0", "must be in [0, 1]"),
        ("optimiser.max_gradient_norm=-1.0", "must be 0, which is off, or more"),
        ("unroll.length=0", "must be 1 to 4096"),
        ("unroll.batch=0", "must be 1 to 65536"),
        ("unroll.batch=65536", "times unroll.length must be at most 1048576 rows"),
        ("unroll.ahead=2", "must be 0 or 1"),
        ("actor.threads=0", "must be 1 to 1024"),
        ("actor.environments=5000", "must be 1 to 4096"),
        ("learner.threads=0", "must be 1 to 1024"),
        ("learner.checkpoint_seconds=0.0", "must be positive"),
        ("learner.checkpoints_kept=0", "must be at least 1"),
        ("learner.metrics_seconds=-1.0", "must be positive"),
        ("learner.restore_after=0", "must be at least 1"),
        ("budget.minutes=-1.0", "must be 0, which is no limit, or more"),
    ] {
        let (field, value) = argument.split_once('=').unwrap();
        assert_eq!(refused(argument), format!("--set {argument}: {field} = {value}: {remedy}"));
    }
}

#[test]
fn an_observation_that_the_task_does_not_have_is_refused() {
    let message = refused("tracking.observations=[\"body_height\", \"head_height\"]");
    assert!(message.contains("tracking.observations.1 = \"head_height\": must be one of body_height, "), "{message}");
    for name in TRACKING_OBSERVATIONS {
        set(&[&format!("tracking.observations=[\"{name}\"]")]).unwrap();
    }
}

#[test]
fn no_number_of_a_document_may_be_nan() {
    let document = Experiment::default().to_toml().unwrap();
    let mut section = String::new();
    let mut numbers = 0;
    for line in document.lines() {
        if let Some(header) = line.strip_prefix('[') {
            section = header.trim_matches(['[', ']']).replace("clips", "clips.0") + ".";
        }
        let Some((field, value)) = line.split_once(" = ") else { continue };
        if value.parse::<f64>().is_ok() && value.contains(['.', 'e']) {
            numbers += 1;
            assert!(set(&[&format!("{section}{field}=nan")]).is_err(), "{section}{field}");
        }
    }
    assert!(numbers > 25, "{numbers}");
}

#[test]
fn a_value_in_a_file_is_refused_with_its_line() {
    assert_eq!(
        refused_text("name = \"mine\"\n[vmpo]\ndiscount = 1.5\n"),
        "run.toml:3: vmpo.discount = 1.5: must be in [0, 1)"
    );
    assert_eq!(
        refused_text("[[clips]]\nsource = \"a.h5\"\n[[clips]]\nsource = \"b.h5\"\nweight = -1.0"),
        "run.toml:5: clips.1.weight = -1.0: must be 0 or more"
    );
    // The text does not have the field, so the error has no line.
    let message = refused_text("[unroll]\nbatch = 100\n");
    assert_eq!(message, "run.toml: vmpo.minibatch_unrolls = 128: must divide unroll.batch, 100");
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

    #[test]
    fn any_number_survives_overriding_writing_and_reading(
        rate in 1e-12..1.0_f64,
        discount in 0.0..1.0_f64,
        seed in 0..i64::MAX as u64,
        name in "\\PC*",
    ) {
        let overrides = [format!("optimiser.learning_rate={rate:e}"), format!("vmpo.discount={discount}"), format!("seed={seed}")];
        let mut experiment = resolve("quickstart", &overrides).unwrap();
        prop_assert_eq!(experiment.optimiser.learning_rate, rate);
        prop_assert_eq!((experiment.vmpo.discount, experiment.seed), (discount, seed));
        experiment.name = name;
        let text = experiment.to_toml().unwrap();
        prop_assert_eq!(Experiment::from_toml("kept", &text).unwrap(), experiment);
    }

    #[test]
    fn no_document_and_no_override_panics(text in "\\PC*", argument in "[a-z.0-9\\[\\]{}\"= ]*") {
        let _ = Experiment::from_toml("any", &text);
        let _ = resolve("quickstart", &[argument]);
    }
}
