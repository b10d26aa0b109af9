//! Features of a pose, by forward kinematics: what the tracking task compares.

use comic_clips::spatial::{into_frame, subtract};
use comic_clips::{Features, Motion};

use super::walker::Walker;
use crate::physics::Data;

/// Puts the humanoid into frame `index` of `motion`. Only the kinematics are computed.
pub(crate) fn pose(data: &mut Data, motion: &Motion, index: usize) {
    let qpos = data.qpos_mut();
    qpos[..3].copy_from_slice(&motion.position[index]);
    qpos[3..7].copy_from_slice(&motion.quaternion[index]);
    qpos[7..].copy_from_slice(&motion.joints[index]);
    data.kinematics();
    data.com_pos();
}

/// The features of every frame.
pub(crate) fn features(walker: &Walker, data: &mut Data, motion: &Motion) -> Features {
    let mut features = Features::default();
    for index in 0..motion.position.len() {
        pose(data, motion, index);
        let appendages = appendages(walker, data);
        let mut end_effectors = [0.0; 12];
        end_effectors.copy_from_slice(&appendages[..12]);
        features.center_of_mass.push(data.subtree_com()[walker.frame]);
        features.end_effectors.push(end_effectors);
        features.appendages.push(appendages);
        features.body_positions.extend(data.xpos()[walker.tracked.clone()].as_flattened());
        features.body_quaternions.extend(data.xquat()[walker.tracked.clone()].as_flattened());
    }
    features
}

/// Positions of rradius, lradius, rfoot, lfoot, head relative to the root, m, in the root's frame.
pub(crate) fn appendages(walker: &Walker, data: &Data) -> [f64; 15] {
    let (positions, root) = (data.xpos(), walker.root);
    let rotation = &data.xmat()[root];
    let mut all = [0.0; 15];
    for (place, body) in all.as_chunks_mut::<3>().0.iter_mut().zip(walker.appendages) {
        *place = into_frame(rotation, subtract(positions[body], positions[root]));
    }
    all
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use comic_clips::{Catalogue, WalkerModel};
    use comic_experiment::ClipSource;

    use super::*;
    use crate::humanoid;
    use crate::physics::Models;

    fn largest(a: &[f64], b: &[f64]) -> f64 {
        assert_eq!(a.len(), b.len());
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    /// Compares the features in a file with those of its motion, clip by clip.
    fn assert_kinematics_give_the_files_features(path: &Path) {
        let model = humanoid::build(WalkerModel::Cmu2020).unwrap();
        let walker = Walker::new(WalkerModel::Cmu2020, &model).unwrap();
        let mut data = Models::new(model, 6).data();
        let catalogue = Catalogue::open(&[ClipSource::whole(path.to_string_lossy())]).unwrap();
        for index in 0..catalogue.entries().len() {
            let clip = catalogue.load(index).unwrap();
            let found = features(&walker, &mut data, &clip.motion);
            let file = clip.features.unwrap();
            let differences = [
                ("center_of_mass", largest(found.center_of_mass.as_flattened(), file.center_of_mass.as_flattened())),
                ("end_effectors", largest(found.end_effectors.as_flattened(), file.end_effectors.as_flattened())),
                ("appendages", largest(found.appendages.as_flattened(), file.appendages.as_flattened())),
                ("body_positions", largest(&found.body_positions, &file.body_positions)),
                ("body_quaternions", largest(&found.body_quaternions, &file.body_quaternions)),
            ];
            for (name, difference) in differences {
                assert!(difference < 1e-9, "{}: {name} differs by {difference:e}", clip.name);
            }
        }
    }

    #[test]
    fn kinematics_give_the_features_of_the_synthetic_clips() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures/golden/synthetic_v2020.h5");
        assert_kinematics_give_the_files_features(&path);
    }

    #[test]
    fn kinematics_give_the_features_of_the_recorded_clips() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../clips/tests/data/cmu/clips.h5");
        assert_kinematics_give_the_files_features(&path);
    }
}
