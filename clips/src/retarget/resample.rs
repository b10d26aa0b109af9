//! Smooths the frames of a recording, and finds its poses between them.

use super::recorded::RecordedPose;
use crate::spatial::{add, aligned, normalize, scale};

/// Standard deviation of the smoothing, s: that of the import's five weights at 120 Hz, which is one frame.
const SMOOTHING: f64 = 1.0 / 120.0;
/// Least standard deviation of the smoothing, frames. It leaves a frame 92 % of its weight.
const LEAST_SMOOTHING: f64 = 0.4;

/// The number of poses that are `dt` seconds apart within `frames` frames.
pub(super) fn count(frames: usize, frame_seconds: f64, dt: f64) -> usize {
    // Rounding must not cost the last pose.
    frames.checked_sub(1).map_or(0, |last| (last as f64 * frame_seconds / dt + 1e-6).floor() as usize + 1)
}

/// Poses that are `dt` seconds apart, from the first frame on. Only these frames count.
pub(super) fn resample(frames: &[RecordedPose], frame_seconds: f64, dt: f64) -> Vec<RecordedPose> {
    let mut poses: Vec<RecordedPose> = Vec::new();
    for step in 0..count(frames.len(), frame_seconds, dt) {
        let weights = weights(step as f64 * dt / frame_seconds, frame_seconds, frames.len());
        poses.push(mean(frames, &weights, poses.last()));
    }
    poses
}

/// The weights of the frames around the place `at`, in frames: Catmull-Rom interpolation of smoothed frames. Frames
/// beyond the ends are the first and the last one.
fn weights(at: f64, frame_seconds: f64, frames: usize) -> Vec<(usize, f64)> {
    let deviation = (SMOOTHING / frame_seconds).max(LEAST_SMOOTHING);
    let reach = (3.0 * deviation).ceil() as i64;
    let bell = |offset: i64| (-0.5 * (offset as f64 / deviation).powi(2)).exp();
    let total: f64 = (-reach..=reach).map(bell).sum();
    let (whole, t) = (at.floor(), at - at.floor());
    let spline = [
        -0.5 * t * (1.0 - t).powi(2),
        1.0 + t * t * (1.5 * t - 2.5),
        t * (0.5 + 2.0 * t - 1.5 * t * t),
        -0.5 * t * t * (1.0 - t),
    ];
    let last = frames.saturating_sub(1) as i64;
    let mut weights: Vec<(usize, f64)> = Vec::new();
    for offset in -reach - 1..=reach + 2 {
        let weight: f64 = (-1..)
            .zip(spline)
            .map(|(knot, part)| if (offset - knot).abs() <= reach { part * bell(offset - knot) / total } else { 0.0 })
            .sum();
        let frame = (whole as i64 + offset).clamp(0, last) as usize;
        weights.push((frame, weight));
    }
    weights
}

/// The weighted mean of frames. Before rotations are added, they get the sign of the middle one, and that one the sign
/// of the previous mean.
fn mean(frames: &[RecordedPose], weights: &[(usize, f64)], previous: Option<&RecordedPose>) -> RecordedPose {
    let mut position = [0.0; 3];
    for (frame, weight) in weights {
        position = add(position, scale(*weight, frames[*frame].position));
    }
    let middle = &frames[weights.get(weights.len() / 2).map_or(0, |(frame, _)| *frame)];
    let rotation = |bone: usize| {
        let own = middle.rotations[bone];
        let own = previous.map_or(own, |previous| aligned(own, &previous.rotations[bone]));
        let mut sum = [0.0; 4];
        for (frame, weight) in weights {
            let near = aligned(frames[*frame].rotations[bone], &own);
            sum.iter_mut().zip(near).for_each(|(sum, part)| *sum += weight * part);
        }
        normalize(sum)
    };
    RecordedPose { position, rotations: (0..middle.rotations.len()).map(rotation).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolation_keeps_a_straight_line_at_any_rate() {
        for (rate, at) in [(120.0, 43.6), (30.0, 40.25), (60.0, 41.0), (240.0, 50.9)] {
            let weights = weights(at, 1.0 / rate, 100);
            let sum: f64 = weights.iter().map(|(_, weight)| weight).sum();
            let place: f64 = weights.iter().map(|(frame, weight)| weight * *frame as f64).sum();
            assert!((sum - 1.0).abs() < 1e-12 && (place - at).abs() < 1e-9, "{rate}: {sum}, {place}");
        }
    }

    #[test]
    fn the_last_frame_counts_if_it_is_a_whole_number_of_steps_away() {
        assert_eq!(count(19, 1.0 / 120.0, 0.03), 6);
        assert_eq!(count(11, 0.03, 0.03), 11);
        assert_eq!([count(0, 0.01, 0.03), count(1, 0.01, 0.03)], [0, 1]);
    }
}
