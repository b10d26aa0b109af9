//! What of a pose the task compares, by forward kinematics.

use comic_clips::{Features, Motion};

use crate::physics::Data;
use crate::quaternion::{difference, into_frame};
use crate::walker::Walker;

/// Puts the humanoid into frame `index` of `motion`, kinematics only.
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

/// rradius, lradius, rfoot, lfoot, head relative to the root, m, in the root's frame.
pub(crate) fn appendages(walker: &Walker, data: &Data) -> [f64; 15] {
    let (positions, root) = (data.xpos(), walker.root);
    let rotation = &data.xmat()[root];
    let mut all = [0.0; 15];
    for (place, body) in all.as_chunks_mut::<3>().0.iter_mut().zip(walker.appendages) {
        *place = into_frame(rotation, difference(&positions[body], &positions[root]));
    }
    all
}
