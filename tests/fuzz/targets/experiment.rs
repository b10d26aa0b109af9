//! An experiment as somebody writes it, and a value of it as somebody types it.

#![no_main]

use comic_experiment::{Experiment, TaskSpec, presets};
use comic_fuzz::seed;
use libfuzzer_sys::fuzz_target;

fuzz_target!(init: {
    for (name, text) in presets::ALL {
        seed(name, text.as_bytes());
    }
    seed("override", b"vmpo.epsilon_eta=0.2");
    seed("whole", Experiment::default().to_toml().expect("an experiment is written").as_bytes());
}, |text: &str| {
    if let Ok(experiment) = Experiment::from_toml("the experiment", text) {
        let written = experiment.to_toml().expect("what was read can be written");
        let again = Experiment::from_toml("the same", &written).expect("what was written can be read");
        assert_eq!(again, experiment);
        let _ = TaskSpec::new(&experiment, vec!["a clip".into()]);
    }
    let _ = comic_experiment::resolve("quickstart", &[text.to_owned()]);
});
