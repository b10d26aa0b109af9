//! A received unroll is valid, or it is refused with the reason.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use bytes::Bytes;
use comic_experiment::LARGEST_ACTION_GRADIENT;
use comic_proto::v1::{EpisodeEnd, EpisodeStatistics, UnrollHeader, UnrollMessage};
use comic_proto::{Expected, Field, Invalid, MAX_SEQUENCE, Pieces, UnrollBuffer, UnrollLayout, UnrollShape, validate};
use proptest::prelude::*;
use prost::Message as _;

const EXPECTED: Expected<'_> = Expected { clips: &[3, 1], epoch: 2, newest_version: 9 };

fn layout() -> UnrollLayout {
    UnrollLayout::new(UnrollShape {
        length: 4,
        proprioception: 3,
        task: 2,
        action: 2,
        latent: 2,
        reward_terms: 2,
        image: 0,
        components: 3,
        state: 2,
        action_gradient: 5,
    })
}

fn header() -> UnrollHeader {
    let episode = EpisodeStatistics {
        clip: 1,
        steps: 7,
        steps_left_at_start: 20,
        returns: vec![1.5, 0.25],
        end: EpisodeEnd::Terminated.into(),
        head_height: Some(1.5),
    };
    UnrollHeader {
        actor: 1,
        incarnation: 77,
        sequence: 5,
        learner_epoch: 2,
        version: 9,
        layout_hash: layout().hash().to_vec(),
        episodes: vec![episode],
        environment: 0,
        task: 0,
    }
}

/// A valid unroll: an episode ends in row 1, the next one begins in row 2.
fn unroll() -> UnrollBuffer {
    let mut unroll = UnrollBuffer::new(&layout());
    for t in 0..4 {
        unroll.row_mut(Field::Valid, t)[0] = if t == 1 { 0.0 } else { 1.0 };
        unroll.row_mut(Field::Discount, t)[0] = 1.0;
        unroll.row_mut(Field::First, t)[0] = if t == 2 { 1.0 } else { 0.0 };
    }
    for t in 0..5 {
        unroll.set_clip(t, t as u32 % 3);
    }
    unroll
}

fn refusal(header: &UnrollHeader, unroll: &UnrollBuffer) -> Option<Invalid> {
    validate(&layout(), header, &unroll.to_bytes().into(), &EXPECTED).err()
}

fn header_refusal(change: impl FnOnce(&mut UnrollHeader)) -> Option<Invalid> {
    let mut header = header();
    change(&mut header);
    refusal(&header, &unroll())
}

fn payload_refusal(change: impl FnOnce(&mut UnrollBuffer)) -> Option<Invalid> {
    let mut unroll = unroll();
    change(&mut unroll);
    refusal(&header(), &unroll)
}

#[test]
fn a_valid_unroll_is_accepted() {
    assert_eq!(refusal(&header(), &unroll()), None);
}

#[test]
fn an_unroll_may_begin_in_the_middle_of_an_episode_or_with_its_first_observation() {
    assert_eq!(payload_refusal(|unroll| unroll.row_mut(Field::First, 0)[0] = 1.0), None);
}

#[test]
fn an_unroll_belongs_to_one_task() {
    let second = |episode: u32| {
        let (mut header, mut unroll) = (header(), unroll());
        (0..5).for_each(|t| unroll.set_clip(t, 3));
        header.task = 1;
        header.episodes[0].clip = episode;
        refusal(&header, &unroll)
    };
    assert_eq!(second(3), None, "the only clip of the second task");
    assert!(matches!(second(1), Some(Invalid::Episode { .. })), "an episode of the first task");
    assert_eq!(payload_refusal(|unroll| unroll.set_clip(4, 3)), Some(Invalid::Clip { clip: 3, row: 4, task: 0 }));
    assert_eq!(payload_refusal(|unroll| unroll.set_clip(0, 3)), Some(Invalid::Clip { clip: 3, row: 0, task: 0 }));
    assert_eq!(payload_refusal(|unroll| unroll.set_clip(4, 4)), Some(Invalid::Clip { clip: 4, row: 4, task: 0 }));
}

#[test]
fn a_wrong_task_in_the_header_is_refused() {
    let wrong = |task| {
        header_refusal(|header| {
            header.task = task;
            header.episodes.clear();
        })
    };
    assert_eq!(wrong(1), Some(Invalid::Clip { clip: 0, row: 0, task: 1 }), "the clips belong to task 0");
    for task in [2, u32::MAX] {
        let refusal = wrong(task);
        assert_eq!(refusal, Some(Invalid::Task { task, tasks: 2 }));
        assert!(refusal.unwrap().to_string().contains(&format!("task {task}, but the experiment has 2 tasks")));
    }
}

#[test]
fn padding_repeats_the_previous_observation_and_is_valid() {
    let mut unroll = unroll();
    unroll.row_mut(Field::Proprioception, 2).fill(0.25);
    unroll.row_mut(Field::Valid, 2)[0] = 0.0;
    for t in 3..5 {
        unroll.repeat_observation(t);
        assert_eq!(unroll.row(Field::Proprioception, t), [0.25; 3]);
        assert_eq!((unroll.row(Field::First, t), unroll.clip(t)), ([1.0].as_slice(), unroll.clip(2)));
    }
    unroll.row_mut(Field::Valid, 3)[0] = 0.0;
    assert_eq!(refusal(&header(), &unroll), None);
}

#[test]
fn another_layout_is_refused() {
    assert_eq!(header_refusal(|header| header.layout_hash[3] ^= 1), Some(Invalid::LayoutHash));
    assert_eq!(header_refusal(|header| header.layout_hash.clear()), Some(Invalid::LayoutHash));
}

#[test]
fn future_epochs_and_versions_are_refused_and_past_ones_are_valid() {
    assert_eq!(header_refusal(|header| header.learner_epoch = 3), Some(Invalid::Epoch { found: 3, newest: 2 }));
    assert_eq!(header_refusal(|header| header.version = 10), Some(Invalid::Version { found: 10, newest: 9 }));
    assert_eq!(header_refusal(|header| header.version = 0), None);
    assert_eq!(
        header_refusal(|header| (header.learner_epoch, header.version) = (1, 1000)),
        None,
        "versions of another epoch are not compared"
    );
}

#[test]
fn a_sequence_number_that_no_actor_can_have_reached_is_refused() {
    assert_eq!(header_refusal(|header| header.sequence = MAX_SEQUENCE - 1), None);
    assert_eq!(
        header_refusal(|header| header.sequence = MAX_SEQUENCE),
        Some(Invalid::Sequence { sequence: MAX_SEQUENCE })
    );
}

#[test]
fn episode_statistics_are_limited_in_number_and_checked() {
    let episode = |change: fn(&mut EpisodeStatistics)| header_refusal(|header| change(&mut header.episodes[0]));
    assert_eq!(
        header_refusal(|header| header.episodes = vec![header.episodes[0].clone(); 6]),
        Some(Invalid::Episodes { found: 6, limit: 5 })
    );
    for broken in [
        episode(|episode| episode.clip = 4),
        episode(|episode| episode.steps = 0),
        episode(|episode| episode.steps_left_at_start = 0),
        episode(|episode| episode.returns.truncate(1)),
        episode(|episode| episode.returns[1] = f32::NAN),
        episode(|episode| episode.head_height = Some(f32::NAN)),
        episode(|episode| episode.head_height = Some(f32::INFINITY)),
        episode(|episode| episode.end = 0),
        episode(|episode| episode.end = 99),
    ] {
        assert!(matches!(broken, Some(Invalid::Episode { .. })), "{broken:?}");
    }
}

#[test]
fn numbers_that_are_not_finite_are_refused_in_every_field() {
    for field in Field::ALL.into_iter().filter(|field| !matches!(field, Field::Clip | Field::Image)) {
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let row = layout().rows(field) - 1;
            let refused = payload_refusal(|unroll| *unroll.row_mut(field, row).last_mut().unwrap() = value);
            assert_eq!(refused, Some(Invalid::NotFinite { field, row }));
        }
    }
}

#[test]
fn numbers_outside_the_range_of_their_field_are_refused() {
    let cases = [
        (Field::Std, 0.0),
        (Field::Std, -1.0),
        (Field::Discount, 1.5),
        (Field::Valid, 0.5),
        (Field::First, 2.0),
        (Field::ActionGradient, 1.1 * LARGEST_ACTION_GRADIENT),
    ];
    for (name, number) in cases {
        let refused = payload_refusal(|unroll| unroll.row_mut(name, 3)[0] = number);
        let expected = matches!(
            refused,
            Some(Invalid::Range { field, row: 3, value, .. }) if field == name && value == number
        );
        assert!(expected, "{name} = {number}: {refused:?}");
    }
}

#[test]
fn the_weights_of_a_mixture_must_add_up_to_one() {
    let weights = |weights: [f32; 3]| {
        payload_refusal(|unroll| unroll.row_mut(Field::LogWeights, 2).copy_from_slice(&weights.map(f32::ln)))
    };
    assert_eq!(weights([0.2, 0.3, 0.5]), None);
    assert!(matches!(weights([0.2, 0.3, 0.6]), Some(Invalid::Weights { row: 2, .. })));
    // A weight of 0 has no finite logarithm, but a weight that float32 rounds to 0 has one.
    assert_eq!(
        payload_refusal(|unroll| unroll.row_mut(Field::LogWeights, 0).copy_from_slice(&[0.0, -200.0, -1e5])),
        None
    );
}

#[test]
fn an_episode_must_begin_exactly_after_a_row_without_a_transition() {
    assert_eq!(payload_refusal(|unroll| unroll.row_mut(Field::First, 2)[0] = 0.0), Some(Invalid::Boundary { row: 1 }));
    assert_eq!(payload_refusal(|unroll| unroll.row_mut(Field::First, 4)[0] = 1.0), Some(Invalid::Boundary { row: 3 }));
}

#[test]
fn a_clip_that_the_task_does_not_have_is_refused_also_if_its_bits_are_nan() {
    let refused = |clip| payload_refusal(|unroll| unroll.set_clip(4, clip));
    assert_eq!(refused(4), Some(Invalid::Clip { clip: 4, row: 4, task: 0 }));
    assert_eq!(refused(u32::MAX), Some(Invalid::Clip { clip: u32::MAX, row: 4, task: 0 }));
}

proptest! {
    #[test]
    fn random_bytes_do_not_panic(
        payload in prop::collection::vec(any::<u8>(), 0..600),
        hash in prop::collection::vec(any::<u8>(), 0..40),
        message in prop::collection::vec(any::<u8>(), 0..300),
    ) {
        let mut header = header();
        let payload = Pieces::from(Bytes::from(payload));
        let _ = validate(&layout(), &header, &payload, &EXPECTED);
        header.layout_hash = hash;
        let _ = validate(&layout(), &header, &payload, &EXPECTED);
        if let Ok(UnrollMessage { header: Some(header), payload }) = UnrollMessage::decode(&message[..]) {
            let _ = validate(&layout(), &header, &payload.into(), &EXPECTED);
        }
    }

    #[test]
    fn an_unroll_with_a_flipped_bit_is_accepted_only_if_the_number_is_valid(
        place in 0..layout().size(),
        bit in 0u8..8,
    ) {
        let mut payload = unroll().to_bytes().to_vec();
        payload[place] ^= 1 << bit;
        if validate(&layout(), &header(), &Bytes::from(payload.clone()).into(), &EXPECTED).is_ok() {
            let unroll = UnrollBuffer::from_payload(&layout(), &payload).unwrap();
            for field in Field::ALL.into_iter().filter(|field| !matches!(field, Field::Clip | Field::Image)) {
                for t in 0..layout().rows(field) {
                    prop_assert!(unroll.row(field, t).iter().all(|value| value.is_finite()));
                }
            }
            prop_assert!((0..5).all(|t| unroll.clip(t) < 4));
            prop_assert!((0..4).all(|t| unroll.row(Field::Std, t).iter().all(|std| *std > 0.0)));
        }
    }

    #[test]
    fn a_payload_in_pieces_is_validated_like_one_piece(
        place in 0..layout().size(),
        bit in 0u8..8,
        words in prop::collection::vec((0..layout().size() / 4, prop_oneof![Just(f32::NAN), Just(2.0), Just(0.0)]), 0..3),
        cuts in prop::collection::vec(0..layout().size(), 0..4),
    ) {
        let mut payload = unroll().to_bytes().to_vec();
        for (word, value) in words {
            payload[4 * word..4 * word + 4].copy_from_slice(&value.to_le_bytes());
        }
        payload[place] ^= 1 << bit;
        let whole = Bytes::from(payload);
        let mut cuts = [cuts, vec![0, layout().size()]].concat();
        cuts.sort_unstable();
        let pieces: Pieces = cuts.windows(2).map(|cut| whole.slice(cut[0]..cut[1])).collect();
        let judge = |pieces: &Pieces| format!("{:?}", validate(&layout(), &header(), pieces, &EXPECTED));
        prop_assert_eq!(judge(&pieces), judge(&whole.into()));
    }

    #[test]
    fn every_length_except_the_layouts_is_refused(length in 0usize..2000) {
        prop_assume!(length != layout().size());
        let refused = validate(&layout(), &header(), &Bytes::from(vec![0; length]).into(), &EXPECTED).err();
        prop_assert_eq!(refused, Some(Invalid::Length { found: length, expected: layout().size() }));
    }
}
