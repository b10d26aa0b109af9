//! Makes a limb go from one posture to another where inverse kinematics jumps between them.
//!
//! Near the limits of its joints a limb can have two postures that fit almost equally well. From one step to the next the
//! better one may change.

use std::ops::Range;

use super::ik::Pose;
use crate::body::joint;

/// A joint that moves further in a step jumps, rad. At 30 ms a step this is 33 rad/s. The fastest joint of 24 recordings of
/// the CMU database has 27 rad/s.
const JUMP: f64 = 1.0;
/// Steps on either side of a jump over which the limb goes from one posture to the other: 0.24 s in all.
const REACH: usize = 4;

/// The limbs, each with its joints. The trunk is one of them.
const LIMBS: [(&str, Range<usize>); 5] = [
    ("left leg", joint("lfemurrz")..joint("rfemurrz")),
    ("right leg", joint("rfemurrz")..joint("lowerbackrz")),
    ("trunk", joint("lowerbackrz")..joint("lclaviclerz")),
    ("left arm", joint("lclaviclerz")..joint("rclaviclerz")),
    ("right arm", joint("rclaviclerz")..joint("rthumbrx") + 1),
];

/// A jump that was bridged.
pub(super) struct Bridge {
    pub(super) limb: &'static str,
    /// The step after which the limb jumped.
    pub(super) step: usize,
}

/// Interpolates the angles of a limb around its jumps. The angles stay in their ranges, because these are intervals.
pub(super) fn bridge(poses: &mut [Pose]) -> Vec<Bridge> {
    let mut bridges = Vec::new();
    for (limb, joints) in LIMBS {
        for span in spans(&jumps(poses, &joints), poses.len()) {
            bridges.push(Bridge { limb, step: span.start.midpoint(span.end) });
            let [first, last] = [span.start, span.end].map(|step| poses[step].joints);
            for step in span.clone() {
                let share = (step - span.start) as f64 / span.len() as f64;
                for joint in joints.clone() {
                    let (from, to) = (first[joint], last[joint]);
                    // Rounding must not leave the range of a joint that is at its limit.
                    poses[step].joints[joint] = (from + share * (to - from)).clamp(from.min(to), from.max(to));
                }
            }
        }
    }
    bridges
}

/// The steps after which a joint of the limb jumps.
fn jumps(poses: &[Pose], joints: &Range<usize>) -> Vec<usize> {
    let jumps =
        |pair: &[Pose]| joints.clone().any(|joint| (pair[1].joints[joint] - pair[0].joints[joint]).abs() > JUMP);
    poses.windows(2).enumerate().filter(|(_, pair)| jumps(pair)).map(|(step, _)| step).collect()
}

/// The steps from before a jump to after it, whose ends keep their postures. Jumps that are near each other are in one.
fn spans(jumps: &[usize], steps: usize) -> Vec<Range<usize>> {
    let mut spans: Vec<Range<usize>> = Vec::new();
    for jump in jumps {
        let span = (jump + 1).saturating_sub(REACH)..(jump + REACH).min(steps - 1);
        match spans.last_mut() {
            Some(last) if span.start <= last.end => last.end = span.end,
            _ => spans.push(span),
        }
    }
    spans
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spatial::IDENTITY;

    const ELBOW: usize = joint("rradiusrx");
    const KNEE: usize = joint("ltibiarx");

    /// Poses in which one joint has these angles, and the left knee turns steadily.
    fn poses(angles: &[f64]) -> Vec<Pose> {
        let pose = |(step, angle): (usize, &f64)| {
            let mut joints = [0.0; 56];
            joints[ELBOW] = *angle;
            joints[KNEE] = 0.1 * step as f64;
            Pose { position: [0.0; 3], quaternion: IDENTITY, joints }
        };
        angles.iter().enumerate().map(pose).collect()
    }

    fn elbow(poses: &[Pose]) -> Vec<f64> {
        poses.iter().map(|pose| pose.joints[ELBOW]).collect()
    }

    #[test]
    fn a_limb_that_jumps_goes_over_in_a_quarter_of_a_second_and_the_rest_stays() {
        let mut bridged = poses(&[[0.0; 10], [2.0; 10]].concat());
        let bridges = bridge(&mut bridged);
        assert_eq!(bridges.iter().map(|bridge| (bridge.limb, bridge.step)).collect::<Vec<_>>(), [("right arm", 9)]);
        let angles = elbow(&bridged);
        let steps: Vec<f64> = angles.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(steps.iter().all(|step| (-1e-12..=2.0 / 7.0 + 1e-12).contains(step)), "{angles:?}");
        assert_eq!((angles[6], angles[13]), (0.0, 2.0));
        assert!(bridged.iter().enumerate().all(|(step, pose)| pose.joints[KNEE] == 0.1 * step as f64));
    }

    #[test]
    fn jumps_that_are_near_each_other_are_bridged_together() {
        let mut bridged = poses(&[[0.0; 6].as_slice(), &[2.0; 2], &[0.0; 6]].concat());
        assert_eq!(bridge(&mut bridged).len(), 1);
        assert!(elbow(&bridged).iter().all(|angle| *angle == 0.0), "there and back within a moment is no motion");
    }

    #[test]
    fn a_jump_at_an_end_of_the_clip_is_bridged() {
        for angles in [[2.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 2.0]] {
            let mut bridged = poses(&angles);
            assert_eq!(bridge(&mut bridged).len(), 1);
            assert!(elbow(&bridged).windows(2).all(|pair| (pair[1] - pair[0]).abs() < JUMP));
        }
    }

    #[test]
    fn what_does_not_jump_is_not_changed() {
        for angles in [vec![0.0], vec![0.0, 0.9, 1.8, 0.9]] {
            let mut bridged = poses(&angles);
            assert!(bridge(&mut bridged).is_empty());
            assert_eq!(elbow(&bridged), angles);
        }
    }
}
