//! dm_control's named subsets of the CMU clips.

use comic_experiment::SUBSETS;

use crate::error::Error;
use crate::nearest::hint;

const TEXT: &str = include_str!("../data/subsets.txt");

/// The names of the clips of a subset, sorted. The subsets have 36, 50, 7, 316 and 836 clips (dm_control 1.0.49,
/// `locomotion/tasks/reference_pose/cmu_subsets.py`).
///
/// # Errors
/// [`Error::NoSuchSubset`] if the name is not in [`SUBSETS`].
pub fn subset(name: &str) -> Result<Vec<String>, Error> {
    if !SUBSETS.contains(&name) {
        return Err(Error::NoSuchSubset { name: name.into(), hint: hint(name, SUBSETS), known: SUBSETS.join(", ") });
    }
    let mut ids: Vec<String> = TEXT
        .lines()
        .filter(|line| !line.starts_with('#'))
        .skip_while(|line| *line != name)
        .skip(1)
        .take_while(|line| line.starts_with(' '))
        .flat_map(|line| {
            let mut words = line.split_whitespace();
            let subject = words.next().unwrap_or_default();
            words.map(move |take| format!("CMU_{subject}_{take}"))
        })
        .collect();
    ids.sort_unstable();
    Ok(ids)
}

/// The subsets that contain the clip with this name, in the order of [`SUBSETS`].
pub fn subsets_with(name: &str) -> Vec<&'static str> {
    SUBSETS.into_iter().filter(|set| subset(set).is_ok_and(|ids| ids.iter().any(|id| id == name))).collect()
}
