//! The frames of a clip in use, its start frames, and the clips that a task refuses.

mod support;

use comic_clips::{Catalogue, Entry, WalkerModel::*};
use comic_experiment::ClipSource;
use proptest::prelude::*;
use support::{golden, recordings, with_ids};

fn entry(steps: usize, start_step: usize, end_step: Option<usize>) -> Entry {
    let (name, made_from) = ("walk".into(), None);
    Entry { name, made_from, steps, dt: 0.03, model: Cmu2020, start_step, end_step, weight: 1.0 }
}

#[test]
fn a_whole_clip_loses_look_ahead_and_min_steps_at_its_end() {
    let whole = entry(87, 0, None);
    assert_eq!(whole.frames(), 0..87);
    // dm_control: the last 5 + 10 frames are no starts.
    assert_eq!(whole.starts(5, 10), 0..72);
}

#[test]
fn an_explicit_end_is_inclusive_for_frames_and_exclusive_for_starts() {
    let part = entry(87, 10, Some(40));
    assert_eq!(part.frames(), 10..41);
    assert_eq!(part.starts(5, 10), 10..25);
    assert_eq!(entry(87, 10, Some(86)).frames(), 10..87);
    assert_eq!(entry(87, 10, Some(87)).frames(), 10..87);
}

#[test]
fn a_2019_clip_on_the_2020_body_is_refused() {
    let clip = Entry { model: Cmu2019, ..entry(87, 0, None) };
    assert_eq!(
        clip.check(Cmu2020, 0.03, 5, 10).unwrap_err().to_string(),
        "clip `walk` was made for the CMU humanoid V2019 (30 bodies), not for the CMU humanoid V2020 (31 bodies); use \
         clips of that body"
    );
    clip.check(Cmu2019, 0.03, 5, 10).unwrap();
}

#[test]
fn another_time_step_is_refused() {
    let clip = entry(87, 0, None);
    clip.check(Cmu2020, 0.03 + 1e-10, 5, 10).unwrap();
    assert_eq!(
        clip.check(Cmu2020, 0.05, 5, 10).unwrap_err().to_string(),
        "clip `walk` has dt = 0.03 s, expected 0.05 s; a control step is one frame, so all clips of an experiment \
         have the same dt"
    );
    assert!(clip.check(Cmu2020, f64::NAN, 5, 10).is_err());
}

#[test]
fn a_clip_too_short_for_its_look_ahead_is_refused() {
    entry(16, 0, None).check(Cmu2020, 0.03, 5, 10).unwrap();
    assert_eq!(
        entry(15, 0, None).check(Cmu2020, 0.03, 5, 10).unwrap_err().to_string(),
        "clip `walk` is too short: frames 0 to 14 are 15 frames, but 10 steps that look 5 frames ahead need 16; lower \
         tracking.reference_steps or tracking.min_steps, or remove the clip"
    );
    entry(87, 10, Some(26)).check(Cmu2020, 0.03, 5, 10).unwrap();
    assert!(entry(87, 10, Some(25)).check(Cmu2020, 0.03, 5, 10).is_err());
    assert!(entry(87, 0, None).check(Cmu2020, 0.03, usize::MAX, usize::MAX).is_err());
}

#[test]
fn a_sub_range_of_a_file_is_checked_like_any_other() {
    let source = ClipSource { start_step: 80, ..with_ids(recordings("clips.h5"), &["CMU_007_01"]) };
    let catalogue = Catalogue::open(&[source]).unwrap();
    let message = catalogue.entries()[0].check(Cmu2020, 0.03, 5, 10).unwrap_err().to_string();
    assert!(message.contains("frames 80 to 86 are 7 frames"), "{message}");
}

#[test]
fn starts_and_frames_equal_dm_controls() {
    let text = std::fs::read_to_string(golden("start_sampling.json")).unwrap();
    let golden: serde_json::Value = serde_json::from_str(&text).unwrap();
    let number = |value: &serde_json::Value| value.as_u64().unwrap() as usize;
    let entries: Vec<Entry> = (0..4)
        .map(|clip| entry(120, number(&golden["start_steps"][clip]), Some(number(&golden["end_steps"][clip]))))
        .collect();
    for (clip, entry) in entries.iter().enumerate() {
        let [first, last] = [0, 1].map(|end| number(&golden["first_last_per_clip"][clip][end]));
        assert_eq!(entry.starts(5, 10), first..last + 1, "clip {clip}");
    }
    for draw in golden["draws"].as_array().unwrap() {
        assert_eq!(entries[number(&draw[0])].frames().len(), number(&draw[3]), "{draw}");
    }
}

proptest! {
    #![proptest_config(support::law())]

    /// From any start, `min_steps` steps with their references stay inside the frames.
    #[test]
    fn references_never_run_past_the_frames(
        steps in 1..300_usize,
        start in 0..300_usize,
        length in proptest::option::of(1..300_usize),
        look_ahead in 1..40_usize,
        min_steps in 1..40_usize,
    ) {
        let start = start % steps;
        let end = length.map(|length| (start + length).min(steps));
        let entry = entry(steps, start, end);
        let (frames, starts) = (entry.frames(), entry.starts(look_ahead, min_steps));
        prop_assert!(frames.start == start && frames.end <= steps && !frames.is_empty());
        for start in starts.clone() {
            prop_assert!(frames.contains(&(start + min_steps + look_ahead - 1)));
        }
        prop_assert_eq!(entry.check(Cmu2020, 0.03, look_ahead, min_steps).is_ok(), !starts.is_empty());
    }
}
