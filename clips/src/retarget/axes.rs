//! The axes and the unit of a recording.

use std::fmt;
use std::ops::RangeInclusive;
use std::str::FromStr;

use serde::{Serialize, Serializer};

use crate::spatial::{Quaternion, Vector, about};

/// An axis of a recording's world, with its sign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Axis {
    /// 0, 1 or 2.
    index: usize,
    negative: bool,
}

/// Lengths of a unit that are accepted, m.
pub(super) const UNIT_METERS: RangeInclusive<f64> = 1e-6..=1e3;
/// Units of length in use, with their lengths in m. The last is that of CMU's ASF files: 1 inch divided by 0.45.
const UNITS: [(&str, f64); 5] = [("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("inch", 0.0254), ("CMU", 0.0254 / 0.45)];
/// Length of a leg from hip joint to ankle, m. A stature of 1.73 m has a leg of 0.85 m (Drillis and Contini 1966).
const LEG: f64 = 0.85;

impl Axis {
    pub(super) const Z: Self = Self { index: 2, negative: false };

    /// The axis nearest to a direction.
    pub(super) fn nearest(direction: &Vector) -> Self {
        let [x, y, z] = direction.map(f64::abs);
        let index = if z >= x && z >= y { 2 } else { usize::from(y >= x) };
        Self { index, negative: direction[index] < 0.0 }
    }

    /// A unit vector.
    pub(super) fn direction(self) -> Vector {
        let length = if self.negative { -1.0 } else { 1.0 };
        std::array::from_fn(|index| if index == self.index { length } else { 0.0 })
    }

    /// The rotation that turns this axis to z. It keeps x, except if x is up.
    pub(super) fn to_z(self) -> Quaternion {
        use std::f64::consts::{FRAC_PI_2, PI};
        match (self.index, self.negative) {
            // (x, y, z) → (y, z, x), and (y, −z, −x).
            (0, false) => [0.5, -0.5, -0.5, -0.5],
            (0, true) => [0.5, 0.5, 0.5, -0.5],
            // (x, y, z) → (x, −z, y), and (x, z, −y).
            (1, false) => about(0, FRAC_PI_2),
            (1, true) => about(0, -FRAC_PI_2),
            (_, false) => about(0, 0.0),
            (_, true) => about(0, PI),
        }
    }
}

impl FromStr for Axis {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (negative, name) = match text.strip_prefix('-') {
            Some(name) => (true, name),
            None => (false, text.strip_prefix('+').unwrap_or(text)),
        };
        match ["x", "y", "z"].iter().position(|axis| axis.eq_ignore_ascii_case(name)) {
            Some(index) => Ok(Self { index, negative }),
            None => Err(format!("`{text}` is not an axis: give x, y, z, -x, -y or -z")),
        }
    }
}

impl fmt::Display for Axis {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = ["x", "y", "z"].get(self.index).copied().unwrap_or_default();
        write!(formatter, "{}{name}", if self.negative { "-" } else { "" })
    }
}

impl Serialize for Axis {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// Parses a unit of length: m, cm, mm, inch, CMU (that of the database's ASF files), or its length in m. Returns its
/// length in m.
///
/// # Errors
/// A message for another name, and for a number that is not from 0.000001 to 1000.
pub fn parse_unit(text: &str) -> Result<f64, String> {
    let known = UNITS.iter().find(|(name, _)| name.eq_ignore_ascii_case(text)).map(|(_, meters)| *meters);
    let meters = known.or_else(|| text.parse().ok()).filter(|meters| UNIT_METERS.contains(meters));
    let names = UNITS.map(|(name, _)| name).join(", ");
    meters.ok_or_else(|| format!("give {names}, or the length of the unit in m, like 0.0564"))
}

/// Length of the unit, m, in which a leg of that length is most like a human's.
pub(super) fn find_unit(leg: f64) -> f64 {
    let distance = |meters: f64| (leg * meters / LEG).ln().abs();
    UNITS.iter().map(|(_, meters)| *meters).min_by(|a, b| distance(*a).total_cmp(&distance(*b))).unwrap_or(1.0)
}

/// The name of a unit, or its length in m.
pub(super) fn unit_name(meters: f64) -> String {
    let known = UNITS.iter().find(|(_, own)| (own / meters - 1.0).abs() < 1e-3);
    known.map_or_else(|| format!("{meters} m"), |(name, _)| (*name).into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spatial::{norm, rotated, subtract};

    #[test]
    fn every_axis_is_turned_to_z() {
        for text in ["x", "y", "z", "-x", "-y", "-z"] {
            let axis: Axis = text.parse().unwrap();
            assert_eq!(axis.to_string(), text);
            assert_eq!(Axis::nearest(&axis.direction()), axis);
            let turned = rotated(axis.to_z(), axis.direction());
            assert!(norm(&subtract(turned, [0.0, 0.0, 1.0])) < 1e-12, "{text}: {turned:?}");
        }
        assert!("up".parse::<Axis>().is_err());
    }

    #[test]
    fn a_human_leg_gives_its_unit() {
        for (name, meters) in UNITS {
            for leg in [0.75, 0.85, 0.98] {
                assert_eq!(unit_name(find_unit(leg / meters)), name);
            }
        }
        assert_eq!(unit_name(0.3), "0.3 m");
    }

    #[test]
    fn a_unit_is_a_name_that_the_report_prints_or_a_length() {
        for (name, meters) in UNITS {
            assert_eq!(parse_unit(&unit_name(meters)), Ok(meters), "{name}");
        }
        assert_eq!(parse_unit("0.3"), Ok(0.3));
        for text in ["", "feet", "0", "-1", "NaN", "inf"] {
            let message = parse_unit(text).unwrap_err();
            assert!(message.contains("m, cm, mm, inch, CMU, or the length"), "{text}: {message}");
        }
    }
}
