//! Pieces of parameters, as they are received: they are assembled and loaded into a policy.

#![no_main]

use std::cell::RefCell;

use bytes::Bytes;
use comic_actor::session::{Assembled, Assembler};
use comic_fuzz::{experiment, seed, spec};
use comic_networks::{VmpoPolicy, from_safetensors, to_safetensors};
use comic_proto::v1::ParametersChunk;
use libfuzzer_sys::fuzz_target;
use prost::Message;
use tch::{Device, nn};

const LIMIT: u64 = 1 << 20;

thread_local! {
    static STORE: RefCell<nn::VarStore> = RefCell::new(store());
}

fn store() -> nn::VarStore {
    let experiment = experiment();
    let spec = spec(&experiment);
    let store = nn::VarStore::new(Device::Cpu);
    VmpoPolicy::new(&store.root(), &spec, &experiment.network, &vec![0.0; spec.action]).expect("valid networks");
    let whole = Bytes::from(to_safetensors(&store).expect("parameters can be written"));
    let half = whole.len() / 2;
    let piece = |offset: usize, data: Bytes| ParametersChunk {
        learner_epoch: 1,
        version: 1,
        total: whole.len() as u64,
        offset: offset as u64,
        data,
        run_over: false,
    };
    let pieces = [piece(0, whole.slice(..half)), piece(half, whole.slice(half..))];
    seed("valid", &pieces.iter().flat_map(Message::encode_length_delimited_to_vec).collect::<Vec<u8>>());
    store
}

fuzz_target!(init: {
    STORE.with(|_| ());
}, |bytes: &[u8]| {
    STORE.with_borrow_mut(|store| {
        let (mut rest, mut assembler) = (bytes, Assembler::new(LIMIT));
        while let Ok(piece) = ParametersChunk::decode_length_delimited(&mut rest) {
            match assembler.push(&piece) {
                Ok(Some(Assembled::Act(directive))) => {
                    let _ = from_safetensors(store, &directive.parameters);
                }
                Ok(_) if !rest.is_empty() => {}
                _ => return,
            }
        }
    });
});
