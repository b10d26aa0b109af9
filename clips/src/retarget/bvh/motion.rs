//! The second part of a BVH file: the frames.

use super::hierarchy::{Channel, Joint};
use super::text::Text;
use crate::error::Error;
use crate::spatial::{IDENTITY, Quaternion, Vector, about, multiply};

/// Greatest number of frames, as for recordings of CMU.
const MOST_FRAMES: usize = 360_000;
/// Greatest number of rotations, joints times frames: 640 MB. An hour of 50 joints at 100 Hz has 18 million.
const MOST_ROTATIONS: usize = 20_000_000;
/// Least and greatest time between frames, s. A greater number is often a rate in Hz.
const FRAME_SECONDS: std::ops::RangeInclusive<f64> = 1e-4..=1.0;

/// The frames, with the places of joints that have position channels.
#[derive(Debug)]
pub(super) struct Motion {
    pub(super) frame_seconds: f64,
    /// For each frame the rotation of each joint in its parent's frame.
    pub(super) rotations: Vec<Vec<Quaternion>>,
    /// For each joint its origin in its parent's frame, frame by frame; empty if it has no position channels.
    pub(super) places: Vec<Vec<Vector>>,
}

/// Reads from the line after MOTION to the end.
pub(super) fn read(text: &mut Text, joints: &[Joint]) -> Result<Motion, Error> {
    let count = frame_count(text, joints.len())?;
    let frame_seconds = frame_time(text)?;
    let channels: usize = joints.iter().map(|joint| joint.channels.len()).sum();
    let mut motion = Motion { frame_seconds, rotations: Vec::new(), places: vec![Vec::new(); joints.len()] };
    while let Some(line) = text.next_line()? {
        if motion.rotations.len() == count {
            let more = format!("Frames: {count}, but the file has more frames; correct the number, or cut the file");
            return Err(text.error(more));
        }
        let numbers = line.split_whitespace().map(|word| text.number(word)).collect::<Result<Vec<f64>, Error>>()?;
        if numbers.len() != channels {
            let frame = motion.rotations.len();
            return Err(text.error(format!(
                "frame {frame} has {} numbers, but the hierarchy has {channels} channels: is the file complete?",
                numbers.len()
            )));
        }
        motion.take(joints, &numbers);
    }
    let read = motion.rotations.len();
    if read < count {
        return Err(text.error(format!(
            "Frames: {count}, but the file has {read}: is it complete? If it is, write Frames: {read}"
        )));
    }
    Ok(motion)
}

impl Motion {
    /// Adds a frame. There is a number for each channel.
    fn take(&mut self, joints: &[Joint], numbers: &[f64]) {
        let mut numbers = numbers.iter().copied();
        let mut rotations = Vec::with_capacity(joints.len());
        for (joint, places) in joints.iter().zip(&mut self.places) {
            let (mut place, mut rotation, mut placed) = (joint.offset, IDENTITY, false);
            for (channel, number) in joint.channels.iter().zip(&mut numbers) {
                match *channel {
                    Channel::Position(axis) => (place[axis], placed) = (number, true),
                    // The first angle of a frame is that of the outermost rotation.
                    Channel::Rotation(axis) => rotation = multiply(rotation, about(axis, number.to_radians())),
                }
            }
            rotations.push(rotation);
            if placed {
                places.push(place);
            }
        }
        self.rotations.push(rotations);
    }
}

/// Reads the line `Frames: N`.
fn frame_count(text: &mut Text, joints: usize) -> Result<usize, Error> {
    let value = field(text, "frames")?;
    let Ok(count) = value.parse::<usize>() else {
        return Err(text.error(format!("Frames: `{value}`: expected a number of frames")));
    };
    let most = MOST_FRAMES.min(MOST_ROTATIONS / joints.max(1));
    match count {
        0 => Err(text.error("Frames: 0: the file has no motion")),
        count if count > most => Err(text.error(format!("Frames: {count}: expected at most {most}; cut the file"))),
        count => Ok(count),
    }
}

/// Reads the line `Frame Time: SECONDS`.
fn frame_time(text: &mut Text) -> Result<f64, Error> {
    let value = field(text, "frame time")?;
    match value.parse::<f64>() {
        Ok(seconds) if FRAME_SECONDS.contains(&seconds) => Ok(seconds),
        _ => Err(text.error(format!(
            "Frame Time: {value}: expected seconds from {} to {}; write 0.008333 for 120 frames a second",
            FRAME_SECONDS.start(),
            FRAME_SECONDS.end()
        ))),
    }
}

/// The text after `key:` in the next line.
fn field(text: &mut Text, key: &str) -> Result<String, Error> {
    let line = text.next_line()?.unwrap_or_default();
    let found = line.split_once(':').filter(|(name, _)| {
        let words: Vec<&str> = name.split_whitespace().collect();
        words.join(" ").eq_ignore_ascii_case(key)
    });
    match found {
        Some((_, value)) => Ok(value.trim().into()),
        None => {
            Err(text
                .error(format!("expected `{key}:` and a number; MOTION, `Frames:` and `Frame Time:` begin the frames")))
        }
    }
}
