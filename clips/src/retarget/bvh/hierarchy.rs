//! The first part of a BVH file: the joints, their offsets and their channels.

use super::text::Text;
use crate::error::Error;
use crate::spatial::{Vector, norm};

/// Greatest number of joints. A body with fingers and a face has about 200.
const MOST_JOINTS: usize = 1000;
/// Greatest number of channels of a joint: a position and a rotation.
const MOST_CHANNELS: usize = 6;

/// Greatest length of a joint's name, bytes. Messages have names in them.
const LONGEST_NAME: usize = 200;

/// A number that every frame has for a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Channel {
    /// Along the axis (0, 1, 2), in the file's unit.
    Position(usize),
    /// About the axis (0, 1, 2), in degrees.
    Rotation(usize),
}

/// A joint with its channels.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Joint {
    pub(super) name: String,
    /// `None` for the root.
    pub(super) parent: Option<usize>,
    /// From the parent's origin, in the parent's frame, in the file's unit.
    pub(super) offset: Vector,
    /// The end site: where the bone ends, in its own frame.
    pub(super) end: Option<Vector>,
    /// In the order of the numbers of a frame.
    pub(super) channels: Vec<Channel>,
}

/// What a `{` opens.
#[derive(Clone, Copy)]
enum Block {
    Joint(usize),
    End(usize),
}

#[derive(Default)]
struct Reading {
    joints: Vec<Joint>,
    /// Whether the joint has had its OFFSET.
    placed: Vec<bool>,
    /// The blocks around the current line, the innermost last. A list, so that deep files do not use up the stack.
    open: Vec<Block>,
    /// A block whose `{` has to follow.
    announced: Option<Block>,
}

/// Reads up to the line MOTION. Parents come before their children.
pub(super) fn read(text: &mut Text) -> Result<Vec<Joint>, Error> {
    match text.next_line()? {
        Some(line) if line.eq_ignore_ascii_case("HIERARCHY") => {}
        Some(_) => return Err(text.error("expected HIERARCHY: is this a BVH file?")),
        None => return Err(text.error("the file is empty; a BVH file begins with HIERARCHY")),
    }
    let mut reading = Reading::default();
    while let Some(line) = text.next_line()? {
        // A brace is a statement of its own, also on the line of another one.
        let spaced = line.replace('{', " \n{\n ").replace('}', " \n}\n ");
        for statement in spaced.lines().filter(|statement| !statement.trim().is_empty()) {
            if statement.trim().eq_ignore_ascii_case("MOTION") {
                return reading.finish(text);
            }
            reading.take(text, statement)?;
        }
    }
    Err(text.error("the file ends before MOTION: is it complete?"))
}

impl Reading {
    fn take(&mut self, text: &Text, statement: &str) -> Result<(), Error> {
        let mut words = statement.split_whitespace();
        let keyword = words.next().unwrap_or_default().to_ascii_uppercase();
        let words: Vec<&str> = words.collect();
        if self.announced.is_some() && keyword != "{" {
            return Err(text.error(format!("expected `{{` after {}", self.described(self.announced))));
        }
        match keyword.as_str() {
            "ROOT" if self.joints.is_empty() => self.announce(text, &words, None),
            "ROOT" => Err(text.error(format!(
                "a second ROOT, `{}`: a clip has one person; write each skeleton to a file of its own",
                words.join(" ")
            ))),
            "JOINT" => match self.open.last() {
                Some(&Block::Joint(parent)) => self.announce(text, &words, Some(parent)),
                _ => Err(text.error("JOINT outside of the braces of a ROOT or JOINT")),
            },
            "END" => match self.open.last() {
                Some(&Block::Joint(joint)) => {
                    self.announced = Some(Block::End(joint));
                    Ok(())
                }
                _ => Err(text.error("End Site outside of the braces of a JOINT")),
            },
            "{" => match self.announced.take() {
                Some(block) => {
                    self.open.push(block);
                    Ok(())
                }
                None => Err(text.error("`{` without ROOT, JOINT or End Site before it")),
            },
            "}" => match self.open.pop() {
                Some(Block::Joint(joint)) if self.placed.get(joint) == Some(&false) => {
                    Err(text.error(format!("{} has no OFFSET", self.described(Some(Block::Joint(joint))))))
                }
                Some(_) => Ok(()),
                None => Err(text.error("a `}` more than `{`")),
            },
            "OFFSET" => self.offset(text, &words),
            "CHANNELS" => self.channels(text, &words),
            other => Err(text.error(format!(
                "unknown word `{other}`; a hierarchy has ROOT, JOINT, End Site, OFFSET, CHANNELS, braces, and MOTION after it"
            ))),
        }
    }

    fn announce(&mut self, text: &Text, words: &[&str], parent: Option<usize>) -> Result<(), Error> {
        // Names can have spaces ("Bip01 L Thigh"), and a namespace ("mixamorig:Hips").
        let whole = words.join(" ");
        let name = whole.rsplit([':', '|']).next().unwrap_or_default().trim();
        if name.is_empty() {
            return Err(text.error("a joint without a name"));
        }
        if name.len() > LONGEST_NAME || name.contains(char::is_control) {
            let expected = format!("expected at most {LONGEST_NAME} bytes without control characters");
            return Err(text.error(format!("the name of a joint is too long or cannot be printed: {expected}")));
        }
        if self.joints.len() == MOST_JOINTS {
            return Err(text.error(format!("more than {MOST_JOINTS} joints: export the body without its surface")));
        }
        self.announced = Some(Block::Joint(self.joints.len()));
        self.joints.push(Joint { name: name.into(), parent, offset: [0.0; 3], end: None, channels: Vec::new() });
        self.placed.push(false);
        Ok(())
    }

    fn offset(&mut self, text: &Text, words: &[&str]) -> Result<(), Error> {
        let [x, y, z] = words else {
            return Err(text.error(format!("OFFSET has {} numbers, expected 3", words.len())));
        };
        let place = [text.number(x)?, text.number(y)?, text.number(z)?];
        match self.open.last() {
            Some(&Block::Joint(index)) => {
                if let (Some(joint), Some(placed)) = (self.joints.get_mut(index), self.placed.get_mut(index)) {
                    (joint.offset, *placed) = (place, true);
                }
            }
            Some(&Block::End(index)) => {
                // A length of 0 gives no direction.
                if let Some(joint) = self.joints.get_mut(index).filter(|_| norm(&place) > 0.0) {
                    joint.end.get_or_insert(place);
                }
            }
            None => return Err(text.error("OFFSET outside of the braces of a ROOT or JOINT")),
        }
        Ok(())
    }

    fn channels(&mut self, text: &Text, words: &[&str]) -> Result<(), Error> {
        let Some(&Block::Joint(index)) = self.open.last() else {
            return Err(text.error("CHANNELS outside of the braces of a ROOT or JOINT"));
        };
        let Some(joint) = self.joints.get_mut(index) else { return Ok(()) };
        let Some((count, names)) = words.split_first() else {
            return Err(text.error("CHANNELS without a number"));
        };
        if count.parse() != Ok(names.len()) {
            return Err(text.error(format!("CHANNELS {count}, but {} names follow", names.len())));
        }
        if !joint.channels.is_empty() {
            return Err(text.error(format!("joint `{}` has CHANNELS twice", joint.name)));
        }
        if names.len() > MOST_CHANNELS {
            return Err(
                text.error(format!("more than {MOST_CHANNELS} channels: expected positions and rotations only"))
            );
        }
        for name in names {
            let channel = Channel::parse(name).ok_or_else(|| {
                text.error(format!(
                    "unknown channel `{name}`; expected Xposition, Yposition, Zposition, Xrotation, Yrotation or Zrotation"
                ))
            })?;
            if matches!(channel, Channel::Position(_)) && joint.channels.contains(&channel) {
                return Err(text.error(format!("channel `{name}` occurs twice in joint `{}`", joint.name)));
            }
            joint.channels.push(channel);
        }
        Ok(())
    }

    fn finish(mut self, text: &Text) -> Result<Vec<Joint>, Error> {
        if self.announced.is_some() || !self.open.is_empty() {
            let block = self.announced.or(self.open.last().copied());
            return Err(text.error(format!("MOTION inside of {}: a `}}` is missing", self.described(block))));
        }
        if self.joints.is_empty() {
            return Err(text.error("MOTION without a ROOT before it"));
        }
        let parents: Vec<usize> = self.joints.iter().filter_map(|joint| joint.parent).collect();
        for parent in parents {
            // The children say where the bone goes.
            if let Some(joint) = self.joints.get_mut(parent) {
                joint.end = None;
            }
        }
        Ok(self.joints)
    }

    fn described(&self, block: Option<Block>) -> String {
        let name = |index: usize| self.joints.get(index).map_or("", |joint| joint.name.as_str());
        match block {
            Some(Block::Joint(joint)) => format!("joint `{}`", name(joint)),
            Some(Block::End(joint)) => format!("the End Site of joint `{}`", name(joint)),
            None => "the hierarchy".into(),
        }
    }
}

impl Channel {
    fn parse(name: &str) -> Option<Self> {
        let lower = name.to_ascii_lowercase();
        let axis = ["x", "y", "z"].iter().position(|axis| lower.starts_with(axis))?;
        match lower.get(1..)? {
            "position" => Some(Self::Position(axis)),
            "rotation" => Some(Self::Rotation(axis)),
            _ => None,
        }
    }
}
