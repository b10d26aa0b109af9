//! Velocities by central differences.

use super::floor::Poses;
use crate::clip::Motion;
use crate::spatial::rotation_between;

/// Adds velocities to poses that are `dt` seconds apart. The motion has one frame fewer than there are poses: the last
/// pose is used only for velocities. The first velocity is a forward difference. The angular velocity is in the root
/// frame, as in MuJoCo.
pub(crate) fn motion(mut poses: Poses, dt: f64) -> Motion {
    let velocity = central(&differences(&poses.position, dt));
    let joints_velocity = central(&differences(&poses.joints, dt));
    let turns: Vec<[f64; 3]> =
        poses.quaternion.windows(2).map(|pair| rotation_between(pair[0], pair[1]).map(|part| part / dt)).collect();
    let angular_velocity = central(&turns);
    poses.position.truncate(velocity.len());
    poses.quaternion.truncate(velocity.len());
    poses.joints.truncate(velocity.len());
    let Poses { position, quaternion, joints } = poses;
    Motion { position, quaternion, joints, velocity, angular_velocity, joints_velocity }
}

/// Forward differences per second.
fn differences<const N: usize>(values: &[[f64; N]], dt: f64) -> Vec<[f64; N]> {
    values.windows(2).map(|pair| std::array::from_fn(|i| (pair[1][i] - pair[0][i]) / dt)).collect()
}

/// The mean of each forward difference and the previous one.
fn central<const N: usize>(forward: &[[f64; N]]) -> Vec<[f64; N]> {
    let means = forward.windows(2).map(|pair| std::array::from_fn(|i| 0.5 * (pair[0][i] + pair[1][i])));
    forward.first().copied().into_iter().chain(means).collect()
}
