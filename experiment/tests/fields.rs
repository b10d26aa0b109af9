//! Fields by their dotted names: found by the end of the name, compared between experiments.
#![allow(clippy::unwrap_used, reason = "a test that cannot continue fails")]

use comic_experiment::{Difference, find_field, resolve};

#[test]
fn the_unique_end_of_a_name_finds_the_field() {
    for (name, field) in [
        ("network.latent.beta", "network.latent.beta"),
        ("latent.beta", "network.latent.beta"),
        ("beta", "network.latent.beta"),
        ("clips.0.weight", "clips.0.weight"),
        ("latent.initial_std", "network.latent.initial_std"),
    ] {
        assert_eq!(find_field("sweep.toml", name).unwrap(), field);
    }
}

#[test]
fn an_ambiguous_end_of_a_name_is_refused_with_all_candidates() {
    assert_eq!(
        find_field("sweep.toml", "initial_std").unwrap_err().to_string(),
        "sweep.toml: `initial_std` could be `network.initial_std` or `network.latent.initial_std` or `svg0.initial_std`; \
         write one of them"
    );
}

#[test]
fn an_unknown_end_of_a_name_is_refused_with_the_nearest_name() {
    for (name, nearest) in [("latent.bata", "network.latent.beta"), ("epsilon_etaa", "vmpo.epsilon_eta")] {
        assert_eq!(
            find_field("sweep.toml", name).unwrap_err().to_string(),
            format!("sweep.toml: unknown field `{name}`; did you mean `{nearest}`?")
        );
    }
}

#[test]
fn a_difference_names_the_field_and_both_values() {
    let [ours, theirs] =
        ["1e-3", "0.5"].map(|beta| resolve("tracking-mlp", &[format!("network.latent.beta={beta}")]).unwrap());
    assert_eq!(ours.differences(&ours).unwrap(), []);
    let expected = Difference { field: "network.latent.beta".into(), ours: "0.001".into(), theirs: "0.5".into() };
    assert_eq!(ours.differences(&theirs).unwrap(), [expected]);
    let theirs = ours.clone().with_clips(&["builtin:run".into()]);
    assert_eq!(ours.differences(&theirs).unwrap()[0].field, "clips");
}
