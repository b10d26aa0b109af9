//! A learner reads what an actor wrote.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use comic_proto::{Field, Invalid, UnrollBuffer, UnrollLayout, UnrollShape};
use proptest::prelude::*;

fn layout() -> UnrollLayout {
    UnrollLayout::new(UnrollShape {
        length: 3,
        proprioception: 5,
        task: 7,
        action: 2,
        latent: 4,
        reward_terms: 3,
        image: 0,
        components: 2,
        state: 3,
        action_gradient: 0,
    })
}

/// A number that identifies field, row and column.
fn mark(field: Field, t: usize, column: usize) -> f32 {
    (field as usize * 10_000 + t * 100 + column) as f32
}

#[test]
fn every_element_is_at_its_position_little_endian() {
    let layout = layout();
    let mut unroll = UnrollBuffer::new(&layout);
    for field in Field::ALL.into_iter().filter(|field| *field != Field::Clip) {
        for t in 0..layout.rows(field) {
            for (column, value) in unroll.row_mut(field, t).iter_mut().enumerate() {
                *value = mark(field, t, column);
            }
        }
    }
    for t in 0..layout.rows(Field::Clip) {
        unroll.set_clip(t, t as u32 + 40);
    }
    let payload = unroll.to_bytes();
    assert_eq!(payload.len(), layout.size());
    for field in Field::ALL {
        let width = layout.width(field);
        for (index, bytes) in payload[layout.range(field)].chunks(4).enumerate() {
            let word = u32::from_le_bytes(bytes.try_into().unwrap());
            let (t, column) = (index / width, index % width);
            let expected = if field == Field::Clip { t as u32 + 40 } else { mark(field, t, column).to_bits() };
            assert_eq!(word, expected, "{field}[{t}][{column}]");
        }
    }
    assert_eq!(unroll.into_bytes(), payload);
}

#[test]
fn a_cleared_buffer_equals_a_new_one() {
    let layout = layout();
    let mut unroll = UnrollBuffer::new(&layout);
    unroll.row_mut(Field::Task, 1).fill(3.0);
    unroll.row_mut(Field::Std, 0).fill(0.1);
    unroll.set_clip(2, 9);
    unroll.clear();
    assert_eq!(unroll.to_bytes(), UnrollBuffer::new(&layout).to_bytes());
    assert_eq!(unroll.row(Field::Std, 2), [1.0; 4]);
    assert_eq!(unroll.row(Field::LogWeights, 2), [-(2f32.ln()); 2]);
}

proptest! {
    #[test]
    fn any_payload_of_the_right_length_is_unchanged_by_a_round_trip(
        bytes in prop::collection::vec(any::<u8>(), layout().size()),
        offset in 0usize..4,
    ) {
        // Received payloads are not aligned.
        let mut shifted = vec![0; offset];
        shifted.extend(&bytes);
        let unroll = UnrollBuffer::from_payload(&layout(), &shifted[offset..]).unwrap();
        prop_assert_eq!(&unroll.to_bytes()[..], &bytes[..]);
        prop_assert_eq!(&unroll.into_bytes()[..], &bytes[..]);
    }

    #[test]
    fn every_other_length_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..2000)) {
        prop_assume!(bytes.len() != layout().size());
        let found = bytes.len();
        let refused = UnrollBuffer::from_payload(&layout(), &bytes).err();
        prop_assert_eq!(refused, Some(Invalid::Length { found, expected: layout().size() }));
    }
}

#[test]
fn images_are_read_as_they_were_written() {
    let layout = UnrollLayout::new(UnrollShape { image: 8, ..*layout().shape() });
    let mut unroll = UnrollBuffer::new(&layout);
    for t in 0..layout.rows(Field::Image) {
        unroll.image_mut(t).copy_from_slice(&[t as u8, 1, 2, 3, 4, 255, 254, 253]);
    }
    let payload = unroll.into_bytes();
    let images = &payload[layout.range(Field::Image)];
    assert_eq!(images.len(), 4 * 8);
    assert!(images.chunks(8).enumerate().all(|(t, row)| row == [t as u8, 1, 2, 3, 4, 255, 254, 253]));
}
