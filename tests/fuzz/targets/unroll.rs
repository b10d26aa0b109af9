//! A message with an unroll, as it is received: it is decoded, validated, and copied into a batch if it is valid.

#![no_main]

use std::sync::{Arc, LazyLock};

use bytes::Bytes;
use comic_fuzz::{experiment, layout, seed, spec};
use comic_proto::v1::{UnrollHeader, UnrollMessage};
use comic_proto::{Expected, Field, Pieces, ReceivedUnroll, UnrollBuffer, UnrollLayout, validate};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Phase, TaskAccounting};
use futures::executor::block_on;
use libfuzzer_sys::fuzz_target;
use prost::Message as _;

struct Service {
    layout: Arc<UnrollLayout>,
    /// Number of clips of each task.
    clips: Vec<usize>,
}

static SERVICE: LazyLock<Service> = LazyLock::new(|| {
    let experiment = experiment();
    let spec = spec(&experiment);
    let layout = Arc::new(layout(&spec, &experiment));
    let mut unroll = UnrollBuffer::new(&layout);
    for t in 0..layout.shape().length {
        for field in [Field::Valid, Field::Discount, Field::Std] {
            unroll.row_mut(field, t).fill(1.0);
        }
    }
    let header = UnrollHeader { layout_hash: layout.hash().to_vec(), ..UnrollHeader::default() };
    let message = UnrollMessage { header: Some(header), payload: unroll.into_bytes() }.encode_to_vec();
    seed("valid", &[&[128], &message[..]].concat());
    Service { layout, clips: spec.tasks.iter().map(|task| task.clips).collect() }
});

fuzz_target!(init: {
    LazyLock::force(&SERVICE);
}, |bytes: &[u8]| {
    let Service { layout, clips } = &*SERVICE;
    // The first byte decides where the message is cut in two.
    let Some((cut, bytes)) = bytes.split_first() else { return };
    let (front, back) = bytes.split_at(bytes.len() * usize::from(*cut) / 256);
    let message: Pieces = [front, back].into_iter().map(Bytes::copy_from_slice).collect();
    let received = ReceivedUnroll::decode(message);
    if let (Ok(received), Ok(generated)) = (&received, UnrollMessage::decode(bytes)) {
        assert_eq!(format!("{:?}", received.header), format!("{:?}", generated.header));
        assert_eq!(received.payload.range(0..received.payload.len()).collect::<Vec<_>>().concat(), generated.payload);
    }
    let Ok(ReceivedUnroll { header: Some(header), payload }) = received else { return };
    let expected = Expected { clips, epoch: 0, newest_version: 3 };
    if validate(layout, &header, &payload, &expected).is_ok() {
        let config = Config { unrolls: 2, max_staleness: 2, ahead: 0, order: BatchOrder::Arrival };
        let mut ledger = Ledger::new().with_tasks((0..clips.len()).map(|task| task.to_string()));
        let _ = ledger.join(header.incarnation, None);
        let batcher = Batcher::new(layout.clone(), config, Phase::begin(0), ledger);
        // The batch has room for two unrolls.
        block_on(batcher.insert(&header, payload));
        let accounting = batcher.accounting_by_task();
        assert!(accounting.all.balance() && accounting.tasks.values().all(TaskAccounting::balance));
    }
});
