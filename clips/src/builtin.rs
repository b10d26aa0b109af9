//! Clips without a file: recorded human motion, compiled into the program, and `stand`, which is computed here.

use std::sync::OnceLock;

use crate::clip::{Clip, Motion};
use crate::error::Error;
use crate::humanoid::{JOINT_RANGES, JOINTS, WalkerModel};
use crate::nearest::hint;

/// Format: `data/make_builtin.py`; provenance: `data/README.md`, `data/builtin.json`.
const BYTES: &[u8] = include_bytes!("../data/builtin.bin");
/// The terms of the built-in recordings and of what is made of them; NOTICE has them, too.
pub const BUILTIN_TERMS: &str = "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with \
    funding from NSF EIA-0196217. CMU's terms: \"This data is free for use in research projects. You may include this data in \
    commercially-sold products, but you may not resell this data directly, even in converted form. If you publish results \
    obtained using this data, we would appreciate it if you would send the citation to your published paper to \
    jkh+mocap@cs.cmu.edu, and also would add this text to your acknowledgments section: The data used in this project was \
    obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.\"";
const MAGIC: &[u8; 8] = b"COMICLIP";
const VERSION: u32 = 1;
const HEADER: usize = 32;
/// Numbers per frame: position 3, quaternion 4, joints 56, and their velocities 3, 3, 56.
const NUMBERS: usize = 125;

/// Short names, and the clip that each one means.
const ALIASES: [(&str, &str); 9] = [
    ("walk", "CMU_007_01"),
    ("brisk-walk", "CMU_002_02"),
    ("slow-walk", "CMU_007_04"),
    ("run", "CMU_002_03"),
    ("jog", "CMU_013_31"),
    ("jump", "CMU_013_39"),
    ("vertical-jump", "CMU_002_04"),
    ("squat", "CMU_013_30"),
    ("turn", "CMU_086_09_a"),
];
const STAND: &str = "stand";

/// Control time step of dm_control for the CMU clips, s.
const DT: f64 = 0.03;
/// Frames of `stand`: 3.6 s.
const STAND_STEPS: usize = 120;

/// One recorded clip inside [`BYTES`].
struct Stored {
    name: &'static str,
    dt: f64,
    steps: usize,
    data: &'static [u8],
}

/// The names that can follow `builtin:`: `stand`, the aliases, and the recorded clips' own names.
pub fn builtin_names() -> Vec<&'static str> {
    let aliases = ALIASES.into_iter().map(|(alias, _)| alias);
    std::iter::once(STAND).chain(aliases).chain(stored().iter().map(|clip| clip.name)).collect()
}

/// For a name or an alias: the clip's own name, its number of frames, and its time step in s.
pub(crate) fn describe(name: &str) -> Result<(&'static str, usize, f64), Error> {
    if name == STAND {
        return Ok((STAND, STAND_STEPS, DT));
    }
    let clip = find(name)?;
    Ok((clip.name, clip.steps, clip.dt))
}

/// Reads or computes the clip with this name or alias.
pub(crate) fn load(name: &str) -> Result<Clip, Error> {
    let (name, dt, motion) = if name == STAND {
        (STAND, DT, stand())
    } else {
        let clip = find(name)?;
        (clip.name, clip.dt, clip.motion())
    };
    Ok(Clip { name: name.into(), made_from: None, model: WalkerModel::Cmu2020, dt, motion, features: None })
}

fn find(name: &str) -> Result<&'static Stored, Error> {
    let own = ALIASES.iter().find(|(alias, _)| *alias == name).map_or(name, |(_, own)| own);
    stored().iter().find(|clip| clip.name == own).ok_or_else(|| {
        let names = builtin_names();
        Error::NoSuchBuiltin { name: name.into(), hint: hint(name, names.iter().copied()), known: names.join(", ") }
    })
}

fn stored() -> &'static [Stored] {
    static STORED: OnceLock<Vec<Stored>> = OnceLock::new();
    // The bytes are part of the program, and a test reads all of them, so they cannot be damaged here.
    STORED.get_or_init(|| parse(BYTES).unwrap_or_default())
}

fn parse(bytes: &'static [u8]) -> Option<Vec<Stored>> {
    let rest = bytes.strip_prefix(MAGIC)?;
    let (version, rest) = rest.split_first_chunk::<4>()?;
    let (clips, rest) = rest.split_first_chunk::<4>()?;
    if u32::from_le_bytes(*version) != VERSION {
        return None;
    }
    let (headers, mut data) = rest.split_at_checked(u32::from_le_bytes(*clips) as usize * HEADER)?;
    headers
        .chunks_exact(HEADER)
        .map(|header| {
            let name = header.get(..16)?.split(|byte| *byte == 0).next()?;
            let dt = f64::from_le_bytes(header.get(16..24)?.try_into().ok()?);
            let steps = u32::from_le_bytes(header.get(24..28)?.try_into().ok()?) as usize;
            let (own, rest) = data.split_at_checked(steps * NUMBERS * size_of::<f64>())?;
            data = rest;
            Some(Stored { name: std::str::from_utf8(name).ok()?, dt, steps, data: own })
        })
        .collect()
}

impl Stored {
    fn motion(&self) -> Motion {
        let mut data = self.data;
        Motion {
            position: frames(&mut data, self.steps),
            quaternion: frames(&mut data, self.steps),
            joints: frames(&mut data, self.steps),
            velocity: frames(&mut data, self.steps),
            angular_velocity: frames(&mut data, self.steps),
            joints_velocity: frames(&mut data, self.steps),
        }
    }
}

/// Removes a `[steps, N]` array from the front of `data`.
fn frames<const N: usize>(data: &mut &[u8], steps: usize) -> Vec<[f64; N]> {
    let (own, rest) = data.split_at(steps * N * size_of::<f64>());
    *data = rest;
    let number = |bytes: &[u8]| bytes.try_into().map_or(f64::NAN, f64::from_le_bytes);
    own.chunks_exact(N * size_of::<f64>())
        .map(|frame| std::array::from_fn(|i| number(&frame[i * 8..i * 8 + 8])))
        .collect()
}

/// Standing still with lowered arms.
///
/// dm_control's own upright pose is a T-pose that leans 8.7° forwards on its toes, with the heels 8 cm above the floor.
/// No policy can track it. In this pose both soles are flat. The root leans 4° forwards, so the centre of mass is above
/// the middle of the feet: 0.041 m in front of the root, where the soles reach from −0.05 to 0.18 m. The upper arms
/// hang 60° below horizontal (`rhumerusrz` ends at −1.1 rad). The lowest point is 1.6 mm above the floor, as in
/// dm_control's pose. The numbers were found with the compiled V2020 model. All other angles are 0, or the nearest
/// angle in their range.
fn stand() -> Motion {
    const HEIGHT: f64 = 1.081;
    const LEAN_DEGREES: f64 = 4.0;
    const ANGLES: [(&str, f64); 4] =
        [("lhumerusrz", 1.05), ("rhumerusrz", -1.05), ("lfootrx", -0.2983), ("rfootrx", -0.2983)];

    let mut joints = [0.0; 56];
    for ((angle, name), [low, high]) in joints.iter_mut().zip(JOINTS).zip(JOINT_RANGES) {
        let wanted = ANGLES.iter().find(|(joint, _)| *joint == name).map_or(0.0, |(_, angle)| *angle);
        *angle = f64::clamp(wanted, low, high);
    }
    // Upright is (1, 1, 1, 1)/2: the root's y axis points up. The lean is a rotation about the world's y axis.
    let (sin, cos) = (LEAN_DEGREES.to_radians() / 2.0).sin_cos();
    let (less, more) = ((cos - sin) / 2.0, (cos + sin) / 2.0);
    Motion {
        position: vec![[0.0, 0.0, HEIGHT]; STAND_STEPS],
        quaternion: vec![[less, more, more, less]; STAND_STEPS],
        joints: vec![joints; STAND_STEPS],
        velocity: vec![[0.0; 3]; STAND_STEPS],
        angular_velocity: vec![[0.0; 3]; STAND_STEPS],
        joints_velocity: vec![[0.0; 56]; STAND_STEPS],
    }
}
