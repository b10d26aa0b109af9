//! The layout: fields are contiguous, and the hash depends on every dimension.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use comic_experiment::{Experiment, LowLevelName, TaskSpec, Tracking};
use comic_proto::{Field, UnrollLayout, UnrollShape};
use proptest::prelude::*;

fn shape() -> impl Strategy<Value = UnrollShape> {
    (1usize..40, 1usize..300, 1usize..1200, 1usize..60, 0usize..70, 1usize..8, 1usize..7, 0usize..90).prop_map(
        |(length, proprioception, task, action, latent, reward_terms, components, state)| UnrollShape {
            length,
            proprioception,
            task,
            action,
            latent,
            reward_terms,
            image: 0,
            components,
            state,
            action_gradient: action,
        },
    )
}

#[test]
fn the_shapes_of_the_papers_unroll_follow_from_experiment_and_task() {
    let experiment = Experiment::default();
    let spec = TaskSpec::tracking(&Tracking::default(), vec!["walk".into()]).unwrap();
    let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
    let dimensions = |field| (layout.rows(field), layout.width(field));
    assert_eq!(dimensions(Field::Proprioception), (33, 205));
    assert_eq!(dimensions(Field::Task), (33, spec.task));
    assert_eq!(dimensions(Field::PreviousLatent), (32, 60));
    assert_eq!(dimensions(Field::LatentNoise), (32, 60));
    assert_eq!([Field::Action, Field::Mean, Field::Std].map(dimensions), [(32, 56); 3]);
    assert_eq!([Field::LogWeights, Field::State].map(|field| layout.elements(field)), [0, 0]);
    assert_eq!(dimensions(Field::Reward), (32, 5));
    assert_eq!([Field::Discount, Field::Valid].map(dimensions), [(32, 1); 2]);
    assert_eq!([Field::First, Field::Clip].map(dimensions), [(33, 1); 2]);
}

#[test]
fn the_hash_is_the_same_on_every_machine_and_in_every_build() {
    let shape = UnrollShape {
        length: 2,
        proprioception: 3,
        task: 4,
        action: 5,
        latent: 6,
        reward_terms: 7,
        image: 0,
        components: 3,
        state: 9,
        action_gradient: 0,
    };
    let hash = hex::encode(UnrollLayout::new(shape).hash());
    assert_eq!(hash, "cb53603309f4c91140ca1e6101c03680e15cd78f883a6498a824aa6419d255ec");
}

#[test]
fn a_mixture_adds_its_components_and_an_lstm_its_recurrent_state() {
    let spec = TaskSpec { action: 56, ..TaskSpec::default() };
    let mut experiment = Experiment::default();
    experiment.network.low_level = LowLevelName::Mixture;
    let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
    assert_eq!([Field::Mean, Field::Std].map(|field| layout.width(field)), [5 * 56; 2]);
    assert_eq!([Field::Action, Field::LogWeights, Field::State].map(|field| layout.width(field)), [56, 5, 0]);
    experiment.network.low_level = LowLevelName::Lstm;
    let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
    // Hidden state and cell state of 384 and 256 units.
    assert_eq!((layout.rows(Field::State), layout.width(Field::State)), (1, 2 * (384 + 256)));
    assert_eq!([Field::Mean, Field::LogWeights].map(|field| layout.width(field)), [56, 0]);
}

proptest! {
    #[test]
    fn fields_are_contiguous_without_gaps(shape in shape()) {
        let layout = UnrollLayout::new(shape);
        let mut end = 0;
        for field in Field::ALL {
            let range = layout.range(field);
            prop_assert_eq!(range.start, end);
            prop_assert_eq!(range.len(), layout.rows(field) * layout.width(field) * 4);
            prop_assert_eq!(range.len(), layout.elements(field) * 4);
            end = range.end;
        }
        prop_assert_eq!(layout.size(), end);
        prop_assert!(layout.message_limit() > layout.size());
    }

    #[test]
    fn the_hash_changes_with_any_dimension(shape in shape(), which in 0usize..8, more in 1usize..50) {
        let mut other = shape;
        *[
            &mut other.length,
            &mut other.proprioception,
            &mut other.task,
            &mut other.action,
            &mut other.latent,
            &mut other.reward_terms,
            &mut other.components,
            &mut other.state,
        ].into_iter().nth(which).unwrap() += more;
        prop_assert_ne!(UnrollLayout::new(shape).hash(), UnrollLayout::new(other).hash());
        prop_assert_eq!(UnrollLayout::new(shape).hash(), UnrollLayout::new(shape).hash());
    }

    #[test]
    fn huge_dimensions_do_not_overflow(length in any::<usize>(), width in any::<usize>()) {
        let shape = UnrollShape {
            length, proprioception: width, task: width, action: width, latent: width, reward_terms: width, image: 0, components: width,
            state: width,
            action_gradient: width,
        };
        let layout = UnrollLayout::new(shape);
        prop_assert!(layout.message_limit() >= layout.size());
    }
}

#[test]
fn images_are_bytes_and_keep_every_row_aligned() {
    let mut spec = TaskSpec { image: 64 * 64 * 3, ..TaskSpec::default() };
    let experiment = Experiment::default();
    let layout = UnrollLayout::new(UnrollShape::new(&spec, &experiment));
    assert_eq!((layout.rows(Field::Image), layout.width(Field::Image)), (33, 12_288));
    assert_eq!(layout.range(Field::Image).len(), 33 * 12_288);
    assert_eq!(layout.size(), layout.range(Field::Image).end);
    spec.image = 10;
    assert_eq!(UnrollLayout::new(UnrollShape::new(&spec, &experiment)).width(Field::Image), 12);
}
