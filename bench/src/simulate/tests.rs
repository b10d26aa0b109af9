//! Laws that every simulation obeys.

use super::observed::Observed;
use super::settings::Settings;
use super::simulation::Simulation;

/// Links that need no time.
const FAST: f64 = 1e6;

/// A small system that is bound by its learner, with fast links and without randomness.
fn small() -> Settings {
    Settings {
        actors: 64,
        threads: 1,
        environments: 1,
        learners: 1,
        link_gbps: FAST,
        shared_link: false,
        step_us: 100.0,
        length: 32,
        batch: 16,
        ahead: 1,
        update_ms: 50.0,
        target_period: 10,
        max_staleness: 40,
        unroll_bytes: 200_000.0,
        parameter_bytes: 5e6,
        gradient_bytes: 1e7,
        all_reduce_gbps: FAST,
        exchange_ms: 0.0,
        asset_bytes: 0.0,
        start_s: 0.0,
        spread: 0.0,
        any_version: false,
        seconds: 60.0,
        versions: 0,
        give_up_s: 600.0,
        seed: 1,
    }
}

fn observe(settings: Settings) -> Observed {
    settings.check().unwrap();
    Simulation::new(settings).run()
}

/// Environment steps a second that were trained on.
fn speed(settings: Settings) -> f64 {
    let observed = observe(settings);
    (observed.unrolls as usize * settings.length) as f64 / observed.seconds
}

fn oldest(observed: &Observed) -> u64 {
    observed.ages.keys().copied().max().unwrap()
}

fn publication(settings: Settings) -> f64 {
    observe(settings).publications().unwrap().quantile(100).unwrap()
}

/// Megabytes of a part of a learner's memory.
fn memory(settings: Settings, part: &str) -> f64 {
    let lines = super::report::figures(&settings, &observe(settings));
    lines.iter().find(|line| line["figure"] == "simulate.memory").unwrap()[part].as_f64().unwrap()
}

#[track_caller]
fn assert_near(value: f64, expected: f64, tolerance: f64) {
    assert!((value / expected - 1.0).abs() <= tolerance, "{value} is not within {tolerance} of {expected}");
}

#[test]
fn a_slow_learner_decides_the_throughput() {
    assert_near(speed(small()), 16.0 * 32.0 / 0.05, 0.01);
    assert_near(observe(small()).learning / 60.0, 1.0, 0.01);
}

#[test]
fn slow_actors_decide_the_throughput() {
    let settings = Settings { step_us: 10_000.0, update_ms: 0.01, environments: 4, ..small() };
    assert_near(speed(settings), 64.0 * 1e6 / 10_000.0, 0.01);
    // Its rounds are four times as long; it does not step faster.
    assert_near(settings.actor_bound(), 6400.0, 1e-9);
}

#[test]
fn a_slow_link_decides_the_throughput() {
    // Ten unrolls a second.
    let settings =
        Settings { link_gbps: 10.0 * 200_000.0 * 8.0 / 1e9, parameter_bytes: 1.0, seconds: 600.0, ..small() };
    assert_near(speed(settings), 320.0, 0.02);
    assert_near(settings.link_bound(), 320.0, 1e-9);
}

#[test]
fn without_newer_versions_every_unroll_is_new() {
    assert_eq!(oldest(&observe(Settings { target_period: 1_000_000, ..small() })), 0);
}

#[test]
fn without_a_batch_ahead_only_the_rounds_that_began_during_an_update_are_one_version_old() {
    // An actor goes on when its unroll has its place, and that is before the update. One round in four is the first of its
    // batch.
    let new = Settings { actors: 4, ahead: 0, target_period: 1, update_ms: 1.0, ..small() };
    let observed = observe(new);
    assert_eq!(oldest(&observed), 1);
    assert_near(observed.ages[&1] as f64, observed.unrolls as f64 / 4.0, 0.01);
    assert!(oldest(&observe(Settings { ahead: 1, update_ms: 50.0, ..new })) > 1);
}

#[test]
fn the_age_is_about_the_environments_for_each_unroll_of_a_batch() {
    let settings = Settings { actors: 320, target_period: 1, ..small() };
    let ages = observe(settings).ages;
    let mean = ages.iter().map(|(age, count)| (age * count) as f64).sum::<f64>() / ages.values().sum::<u64>() as f64;
    assert_near(mean, 320.0 / 16.0, 0.1);
}

#[test]
fn unrolls_older_than_the_limit_are_dropped_and_never_trained_on() {
    let settings = Settings { actors: 320, target_period: 1, max_staleness: 10, ..small() };
    let observed = observe(settings);
    assert!(observed.dropped.all() > 0);
    assert_eq!(oldest(&observed), 10);
    assert_eq!(observe(Settings { max_staleness: 40, ..settings }).dropped.all(), 0);
}

#[test]
fn the_bytes_to_the_learner_are_those_of_its_unrolls() {
    let observed = observe(Settings { link_gbps: 10.0, spread: 0.1, ..small() });
    assert_near(observed.bytes[0], observed.unrolls as f64 * 200_000.0, 0.01);
}

#[test]
fn the_bytes_from_the_learner_are_a_version_for_each_actor() {
    let observed = observe(Settings { link_gbps: 100.0, ..small() });
    let versions = observed.versions as f64;
    assert_near(observed.bytes[1], versions * 64.0 * 5e6, 0.01 + 1.0 / versions);
}

#[test]
fn twice_the_link_halves_the_time_of_a_publication() {
    let slow = Settings { link_gbps: 8.0, target_period: 100, ..small() };
    assert_near(publication(slow), 64.0 * 5e6 / 1e9, 0.01);
    assert_near(publication(Settings { link_gbps: 16.0, ..slow }), 64.0 * 5e6 / 2e9, 0.01);
}

#[test]
fn all_act_when_the_link_has_carried_assets_and_parameters() {
    let settings = Settings { link_gbps: 1.0, asset_bytes: 15e6, update_ms: 10_000.0, ..small() };
    assert_near(observe(settings).start().unwrap(), 64.0 * (15e6 + 5e6) / 125e6, 0.01);
}

#[test]
fn two_learners_halve_the_update_and_the_traffic_of_each() {
    let one = Settings { link_gbps: 8.0, actors: 128, target_period: 200, seconds: 100.0, ..small() };
    let two = Settings { learners: 2, ..one };
    assert_near(speed(two), 16.0 * 32.0 / (0.025 + 1e7 / 1e9), 0.01);
    assert_near(publication(two), publication(one) / 2.0, 0.02);
}

#[test]
fn gradients_move_as_fast_as_the_slower_of_backend_and_link() {
    let two = Settings { learners: 2, link_gbps: 80.0, all_reduce_gbps: 8.0, ..small() };
    assert_near(two.exchanges(), 1e7 / 1e9, 1e-9);
    assert_near(Settings { link_gbps: 0.8, ..two }.exchanges(), 1e7 / 1e8, 1e-9);
}

#[test]
fn learners_pay_for_each_exchange_and_one_alone_pays_nothing() {
    let two = Settings { learners: 2, exchange_ms: 3.0, ..small() };
    assert_near(speed(two), 16.0 * 32.0 / (0.025 + 0.003), 0.01);
    assert_near(speed(Settings { learners: 1, ..two }), speed(small()), 1e-9);
}

#[test]
fn learners_wait_for_the_slowest() {
    let even = Settings { learners: 4, ..small() };
    assert!(speed(Settings { spread: 0.5, ..even }) < 0.9 * speed(even));
}

#[test]
fn threads_share_a_version_and_a_connection() {
    let many = Settings { link_gbps: 8.0, target_period: 100, ..small() };
    let few = Settings { actors: 8, threads: 8, ..many };
    assert_near(publication(few), publication(many) / 8.0, 0.02);
    // All wait for a version at the same time, and for a shorter one.
    assert!(speed(few) >= speed(many));
}

#[test]
fn a_version_that_needs_longer_than_its_place_starves_actors_with_unequal_connections() {
    // A version needs 80 s for all, and a place is lost after 60 s.
    let settings = Settings { link_gbps: 0.032, target_period: 1, spread: 0.5, unroll_bytes: 1.0, ..small() };
    let slow = Settings { start_s: 30.0, max_staleness: 1_000_000, give_up_s: 1000.0, ..settings };
    assert!(observe(slow).cut_off > 0);
    assert_eq!(observe(Settings { link_gbps: 0.32, ..slow }).cut_off, 0);
}

#[test]
fn actors_that_wait_for_the_announced_version_send_newer_unrolls() {
    let waiting = Settings { link_gbps: 2.0, target_period: 4, spread: 0.1, ..small() };
    let hasty = Settings { any_version: true, ..waiting };
    let mean = |settings: Settings| {
        let ages = observe(settings).ages;
        ages.iter().map(|(age, count)| (age * count) as f64).sum::<f64>() / ages.values().sum::<u64>() as f64
    };
    assert!(mean(waiting) < mean(hasty));
}

#[test]
fn rare_versions_are_waited_for_until_enough_are_measured() {
    // A version each 50 s.
    let rare = Settings { target_period: 1000, seconds: 1.0, versions: 4, ..small() };
    let observed = observe(rare);
    assert_eq!(observed.versions, 4);
    assert_near(observed.seconds, 4.0 * 50.0, 0.01);
    // The first one does not come in time.
    assert_eq!(observe(Settings { give_up_s: 10.0, ..rare }).versions, 0);
}

#[test]
fn too_few_versions_for_a_steady_state_are_reported() {
    let few = |versions| {
        let settings = Settings { target_period: 100, seconds: 1.0, versions, ..small() };
        super::report::figures(&settings, &observe(settings))[0]["few_versions"].clone()
    };
    assert_eq!([few(9), few(10)], [true, false]);
}

#[test]
fn a_stream_holds_an_unroll_that_waits_for_its_place_and_one_in_its_window() {
    let one = Settings { actors: 1, environments: 64, unroll_bytes: 1e6, update_ms: 1e4, ..small() };
    assert_eq!(memory(one, "messages"), 2.0);
}

#[test]
fn unrolls_that_messages_have_no_room_for_are_memory_as_well() {
    // All actors but 32 wait for the learner, with an unroll of 1 MB each.
    let crowd = Settings { actors: 832, unroll_bytes: 1e6, update_ms: 1e4, ..small() };
    assert_near(memory(crowd, "messages"), 268.4, 0.01);
    assert_near(memory(crowd, "messages") + memory(crowd, "windows"), 800.0, 0.05);
}

#[test]
fn the_seed_decides_everything() {
    let settings = Settings { link_gbps: 1.0, spread: 0.3, start_s: 1.0, ..small() };
    let lines = |settings: Settings| super::report::figures(&settings, &observe(settings));
    assert_eq!(lines(settings), lines(settings));
    assert_ne!(observe(settings).reads, observe(Settings { seed: 2, ..settings }).reads);
}

#[test]
fn every_figure_of_a_hopeless_system_is_a_number_or_null() {
    // The first version would need a day.
    let settings = Settings { link_gbps: 1e-3, parameter_bytes: 1e12, give_up_s: 10.0, seconds: 10.0, ..small() };
    let lines = super::report::figures(&settings, &observe(settings));
    let value = |name: &str| lines.iter().find(|line| line["figure"] == name).unwrap()["value"].clone();
    assert!(value("simulate.start").is_null() && value("simulate.age").is_null());
    assert_eq!(value("simulate.steps"), 0.0);
    assert_eq!(value("simulate.waiting"), 1.0);
}

#[test]
fn times_for_which_a_clock_is_too_coarse_are_refused() {
    assert_eq!(super::time("1e6"), Ok(1e6));
    assert!(super::time("1e7").is_err() && super::time_or_none("1e7").is_err() && super::time("0").is_err());
}

#[test]
fn settings_that_cannot_be_simulated_name_their_options() {
    let refused = |settings: Settings| settings.check().unwrap_err().to_string();
    assert!(refused(Settings { actors: 2, learners: 4, ..small() }).contains("--learners 4"));
    assert!(refused(Settings { learners: 3, ..small() }).contains("--batch 16"));
    assert!(refused(Settings { actors: 1_000_000, threads: 1_000_000, ..small() }).contains("--threads 1000000"));
}
