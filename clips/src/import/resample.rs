//! From recorded frames to steps: smoothing, then one step per 3.6 frames.

use std::ops::Range;

use crate::spatial::{Quaternion, aligned, normalize};

/// Weights of a frame and its two neighbours on either side.
const BINOMIAL: [f64; 5] = [1.0 / 16.0, 4.0 / 16.0, 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0];
/// Recorded frames per step, as a fraction: 120 Hz × 0.03 s.
const FRAMES_PER_STEP: (usize, usize) = (18, 5);

/// The number of poses in a window of recorded frames, with the first and the last.
pub(super) fn poses(window: &Range<usize>) -> usize {
    window.len().checked_sub(1).map_or(0, |last| FRAMES_PER_STEP.1 * last / FRAMES_PER_STEP.0 + 1)
}

/// Smooths the recorded frames, with the edges repeated, and interpolates linearly: one value per step.
pub(super) fn resample<const N: usize>(frames: &[[f64; N]], window: &Range<usize>) -> Vec<[f64; N]> {
    let smooth = |frame: usize| {
        let mut sum = [0.0; N];
        for (weight, neighbour) in neighbours(frame, frames.len()) {
            sum.iter_mut().zip(frames[neighbour]).for_each(|(sum, part)| *sum += weight * part);
        }
        sum
    };
    steps(window, frames.len())
        .map(|(frame, next, share)| {
            let (a, b) = (smooth(frame), smooth(next));
            std::array::from_fn(|i| (1.0 - share) * a[i] + share * b[i])
        })
        .collect()
}

/// The same for rotations. Before they are added, quaternions get the sign of the middle one; sums are normalised. The
/// result has no change of sign between steps, and begins with w ≥ 0.
pub(super) fn resample_rotations(frames: &[Quaternion], window: &Range<usize>) -> Vec<Quaternion> {
    let smooth = |frame: usize| {
        let mut sum = [0.0; 4];
        for (weight, neighbour) in neighbours(frame, frames.len()) {
            let near = aligned(frames[neighbour], &frames[frame]);
            sum.iter_mut().zip(near).for_each(|(sum, part)| *sum += weight * part);
        }
        normalize(sum)
    };
    let mut last = [1.0, 0.0, 0.0, 0.0];
    steps(window, frames.len())
        .map(|(frame, next, share)| {
            let a = smooth(frame);
            let b = aligned(smooth(next), &a);
            last = aligned(normalize(std::array::from_fn(|i| (1.0 - share) * a[i] + share * b[i])), &last);
            last
        })
        .collect()
}

/// The frames that smooth `frame`, each with its weight.
fn neighbours(frame: usize, frames: usize) -> impl Iterator<Item = (f64, usize)> {
    BINOMIAL.into_iter().enumerate().map(move |(tap, weight)| (weight, (frame + tap).saturating_sub(2).min(frames - 1)))
}

/// For each step: the recorded frame before it, the frame after it, and its position between the two, 0 to 1.
fn steps(window: &Range<usize>, frames: usize) -> impl Iterator<Item = (usize, usize, f64)> {
    let ((numerator, denominator), start) = (FRAMES_PER_STEP, window.start);
    (0..poses(window)).map(move |step| {
        let frame = start + numerator * step / denominator;
        let share = (numerator * step % denominator) as f64 / denominator as f64;
        (frame, (frame + 1).min(frames - 1), share)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_straight_line_stays_straight() {
        let frames: Vec<[f64; 1]> = (0..40).map(|frame| [f64::from(frame)]).collect();
        let window = 5..35;
        let steps = resample(&frames, &window);
        assert_eq!(steps.len(), poses(&window));
        for (step, [value]) in steps.iter().enumerate() {
            assert!((value - (5.0 + 3.6 * step as f64)).abs() < 1e-12);
        }
    }

    #[test]
    fn the_signs_of_recorded_quaternions_do_not_matter() {
        let turn = |frame: u8| crate::spatial::about(1, f64::from(frame) / 10.0);
        let plain: Vec<_> = (0..40).map(turn).collect();
        let flipped: Vec<_> =
            (0..40).map(|frame| if frame % 3 == 0 { turn(frame).map(|part| -part) } else { turn(frame) }).collect();
        assert_eq!(resample_rotations(&plain, &(0..40)), resample_rotations(&flipped, &(0..40)));
    }
}
