//! A saved table of a replay. If the first byte is odd, the checksum is made right, so that what stands before it is reached.

#![no_main]

use std::sync::{Arc, LazyLock};

use comic_fuzz::{experiment, layout, seed, spec};
use comic_proto::UnrollLayout;
use comic_replay::{Sample, Table, TableConfig, Unrolls};
use libfuzzer_sys::fuzz_target;
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

const MAX_SIZE: usize = 4;
const SAMPLE_SIZE: usize = 2;

static LAYOUT: LazyLock<Arc<UnrollLayout>> = LazyLock::new(|| {
    let experiment = experiment();
    let layout = Arc::new(layout(&spec(&experiment), &experiment));
    for inserted in [0, 3, MAX_SIZE + 1] {
        let mut table = Table::new(layout.clone(), config(&layout)).expect("memory for four unrolls");
        table.insert(&Unrolls::new(layout.clone(), inserted), &vec![0; inserted]);
        let mut bytes = vec![1];
        table.write_to(&mut bytes).expect("memory can be written");
        seed(&format!("{inserted}-inserted"), &bytes);
    }
    layout
});

fn config(layout: &UnrollLayout) -> TableConfig {
    TableConfig { max_size: MAX_SIZE, sample_size: SAMPLE_SIZE, memory: Table::memory(layout, MAX_SIZE) }
}

fuzz_target!(init: {
    LazyLock::force(&LAYOUT);
}, |bytes: &[u8]| {
    let Some((is_summed, bytes)) = bytes.split_first() else { return };
    let mut bytes = bytes.to_vec();
    if let Some(end) = bytes.len().checked_sub(4).filter(|_| is_summed % 2 == 1) {
        let sum = crc32c::crc32c(&bytes[..end]);
        bytes[end..].copy_from_slice(&sum.to_le_bytes());
    }
    let Ok(mut table) = Table::read_from(LAYOUT.clone(), config(&LAYOUT), &bytes[..]) else { return };
    assert!(table.len() <= MAX_SIZE);
    let mut again = Vec::new();
    table.write_to(&mut again).expect("memory can be written");
    // Of more items than fit, the oldest are left out.
    assert!(again == bytes || again.len() < bytes.len());
    let mut sample = Sample::new(LAYOUT.clone(), SAMPLE_SIZE);
    assert_eq!(table.sample(&mut sample, &mut Pcg64::seed_from_u64(0)), table.len() >= SAMPLE_SIZE);
    table.insert(&Unrolls::new(LAYOUT.clone(), MAX_SIZE), &[0; MAX_SIZE]);
    assert_eq!(table.len(), MAX_SIZE);
});
