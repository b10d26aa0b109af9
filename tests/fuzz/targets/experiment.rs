//! The text of an experiment file, and the text of an override.

#![no_main]

use comic_experiment::{Experiment, TaskSpec, presets};
use comic_fuzz::seed;
use libfuzzer_sys::fuzz_target;

fuzz_target!(init: {
    for (name, text) in presets::ALL {
        seed(name, text.as_bytes());
    }
    seed("override", b"vmpo.epsilon_eta=0.2");
    seed("whole", Experiment::default().to_toml().expect("an experiment can be written").as_bytes());
}, |text: &str| {
    if let Ok(experiment) = Experiment::from_toml("the experiment", text) {
        let written = experiment.to_toml().expect("an experiment that was read can be written");
        let again = Experiment::from_toml("the same", &written).expect("an experiment that was written can be read");
        assert_eq!(again, experiment);
        let _ = TaskSpec::new(&experiment, vec!["a clip".into()]);
    }
    let _ = comic_experiment::resolve("quickstart", &[text.to_owned()]);
});
