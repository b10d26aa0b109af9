//! What an import may be told, and what it took.

use std::fmt;
use std::ops::Range;
use std::path::PathBuf;
use std::str::FromStr;

use crate::error::Error;

/// A recording and what its clip shall be.
#[derive(Clone, Debug, PartialEq)]
pub struct Take {
    /// The clip's name.
    pub name: String,
    /// The subject's skeleton.
    pub asf: PathBuf,
    /// The recording.
    pub amc: PathBuf,
    /// What is known of it.
    pub constants: Constants,
}

/// The constants of an import; what is `None` is found from the recording.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Constants {
    /// The motion's size: V2020's leg over the subject's unless given.
    pub scale: Option<f64>,
    /// Degrees to take off the left and the right ankle (positive: toes up), because the body's soles are inclined in
    /// their feet; the median pitch of soles that stand unless given.
    pub sole_degrees: Option<[f64; 2]>,
    /// Where the floor is; found unless given.
    pub floor: Option<Floor>,
    /// m/rad: how much arms keep their recorded angles rather than elbow and wrist where their range is left; 0.2
    /// unless given.
    pub arm_regularisation: Option<f64>,
    /// The recorded frames to take, from 0, the end not included; all unless given.
    pub frames: Option<Range<usize>>,
}

/// How a recording's floor is told from the body's lowest points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Floor {
    /// It drifts: this percentile over `half` steps (0.03 s each) to either side, then the mean over `smooth`.
    Sliding {
        /// 0 to 100.
        percent: f64,
        /// Steps.
        half: usize,
        /// Steps.
        smooth: usize,
    },
    /// It is level: this percentile of all steps.
    Constant {
        /// 0 to 100.
        percent: f64,
    },
}

/// What an import took, given or found.
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
    /// What a person should look at.
    pub notes: Vec<String>,
}

impl Floor {
    /// For walks and runs; CMU's early subjects walk on a floor that drifts by up to 8 cm.
    pub const DRIFTING: Self = Self::Sliding { percent: 50.0, half: 12, smooth: 8 };
    /// For jumps.
    pub const LEVEL: Self = Self::Constant { percent: 30.0 };

    /// That the percentile is one, and the windows are no longer than any clip.
    fn check(self) -> Option<Self> {
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
            format!("`{text}` is no floor: give sliding:PERCENTILE:HALF:SMOOTH, like sliding:50:12:8, or const:PERCENTILE, like const:30")
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
    /// That every number makes sense.
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
    /// As options of the command line.
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
    fn a_floor_is_written_as_it_is_read() {
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
