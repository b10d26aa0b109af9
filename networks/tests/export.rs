//! Policies as files: an exported policy acts like the original, and invalid files are refused.

#![allow(clippy::unwrap_used, reason = "helpers of tests may panic")]

use std::collections::{BTreeMap, BTreeSet, HashMap};

use comic_experiment::{Experiment, LowLevelName, TaskSpec, resolve};
use comic_networks::export::{Exported, KEY, Part, Source};
use comic_networks::{Error, Policy, RecurrentState, Routing, VmpoPolicy, from_safetensors, to_safetensors};
use proptest::prelude::*;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::Value;
use tch::{CModule, Device, Kind, Tensor, nn};

/// libtorch has one generator per process, so tests that seed it must not run at the same time.
static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// A preset with small networks.
fn small(preset: &str, more: &[&str]) -> Experiment {
    let sizes = [
        "network.encoder=[8]",
        "network.mlp.hidden=[8]",
        "network.lstm.units=[6,5]",
        "network.primitives.count=3",
        "network.primitives.torso=[8]",
        "network.primitives.hidden=6",
        "network.primitives.gate=[7]",
        "network.latent.size=4",
        "network.normaliser_steps=1",
        "network.policy_head_scale=1",
    ];
    let overrides: Vec<String> = sizes.iter().chain(more).map(|field| (*field).to_string()).collect();
    resolve(preset, &overrides).unwrap()
}

/// A policy of the experiment with random parameters, statistics included.
fn policy(experiment: &Experiment) -> (nn::VarStore, VmpoPolicy, TaskSpec) {
    tch::manual_seed(1);
    let spec = TaskSpec::new(experiment, Vec::new()).unwrap();
    let store = nn::VarStore::new(Device::Cpu);
    let policy = VmpoPolicy::new(&store.root(), &spec, &experiment.network, &vec![0.1; spec.action]).unwrap();
    // Sorted by name, so the same experiment gives the same policy.
    for (name, tensor) in store.variables().into_iter().collect::<BTreeMap<_, _>>() {
        let mut noise = tensor.detach().rand_like() * 0.5 - 0.25;
        if name.ends_with("_std") {
            noise += 1.0;
        }
        tch::no_grad(|| tensor.shallow_clone().copy_(&noise));
    }
    (store, policy, spec)
}

fn source() -> Source {
    Source { run: "walk".into(), checkpoint: "checkpoint-0000000007".into(), updates: 7, ..Source::default() }
}

fn exported(part: &str, experiment: &Experiment) -> Result<Exported, Error> {
    let _guard = GENERATOR.lock().unwrap();
    let (store, ..) = policy(experiment);
    Exported::new(part.parse().unwrap(), experiment, source(), &to_safetensors(&store).unwrap(), None)
}

fn names(exported: &Exported) -> BTreeSet<String> {
    let document = SafeTensors::deserialize(&exported.bytes).unwrap();
    document.names().into_iter().map(String::from).collect()
}

fn random(width: usize) -> Tensor {
    Tensor::randn([1, width as i64], (Kind::Float, Device::Cpu))
}

#[test]
fn every_part_is_read_as_it_was_written_and_describes_itself() {
    let joint = small("joint-get-up", &[]);
    for (part, inputs, outputs) in [
        ("policy", "proprioception observation:tracking observation:get-up recurrent_state", "action recurrent_state"),
        ("policy:get-up", "proprioception observation:get-up recurrent_state", "action recurrent_state"),
        ("encoder:get-up", "observation:get-up proprioception previous_latent", "latent_mean latent_std"),
        ("low-level", "latent proprioception state", "mean std state"),
    ] {
        let file = exported(part, &joint).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("part.safetensors");
        std::fs::write(&path, &file.bytes).unwrap();
        let again = Exported::open(&path).unwrap();
        assert_eq!((&again.spec, &again.experiment, &again.bytes), (&file.spec, &file.experiment, &file.bytes));
        assert_eq!((again.spec.part.to_string().as_str(), again.spec.source), (part, source()));
        let named = |vectors: &[comic_networks::export::Vector]| {
            vectors.iter().map(|vector| vector.name.clone()).collect::<Vec<_>>().join(" ")
        };
        assert_eq!((named(&again.spec.inputs), named(&again.spec.outputs)), (inputs.into(), outputs.into()));
        for vector in again.spec.inputs.iter().filter(|vector| !vector.entries.is_empty()) {
            assert_eq!(vector.entries.iter().map(|entry| entry.size).sum::<usize>(), vector.size, "{vector:?}");
        }
    }
}

#[test]
fn tensors_have_the_same_names_as_in_a_checkpoint() {
    let joint = small("joint-get-up", &[]);
    let all = names(&exported("policy", &joint).unwrap());
    let getting_up = names(&exported("encoder:get-up", &joint).unwrap());
    let low_level = names(&exported("low-level", &joint).unwrap());
    assert!(getting_up.is_subset(&all) && low_level.is_subset(&all));
    for name in ["encoder.get-up.layers.0.weight", "encoder.get-up.head.bias", "normaliser.task_mean"] {
        assert!(getting_up.contains(name), "{name}");
    }
    for name in ["low_level.layers.0.weight", "low_level.head.bias", "normaliser.proprioception_std"] {
        assert!(low_level.contains(name), "{name}");
    }
    assert!(!low_level.contains("normaliser.task_mean") && !getting_up.contains("low_level.head.bias"));
    assert!(!names(&exported("policy:get-up", &joint).unwrap()).contains("encoder.tracking.head.bias"));
}

#[test]
fn a_policy_of_one_task_acts_like_the_joint_policy_in_that_task() {
    let joint = small("joint-get-up", &[]);
    let file = exported("policy:get-up", &joint).unwrap();
    let _guard = GENERATOR.lock().unwrap();
    let (_, both, spec) = policy(&joint);
    let own = TaskSpec::new(&file.experiment, Vec::new()).unwrap();
    let mut store = nn::VarStore::new(Device::Cpu);
    let alone = VmpoPolicy::new(&store.root(), &own, &file.experiment.network, &vec![0.0; own.action]).unwrap();
    from_safetensors(&mut store, &file.bytes).unwrap();

    let (proprioception, latent, state) = (random(spec.proprioception), random(4), random(0));
    let task = random(spec.task);
    let act = |policy: &VmpoPolicy, task: &Tensor, routing: Routing| {
        let observation = policy.normalise(&proprioception, task, None, &routing);
        let recurrent = RecurrentState { state: &state, first: None };
        policy.act(&observation, &latent, &latent.zeros_like(), recurrent).action.mode()
    };
    let expected = act(&both, &task, Routing::grouped(&[1], 2));
    // A shorter task observation is at the end of the row.
    let own_task = task.narrow(1, (spec.task - own.task) as i64, own.task as i64);
    let found = act(&alone, &own_task, Routing::single());
    assert!((expected - found).abs().max().double_value(&[]) < 1e-6);
}

#[test]
fn loading_a_low_level_into_another_policy_changes_nothing_else() {
    let file = exported("low-level", &small("joint-get-up", &[])).unwrap();
    let _guard = GENERATOR.lock().unwrap();
    // The other policy has another task and an encoder of another size.
    let (store, ..) = policy(&small("go-to-target", &["network.encoder=[9, 9]"]));
    let values = || {
        let values = |tensor: Tensor| Vec::<f32>::try_from(tensor.detach().flatten(0, -1)).unwrap();
        store.variables().into_iter().map(|(name, tensor)| (name, values(tensor))).collect::<HashMap<_, _>>()
    };
    for tensor in store.variables().values() {
        let _ = tch::no_grad(|| tensor.shallow_clone().fill_(0.5));
    }
    file.load(&store).unwrap();
    let moved = names(&file);
    for (name, after) in values() {
        assert_eq!(after.iter().all(|value| *value == 0.5), !moved.contains(&name), "{name}");
    }
    let (other, ..) = policy(&small("go-to-target", &["network.mlp.hidden=[9]"]));
    assert!(matches!(file.load(&other).unwrap_err(), Error::Shape { .. }));
}

#[test]
fn torch_script_acts_like_the_policy_with_every_low_level() {
    let directory = tempfile::tempdir().unwrap();
    for (name, bare) in LowLevelName::ALL.into_iter().map(|name| (name, false)).chain([(LowLevelName::Mixture, true)]) {
        let size = format!("network.latent.size={}", if bare { 0 } else { 4 });
        let experiment = small("tracking-mlp", &[&format!("network.low_level={name}"), &size]);
        let file = exported("policy", &experiment).unwrap();
        let path = directory.path().join(format!("{name}-{bare}.pt"));
        let _guard = GENERATOR.lock().unwrap();
        file.save_script(&path).unwrap();
        let module = CModule::load(&path).unwrap();

        let (_, policy, spec) = policy(&experiment);
        let (latent, state) = (experiment.network.latent.size, experiment.network.state_size());
        let mut input_state = Tensor::zeros([1, (latent + state) as i64], (Kind::Float, Device::Cpu));
        let mut previous =
            (input_state.narrow(1, 0, latent as i64), input_state.narrow(1, latent as i64, state as i64));
        for step in 0..4 {
            let (proprioception, task) = (random(spec.proprioception), random(spec.task));
            let output = module.forward_ts(&[&proprioception, &task, &input_state]).unwrap();
            let observation = policy.normalise(&proprioception, &task, None, &Routing::single());
            let recurrent = RecurrentState { state: &previous.1, first: None };
            let acting = tch::no_grad(|| policy.act(&observation, &previous.0, &previous.0.zeros_like(), recurrent));
            let action = acting.action.mode().clamp(-1.0, 1.0);
            let expected = Tensor::cat(&[&action, &acting.latent, &acting.state], 1);
            assert_eq!(output, expected, "{name}, step {step}");
            input_state = output.narrow(1, spec.action as i64, (latent + state) as i64);
            previous = (acting.latent, acting.state);
        }
        let batch = [spec.proprioception, spec.task, latent + state]
            .map(|size| Tensor::cat(&[random(size), random(size), random(size)], 0));
        let together = module.forward_ts(&batch).unwrap();
        for row in 0..3 {
            let alone = module.forward_ts(&batch.each_ref().map(|input| input.narrow(0, row, 1))).unwrap();
            assert!(together.narrow(0, row, 1).allclose(&alone, 1e-5, 1e-6, false), "{name}, row {row} of three");
        }
    }
}

#[test]
fn torch_script_takes_its_inputs_in_the_order_of_the_description_with_an_image_too() {
    for preset in ["gaps", "go-to-target"] {
        let experiment = small(preset, &["network.low_level=lstm", "network.image_features=7"]);
        let file = exported("policy", &experiment).unwrap();
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("policy.pt");
        let _guard = GENERATOR.lock().unwrap();
        file.save_script(&path).unwrap();

        let (_, policy, spec) = policy(&experiment);
        let (proprioception, task, memory) = (random(spec.proprioception), random(spec.task), random(4 + 2 * (6 + 5)));
        let pixels = Tensor::randint(256, [1, spec.image as i64], (Kind::Uint8, Device::Cpu));
        let inputs: Vec<&Tensor> = file
            .spec
            .inputs
            .iter()
            .map(|input| match input.name.as_str() {
                "proprioception" => &proprioception,
                "recurrent_state" => &memory,
                "image" => &pixels,
                name => name.strip_prefix("observation:").map(|_| &task).unwrap(),
            })
            .collect();
        assert_eq!(inputs.len(), if preset == "gaps" { 4 } else { 3 });
        let output = CModule::load(&path).unwrap().forward_ts(&inputs).unwrap();

        let image = (spec.image > 0).then_some(&pixels);
        let observation = policy.normalise(&proprioception, &task, image, &Routing::single());
        let (latent, state) = (memory.narrow(1, 0, 4), memory.narrow(1, 4, 22));
        let recurrent = RecurrentState { state: &state, first: None };
        let acting = tch::no_grad(|| policy.act(&observation, &latent, &latent.zeros_like(), recurrent));
        let expected = Tensor::cat(&[acting.action.mode().clamp(-1.0, 1.0), acting.latent, acting.state], 1);
        assert_eq!(output, expected, "{preset}");
    }
}

#[test]
fn a_mixture_without_noise_acts_with_its_most_likely_component_in_each_row() {
    let weights = Tensor::from_slice(&[0.2f32, 0.8, 0.7, 0.3]).log().reshape([2, 2]);
    let mean = Tensor::from_slice(&[1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]).reshape([2, 4]);
    let action = comic_networks::ActionDistribution::from_rows(&mean, &mean.ones_like(), &weights).mode();
    assert_eq!(Vec::<Vec<f32>>::try_from(&action).unwrap(), [[3.0, 4.0], [5.0, 6.0]]);
}

#[test]
fn torch_script_needs_a_policy_of_one_task() {
    let directory = tempfile::tempdir().unwrap();
    let joint = small("joint-get-up", &[]);
    for part in ["policy", "low-level"] {
        let file = exported(part, &joint).unwrap();
        let refused = file.save_script(&directory.path().join("policy.pt")).unwrap_err().to_string();
        assert!(refused.contains("policy:TASK") && refused.contains("tracking, get-up"), "{refused}");
    }
    let path = directory.path().join("get-up.pt");
    exported("policy:get-up", &joint).unwrap().save_script(&path).unwrap();
    assert!(CModule::load(&path).is_ok());
}

#[test]
fn the_error_for_a_task_that_was_not_learnt_names_the_learnt_tasks() {
    let refused = exported("encoder:ball-catch", &small("joint-get-up", &[])).unwrap_err().to_string();
    assert!(refused.contains("`ball-catch`") && refused.contains("tracking, get-up"), "{refused}");
}

/// A policy's file whose description or tensors were altered.
fn altered(
    description: impl FnOnce(&mut Value),
    tensors: impl FnOnce(&mut HashMap<String, (Vec<usize>, Vec<u8>)>),
) -> Vec<u8> {
    altered_part("policy", description, tensors)
}

fn altered_part(
    part: &str,
    description: impl FnOnce(&mut Value),
    tensors: impl FnOnce(&mut HashMap<String, (Vec<usize>, Vec<u8>)>),
) -> Vec<u8> {
    let file = exported(part, &small("tracking-mlp", &[])).unwrap();
    let mut spec = serde_json::to_value(&file.spec).unwrap();
    description(&mut spec);
    let document = SafeTensors::deserialize(&file.bytes).unwrap();
    let entries = document.tensors().into_iter();
    let mut entries = entries.map(|(name, view)| (name, (view.shape().to_vec(), view.data().to_vec()))).collect();
    tensors(&mut entries);
    let views =
        entries.iter().map(|(name, (shape, bytes))| (name, TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap()));
    safetensors::serialize(views, Some(HashMap::from([(KEY.to_string(), spec.to_string())]))).unwrap()
}

fn refused(bytes: Vec<u8>) -> String {
    Exported::read(bytes).unwrap_err().to_string()
}

#[test]
fn a_wrong_description_is_refused_with_the_name_of_the_field() {
    type Alteration = fn(&mut Value);
    let cases: [(&str, Alteration); 11] = [
        ("`format`", |spec| spec["format"] = 3.into()),
        ("`format`", |spec| *spec = Value::Null),
        ("no part `value`", |spec| spec["part"] = "value".into()),
        ("task `ball-catch` was not learnt", |spec| spec["part"] = "policy:ball-catch".into()),
        ("`experiment`", |spec| spec["experiment"] = "seed = -".into()),
        ("network.encoder", |spec| spec["experiment"] = "[network]\nencoder = []".into()),
        ("`inputs`", |spec| spec["inputs"][0]["entries"][0]["name"] = "joints_vel".into()),
        ("`inputs`", |spec| spec["inputs"][1]["size"] = 3.into()),
        ("`outputs`", |spec| spec["outputs"] = Value::Array(Vec::new())),
        ("`normalisation`", |spec| spec["normalisation"]["limit"] = 5.into()),
        ("unknown field `more`", |spec| spec["more"] = 1.into()),
    ];
    for (expected, alter) in cases {
        let said = refused(altered(alter, |_| ()));
        assert!(said.contains(expected), "{expected}: {said}");
    }
}

/// Makes a field of the described experiment an array of huge layers: 2 GiB.
fn grow(spec: &mut Value, field: &str) {
    let experiment = spec["experiment"].as_str().unwrap();
    assert_eq!(experiment.matches(&format!("\n{field} = [8]\n")).count(), 1);
    let grown = experiment.replace(&format!("\n{field} = [8]\n"), &format!("\n{field} = [16384, 16384, 16384]\n"));
    spec["experiment"] = grown.into();
}

#[test]
fn a_description_of_larger_networks_than_the_file_is_refused() {
    for (part, field) in
        [("policy", "encoder"), ("policy", "hidden"), ("encoder:tracking", "encoder"), ("low-level", "hidden")]
    {
        let said = refused(altered_part(part, |spec| grow(spec, field), |_| ()));
        assert!(said.contains("`experiment`") && said.contains("weights, but the file has"), "{part}: {said}");
    }
}

/// The most memory that this process has had, MiB.
#[cfg(target_os = "linux")]
fn peak_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() / 1024
}

#[cfg(target_os = "linux")]
#[test]
fn a_part_is_read_without_building_the_networks_that_it_does_not_hold() {
    for (part, field) in [("low-level", "encoder"), ("encoder:tracking", "hidden")] {
        Exported::read(altered_part(part, |_| (), |_| ())).unwrap();
        let bytes = altered_part(part, |spec| grow(spec, field), |_| ());
        let before = peak_memory();
        let file = Exported::read(bytes).unwrap();
        if part == "low-level" {
            file.untrained(1).unwrap();
        }
        let more = peak_memory() - before;
        assert!(more < 256, "{part}: {more} MiB for a file of {} KiB", file.bytes.len() / 1024);
    }
}

#[test]
fn tensors_that_do_not_fit_are_refused_with_their_name() {
    let name = "low_level.head.bias".to_string();
    let missing = altered(|_| (), |tensors| drop(tensors.remove("low_level.head.bias")));
    assert!(refused(missing).contains("`low_level.head.bias` is missing"));
    let unknown = altered(|_| (), |tensors| drop(tensors.insert("more".into(), (vec![1], vec![0; 4]))));
    assert!(refused(unknown).contains("`more` is unknown"));
    let shape = altered(|_| (), |tensors| drop(tensors.insert(name.clone(), (vec![1], vec![0; 4]))));
    assert!(refused(shape).contains("has shape [1]"));
    let nan = altered(
        |_| (),
        |tensors| {
            let (_, bytes) = tensors.get_mut("low_level.head.bias").unwrap();
            bytes[..4].copy_from_slice(&f32::NAN.to_le_bytes());
        },
    );
    assert!(refused(nan).contains("an infinity or a NaN"));
}

#[test]
fn the_error_for_a_missing_description_names_the_command_that_writes_it() {
    let _guard = GENERATOR.lock().unwrap();
    let (store, ..) = policy(&small("tracking-mlp", &[]));
    let said = refused(to_safetensors(&store).unwrap());
    assert!(said.contains("`comic`") && said.contains("comic-learner export"), "{said}");
}

proptest! {
    #[test]
    fn damaged_files_do_not_panic(damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4), cut in any::<prop::sample::Index>()) {
        static FILE: std::sync::OnceLock<Vec<u8>> = std::sync::OnceLock::new();
        let whole = FILE.get_or_init(|| altered(|_| (), |_| ()));
        let mut bytes = whole.clone();
        // Only the head with the description is damaged: changed numbers of tensors are still numbers.
        let head = bytes.len().min(16_384);
        for (position, value) in &damage {
            bytes[position.index(head)] = *value;
        }
        drop(Exported::read(bytes));
        prop_assert!(Exported::read(whole[..cut.index(whole.len())].to_vec()).is_err());
    }
}

#[test]
fn a_part_in_json_is_spelt_as_on_the_command_line() {
    assert_eq!(serde_json::to_string(&"encoder:get-up".parse::<Part>().unwrap()).unwrap(), "\"encoder:get-up\"");
}

/// Files that the release before wrote (`comic-learner export`, commit e16633f), with fields that have other names now.
#[test]
fn files_of_the_format_before_are_read() {
    let stored = |name: &str| {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures/exported");
        std::fs::read(folder.join(format!("format_1_{name}.safetensors"))).unwrap()
    };
    let policy = Exported::read(stored("policy")).unwrap();
    assert_eq!((policy.spec.format, policy.experiment.network.encoder.as_slice()), (1, &[4][..]));
    assert!(policy.spec.experiment.contains("[warm_start]"));
    let low_level = Exported::read(stored("low-level")).unwrap();
    assert!(low_level.freeze(&comic_experiment::Transfer::default()).is_ok());
    assert!(Exported::read(low_level.bytes.clone()).is_ok());
}
