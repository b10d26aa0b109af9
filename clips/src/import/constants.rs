//! The inputs of an import, and the constants that it used.

use std::fmt;
use std::ops::Range;
use std::path::PathBuf;
use std::str::FromStr;

use crate::error::Error;

/// A recording ("take" in motion capture) and the constants of its import.
#[derive(Clone, Debug, PartialEq)]
pub struct Take {
    /// The clip's name.
    pub name: String,
    /// The skeleton of the subject.
    pub asf: PathBuf,
    /// The recorded angles.
    pub amc: PathBuf,
    /// Its constants, as far as they are known.
    pub constants: Constants,
}

/// The constants of an import. A constant that is `None` is found from the recording.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Constants {
    /// Factor for all lengths. Default: V2020's leg divided by the subject's leg.
    pub scale: Option<f64>,
    /// Degrees to subtract from the left and the right ankle (positive: toes up), because the body's soles are inclined
    /// relative to their feet. Default: the median pitch of the soles of standing feet.
    pub sole_degrees: Option<[f64; 2]>,
    /// The model of the floor. Default: found from the heights of the body.
    pub floor: Option<Floor>,
    /// For arms outside their ranges: weight of the recorded angles against the positions of elbow and wrist, m/rad.
    /// Default: 0.2.
    pub arm_regularisation: Option<f64>,
    /// The recorded frames to import, counted from 0, without the end. Default: all.
    pub frames: Option<Range<usize>>,
}

/// How the height of a recording's floor follows from the body's lowest points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Floor {
    /// The floor drifts: the percentile over `half` steps (0.03 s each) to either side, then the mean over `smooth`
    /// steps to either side.
    Sliding {
        /// The percentile, 0 to 100.
        percent: f64,
        /// Steps.
        half: usize,
        /// Steps.
        smooth: usize,
    },
    /// The floor is level: the percentile over all steps.
    Constant {
        /// The percentile, 0 to 100.
        percent: f64,
    },
}

/// The constants that an import used, given or found.
#[derive(Clone, Debug, PartialEq)]
pub struct UsedConstants {
    /// See [`Constants::scale`].
    pub scale: f64,
    /// See [`Constants::sole_degrees`].
    pub sole_degrees: [f64; 2],
    /// See [`Constants::floor`].
    pub floor: Floor,
    /// See [`Constants::arm_regularisation`].
    pub arm_regularisation: f64,
    /// See [`Constants::frames`].
    pub frames: Range<usize>,
    /// Remarks about the recording that a person should check.
    pub notes: Vec<String>,
}

impl Floor {
    /// For walks and runs. In the recordings of CMU's early subjects the floor drifts by up to 8 cm.
    pub const DRIFTING: Self = Self::Sliding { percent: 50.0, half: 12, smooth: 8 };
    /// For jumps.
    pub const LEVEL: Self = Self::Constant { percent: 30.0 };

    /// Checks the percentile, and that no window is longer than 10,000 steps.
    pub(crate) fn check(self) -> Option<Self> {
        let (percent, longest) = match self {
            Self::Sliding { percent, half, smooth } => (percent, half.max(smooth)),
            Self::Constant { percent } => (percent, 0),
        };
        ((0.0..=100.0).contains(&percent) && longest <= 10_000).then_some(self)
    }
}

impl FromStr for Floor {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts: Vec<&str> = text.split(':').collect();
        let floor = match parts[..] {
            ["sliding", percent, half, smooth] => (|| {
                let (half, smooth) = (half.parse().ok()?, smooth.parse().ok()?);
                Some(Self::Sliding { percent: percent.parse().ok()?, half, smooth })
            })(),
            ["const", percent] => percent.parse().ok().map(|percent| Self::Constant { percent }),
            _ => None,
        };
        floor.and_then(Self::check).ok_or_else(|| {
            format!("`{text}` is not a floor: give sliding:PERCENTILE:HALF:SMOOTH, for example sliding:50:12:8, or const:PERCENTILE, for example const:30")
        })
    }
}

impl fmt::Display for Floor {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sliding { percent, half, smooth } => write!(formatter, "sliding:{percent}:{half}:{smooth}"),
            Self::Constant { percent } => write!(formatter, "const:{percent}"),
        }
    }
}

impl Constants {
    /// Checks that every number is within its bounds.
    pub(super) fn check(&self) -> Result<(), Error> {
        let refuse = |what: &'static str, value: f64, expected: &'static str| {
            Err(Error::Constant { what, value: value.to_string(), expected })
        };
        if let Some(scale) = self.scale
            && !(0.01..=100.0).contains(&scale)
        {
            return refuse("scale", scale, "a number from 0.01 to 100");
        }
        if let Some(degrees) =
            self.sole_degrees.and_then(|both| both.into_iter().find(|one| !(-90.0..=90.0).contains(one)))
        {
            return refuse("sole pitch", degrees, "degrees from -90 to 90");
        }
        if let Some(weight) = self.arm_regularisation
            && !(0.01..=100.0).contains(&weight)
        {
            return refuse("arm regularisation", weight, "m/rad, from 0.01 to 100");
        }
        if let Some(floor) = self.floor
            && floor.check().is_none()
        {
            return Err(Error::Constant {
                what: "floor",
                value: floor.to_string(),
                expected: "a percentile from 0 to 100",
            });
        }
        Ok(())
    }
}

impl fmt::Display for UsedConstants {
    /// Writes the constants as options of the command line.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { scale, sole_degrees: [left, right], floor, arm_regularisation, frames, .. } = self;
        write!(
            formatter,
            "--scale {scale} --sole-deg {left} {right} --floor {floor} --arm-reg {arm_regularisation} --frames {}..{}",
            frames.start, frames.end
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_floor_is_written_in_the_form_that_is_read() {
        for text in ["sliding:50:12:8", "const:30", "const:12.5"] {
            assert_eq!(text.parse::<Floor>().unwrap().to_string(), text);
        }
        for text in
            ["", "flat", "const:", "const:101", "const:nan", "sliding:50", "sliding:50:-1:8", "sliding:50:99999999:1"]
        {
            assert!(text.parse::<Floor>().is_err(), "{text}");
        }
    }
}
