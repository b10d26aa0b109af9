//! Exported policies, encoders and low levels, from anywhere.

#![no_main]

use comic_experiment::{Experiment, Transfer};
use comic_fuzz::{experiment_with, seed, spec};
use comic_networks::export::{Exported, Source};
use comic_networks::{VmpoPolicy, to_safetensors};
use libfuzzer_sys::fuzz_target;
use tch::{Device, nn};

fuzz_target!(init: {
    let product = ["network.low_level=product", "network.primitives={count=2, torso=[2], hidden=2, gate=[2]}"];
    for (name, more) in [("mlp", &[][..]), ("prior", &["network.latent.prior={state={hidden=[2]}}"]), ("product", &product)] {
        let experiment = experiment_with(more);
        let spec = spec(&experiment);
        let store = nn::VarStore::new(Device::Cpu);
        VmpoPolicy::new(&store.root(), &spec, &experiment.network, &vec![0.0; spec.action]).expect("valid networks");
        let policy = to_safetensors(&store).expect("parameters can be written");
        for part in ["policy", "encoder:tracking", "low-level"] {
            let named = part.parse().expect("a part");
            let exported = Exported::new(named, &experiment, Source::default(), &policy, None);
            seed(&format!("{part}-{name}"), &exported.expect("the experiment's parameters").bytes);
        }
    }
}, |bytes: &[u8]| {
    let Ok(exported) = Exported::read(bytes.to_vec()) else { return };
    let written = exported.experiment.to_toml().expect("an experiment that was read can be written");
    Experiment::from_toml("the same", &written).expect("an experiment that was written can be read");
    let _ = exported.parameters().expect("a file that was read has parameters");
    let _ = exported.freeze(&Transfer::default());
});
