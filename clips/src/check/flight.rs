//! Flights: nothing touches the floor, so gravity alone moves the centre of mass.

use super::defect::{
    AIRBORNE, Defect, GRAVITY, HIGHEST_JUMP, IMPOSSIBLE, Kind, LEAST_FALL, LONGEST_FLIGHT, MOST_FALL, SHORTEST_FLIGHT,
};
use super::pose::{Pose, ranges};
use super::tally::Stretches;

/// Adds the flights that no body can have. `dt` is the time step, s. A flight has at most one defect.
pub(super) fn flights(poses: &[Option<Pose>], dt: f64, defects: &mut Vec<Defect>) {
    let (mut floating, mut falls, mut jumps) = (Stretches::default(), Stretches::default(), Stretches::default());
    let untouched = untouched(poses);
    for range in ranges(poses, |_, pose| pose.lowest > AIRBORNE) {
        let Some(flight) = Flight::of(poses, range.start, &poses[range.clone()], dt) else { continue };
        let Flight { seconds, height, rise, acceleration } = flight;
        // In g, downwards.
        let fall = acceleration.map(|acceleration| -acceleration / GRAVITY);
        if let Some(fall) = fall.filter(|fall| *fall < LEAST_FALL) {
            floating.add(range, height, |frames| {
                if let Some(text) = &untouched {
                    return text.clone();
                }
                // Adding 0 makes 0 of -0.
                let acceleration = (-10.0 * GRAVITY * fall).round() / 10.0 + 0.0;
                format!(
                    "{IMPOSSIBLE}: no force holds the body up in {frames}. It is up to {height:.3} m above the floor, \
                     and its vertical acceleration is {acceleration:.1} m/s² instead of -9.8"
                )
            });
        } else if let Some(fall) = fall.filter(|fall| *fall > MOST_FALL) {
            falls.add(range, GRAVITY * fall, |frames| {
                format!("{IMPOSSIBLE}: in {frames} the body falls with {fall:.2} g, faster than gravity")
            });
        } else if rise > HIGHEST_JUMP {
            jumps.add(range, rise, |frames| {
                format!(
                    "{IMPOSSIBLE}: the jump in {frames} is too high. The centre of mass rises by {rise:.2} m; \
                     {HIGHEST_JUMP} m is the limit"
                )
            });
        } else if seconds > LONGEST_FLIGHT {
            floating.add(range, height, |frames| {
                if let Some(text) = &untouched {
                    return text.clone();
                }
                format!(
                    "{IMPOSSIBLE}: the body is up to {height:.3} m above the floor for {seconds:.2} s, in {frames}; \
                     {LONGEST_FLIGHT} s is the limit"
                )
            });
        }
    }
    defects.extend(floating.defect(Kind::Floating, "root"));
    defects.extend(falls.defect(Kind::Fall, "root"));
    defects.extend(jumps.defect(Kind::JumpHeight, "root"));
}

/// What to say of a clip that floats and is in the air in all frames: most likely, its floor is wrong. `None` if a frame
/// is on the floor.
fn untouched(poses: &[Option<Pose>]) -> Option<String> {
    let lowest = poses.iter().flatten().map(|pose| pose.lowest).fold(f64::INFINITY, f64::min);
    (lowest > AIRBORNE).then(|| {
        format!(
            "{IMPOSSIBLE}: the clip never touches the floor; lower the clip by {lowest:.3} m, or import it with another \
             --floor"
        )
    })
}

struct Flight {
    seconds: f64,
    /// Greatest height of the lowest point, m.
    height: f64,
    /// Height that the centre of mass gains after the last frame on the floor, m.
    rise: f64,
    /// Vertical acceleration of the centre of mass, m/s²; `None` for a flight that is too short to tell.
    acceleration: Option<f64>,
}

impl Flight {
    /// `frames` are the frames from `first` on.
    fn of(poses: &[Option<Pose>], first: usize, frames: &[Option<Pose>], dt: f64) -> Option<Self> {
        let heights: Vec<f64> = frames.iter().flatten().map(|pose| pose.center[2]).collect();
        let floor = first.checked_sub(1).and_then(|frame| poses[frame].as_ref()).map(|pose| pose.center[2]);
        let start = floor.or_else(|| heights.first().copied())?;
        let seconds = frames.len() as f64 * dt;
        // Several frames make less than their decimal sum.
        let told = seconds > SHORTEST_FLIGHT - 1e-9;
        Some(Self {
            seconds,
            height: frames.iter().flatten().map(|pose| pose.lowest).fold(0.0, f64::max),
            rise: heights.iter().copied().fold(start, f64::max) - start,
            acceleration: if told { acceleration(&heights, dt) } else { None },
        })
    }
}

/// The second derivative of the parabola with the least squared distance from `heights`, `dt` apart. `None` for fewer
/// than three heights.
fn acceleration(heights: &[f64], dt: f64) -> Option<f64> {
    if heights.len() < 3 {
        return None;
    }
    let middle = (heights.len() - 1) as f64 / 2.0;
    let squares: Vec<f64> = (0..heights.len()).map(|index| ((index as f64 - middle) * dt).powi(2)).collect();
    let mean = squares.iter().sum::<f64>() / squares.len() as f64;
    // The times are symmetric about 0, so these weights see neither the mean height nor the mean speed.
    let (mut product, mut norm) = (0.0, 0.0);
    for (height, square) in heights.iter().zip(&squares) {
        product += (square - mean) * height;
        norm += (square - mean).powi(2);
    }
    Some(2.0 * product / norm)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_acceleration_of_a_parabola_is_found_at_any_height_and_speed() {
        for (height, speed, expected) in [(0.0, 0.0, -9.81), (1.3, 2.5, -9.81), (-4.0, -1.0, 0.0), (2.0, 0.5, 3.0)] {
            for frames in [3, 4, 17] {
                let at = |frame: usize| {
                    let time = 0.03 * frame as f64;
                    height + speed * time + expected * time * time / 2.0
                };
                let found = acceleration(&(0..frames).map(at).collect::<Vec<_>>(), 0.03).unwrap();
                assert!((found - expected).abs() < 1e-9, "{found} instead of {expected}");
            }
        }
        assert_eq!(acceleration(&[1.0, 2.0], 0.03), None);
    }
}
