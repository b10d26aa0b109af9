//! dm_control's named subsets.

use std::collections::BTreeSet;

use comic_clips::{SUBSETS, subset};

#[test]
fn sizes_are_dm_controls() {
    let sizes = SUBSETS.map(|name| subset(name).unwrap().len());
    assert_eq!(
        SUBSETS.into_iter().zip(sizes).collect::<Vec<_>>(),
        [("walk_tiny", 36), ("run_jump_tiny", 50), ("get_up", 7), ("locomotion_small", 316), ("all", 836),]
    );
}

#[test]
fn no_clip_is_named_twice_and_all_contains_the_others() {
    let all: BTreeSet<String> = subset("all").unwrap().into_iter().collect();
    assert_eq!(all.len(), 836);
    for name in SUBSETS {
        let clips = subset(name).unwrap();
        assert!(clips.is_sorted_by(|a, b| a < b), "{name}");
        assert!(clips.iter().all(|clip| all.contains(clip)), "{name}");
    }
}

#[test]
fn get_up_has_these_seven_clips() {
    let expected = ["139_16", "139_17", "139_18", "140_01", "140_02", "140_08", "140_09"].map(|id| format!("CMU_{id}"));
    assert_eq!(subset("get_up").unwrap(), expected);
}

#[test]
fn the_error_of_an_unknown_subset_lists_the_nearest_and_all_names() {
    assert_eq!(
        subset("walk-tiny").unwrap_err().to_string(),
        "no subset `walk-tiny` (did you mean `walk_tiny`?); subsets are walk_tiny, run_jump_tiny, get_up, \
         locomotion_small, all"
    );
}
