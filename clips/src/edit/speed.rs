//! The same motion, faster or slower.

use std::ops::RangeInclusive;

use super::{FEWEST, check, named, origin};
use crate::clip::{Clip, Features, Motion};
use crate::error::Error;
use crate::humanoid::JOINT_RANGES;
use crate::spatial::{
    Quaternion, Vector, about_vector, add, cross, multiply, norm, normalize, rotation_between, scale, subtract,
};

/// Allowed factors, in per cent.
pub const SPEEDS: RangeInclusive<usize> = 50..=200;

/// The motion of a clip at `factor` times its speed, `NAME_x80` for 0.8. The time step stays, so T frames become ⌊(T −
/// 1) / factor⌋ + 1. Gravity does not change with the speed: flights become impossible where the factor is far from 1.
///
/// Positions and joint angles are interpolated by cubic Hermite polynomials through the stored values and velocities,
/// and the root's orientation likewise, by its rotation vector from one frame to the next. Velocities are the
/// derivatives of the same curves, times the factor. At whole frames all of that is the stored numbers.
/// Between them soles can be 5 mm lower than in the recording.
///
/// # Errors
/// [`Error::Constant`] for a factor outside 0.5 to 2 or between two per cents; [`Error::WrongModel`] for another body
/// than V2020; [`Error::Edit`] for fewer than two frames, before or after, numbers that are not finite, and a name that
/// is too long.
pub fn speed(clip: &Clip, factor: f64) -> Result<Clip, Error> {
    let percent = percent(factor)?;
    check(clip)?;
    let name = named(format!("{}_x{percent}", clip.name), &[clip])?;
    let last = clip.steps() - 1;
    let steps = 100 * last / percent + 1;
    if steps < FEWEST {
        let reason = format!("has {} frames, too few for {factor} times its speed", clip.steps());
        return Err(Error::Edit { name: clip.name.clone(), reason });
    }
    let factor = percent as f64 / 100.0;
    let mut motion = Motion::default();
    for step in 0..steps {
        // Whole numbers keep a share of 0 exact.
        let (frame, share) = (step * percent / 100, (step * percent % 100) as f64 / 100.0);
        push(&mut motion, &clip.motion, [frame, (frame + 1).min(last)], share, clip.dt);
    }
    let faster = |velocity: &mut f64| *velocity *= factor;
    motion.velocity.as_flattened_mut().iter_mut().for_each(faster);
    motion.angular_velocity.as_flattened_mut().iter_mut().for_each(faster);
    motion.joints_velocity.as_flattened_mut().iter_mut().for_each(faster);
    let features = Some(Features::of(&motion));
    let made_from = Some(format!("speed {factor} {}", origin(clip)));
    Ok(Clip { name, made_from, model: clip.model, dt: clip.dt, motion, features })
}

fn percent(factor: f64) -> Result<usize, Error> {
    let percent = (100.0 * factor).round();
    // A cast of NaN is 0, which is not allowed.
    if SPEEDS.contains(&(percent as usize)) && (100.0 * factor - percent).abs() < 1e-6 {
        return Ok(percent as usize);
    }
    Err(Error::Constant { what: "factor", value: factor.to_string(), expected: "0.5 to 2, with at most two decimals" })
}

/// Adds the state between two frames that are `dt` apart, `share` of the way from the first to the second.
fn push(motion: &mut Motion, from: &Motion, [a, b]: [usize; 2], share: f64, dt: f64) {
    let (position, velocity) =
        hermite([&from.position[a], &from.position[b]], [&from.velocity[a], &from.velocity[b]], share, dt);
    motion.position.push(position);
    motion.velocity.push(velocity);

    let ends = [&from.joints[a], &from.joints[b]];
    let (mut joints, velocity) = hermite(ends, [&from.joints_velocity[a], &from.joints_velocity[b]], share, dt);
    for (joint, angle) in joints.iter_mut().enumerate() {
        // The polynomial may leave the range between two angles in it.
        let ([low, high], [first, second]) = (JOINT_RANGES[joint], ends.map(|angles| angles[joint]));
        *angle = angle.max(low.min(first).min(second)).min(high.max(first).max(second));
    }
    motion.joints.push(joints);
    motion.joints_velocity.push(velocity);

    let ends = [from.quaternion[a], from.quaternion[b]];
    let (quaternion, velocity) = turn(ends, [from.angular_velocity[a], from.angular_velocity[b]], share, dt);
    motion.quaternion.push(quaternion);
    motion.angular_velocity.push(velocity);
}

/// Value and derivative of the cubic polynomial with these values and derivatives at its two ends, `dt` apart.
fn hermite<const N: usize>(
    [x0, x1]: [&[f64; N]; 2],
    [v0, v1]: [&[f64; N]; 2],
    s: f64,
    dt: f64,
) -> ([f64; N], [f64; N]) {
    let (s2, s3) = (s * s, s * s * s);
    let far = 3.0 * s2 - 2.0 * s3;
    let value =
        std::array::from_fn(|i| x0[i] + far * (x1[i] - x0[i]) + dt * ((s3 - 2.0 * s2 + s) * v0[i] + (s3 - s2) * v1[i]));
    let slope = std::array::from_fn(|i| {
        6.0 * (s - s2) * (x1[i] - x0[i]) / dt + (3.0 * s2 - 4.0 * s + 1.0) * v0[i] + (3.0 * s2 - 2.0 * s) * v1[i]
    });
    (value, slope)
}

/// The same for an orientation and its angular velocity, rad/s, in the frame that turns.
fn turn([q0, q1]: [Quaternion; 2], [w0, w1]: [Vector; 2], share: f64, dt: f64) -> (Quaternion, Vector) {
    if share == 0.0 {
        return (q0, w0);
    }
    let whole = rotation_between(q0, q1);
    let (vector, slope) = hermite([&[0.0; 3], &whole], [&w0, &slope_of(whole, w1)], share, dt);
    let angle = norm(&vector);
    let axis = if angle > 0.0 { scale(1.0 / angle, vector) } else { [0.0; 3] };
    (normalize(multiply(q0, about_vector(axis, angle))), velocity_of(vector, slope))
}

/// The angular velocity, in the frame that turns, of a rotation vector with this slope: J slope, with J = 1 − ½ V + ⅙ V²
/// (the right Jacobian of SO(3) to second order; V is the cross product with the vector). A frame turns by far less than
/// 1 rad.
fn velocity_of(vector: Vector, slope: Vector) -> Vector {
    let once = cross(vector, slope);
    add(subtract(slope, scale(0.5, once)), scale(1.0 / 6.0, cross(vector, once)))
}

/// The inverse of [`velocity_of`]: 1 + ½ V + 1/12 V².
fn slope_of(vector: Vector, velocity: Vector) -> Vector {
    let once = cross(vector, velocity);
    add(add(velocity, scale(0.5, once)), scale(1.0 / 12.0, cross(vector, once)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spatial::half_angle_between;

    #[test]
    fn factors_are_per_cents_from_half_to_double() {
        assert_eq!([0.5, 0.8, 1.0, 1.15, 2.0].map(|factor| percent(factor).unwrap_or(0)), [50, 80, 100, 115, 200]);
        for factor in [0.0, -1.0, 0.494, 2.01, 0.805, f64::NAN, f64::INFINITY] {
            assert!(percent(factor).is_err(), "{factor}");
        }
    }

    #[test]
    fn a_steady_turn_stays_steady() {
        let velocity = [1.0, -2.0, 3.0];
        let dt = 0.03;
        let at = |seconds: f64| about_vector(scale(1.0 / norm(&velocity), velocity), norm(&velocity) * seconds);
        let (middle, turning) = turn([at(0.0), at(dt)], [velocity; 2], 0.3, dt);
        assert!(half_angle_between(middle, at(0.3 * dt)) < 1e-7);
        assert!(norm(&subtract(turning, velocity)) < 1e-9);
    }
}
