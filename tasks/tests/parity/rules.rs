//! Compares replays of go-to-target and of the corridors with recorded rollouts.

use std::ops::Range;
use std::path::Path;

use comic_tasks::Step;
use comic_tasks::comparison::{Block, Replay, replay_corridor, replay_go_to_target};
use serde::Deserialize;

use crate::recording::Rollout;

/// A recorded geom of an arena. The fields that are not listed follow from the arena's kind.
#[derive(Deserialize)]
struct Geom {
    name: String,
    body: String,
    pos: [f64; 3],
    size: [f64; 3],
    rgba: [f32; 4],
}

/// Compares every number of every row of a go-to-target rollout.
pub(crate) fn compare_go_to_target(rollout: &Rollout) -> Result<(), String> {
    compare(rollout, &mut go_to_target(rollout)?)
}

/// A replay of a go-to-target rollout.
pub(crate) fn go_to_target(rollout: &Rollout) -> Result<Replay, String> {
    let targets = targets(rollout)?;
    let spawn = <[f64; 2]>::try_from(rollout.array("spawn")?.numbers()?).map_err(|_| fail(rollout, "spawn"))?;
    let rotation = *rollout.array("rotation")?.numbers()?.first().ok_or_else(|| fail(rollout, "rotation"))?;
    replay_go_to_target(spawn, rotation, &targets).map_err(|error| error.to_string())
}

/// The places of the target in their order.
fn targets(rollout: &Rollout) -> Result<Vec<[f64; 2]>, String> {
    let recorded = rollout.array("target")?;
    let mut places: Vec<[f64; 2]> = Vec::new();
    for row in 0..rollout.rows() {
        let [x, y, z] = recorded.row(row)? else { return Err(fail(rollout, "target")) };
        if *z != 0.0 {
            return Err(fail(rollout, "target"));
        }
        if places.last() != Some(&[*x, *y]) {
            places.push([*x, *y]);
        }
    }
    Ok(places)
}

/// Compares every number of every row of a corridor's rollout, in the arena recorded beside it.
pub(crate) fn compare_corridor(rollout: &Rollout) -> Result<(), String> {
    let stem = rollout.file.strip_suffix("_rollout").unwrap_or(&rollout.file);
    let RecordedArena { length, width, platforms, walls } =
        RecordedArena::read(&rollout.folder.join(format!("{stem}_arena.json")))?;
    let mut replay = replay_corridor(length, width, &platforms, &walls).map_err(|error| error.to_string())?;
    compare(rollout, &mut replay)
}

/// A recorded corridor.
pub(crate) struct RecordedArena {
    /// m.
    pub(crate) length: f64,
    /// m.
    pub(crate) width: f64,
    pub(crate) platforms: Vec<Block>,
    pub(crate) walls: Vec<Block>,
}

impl RecordedArena {
    pub(crate) fn read(path: &Path) -> Result<Self, String> {
        let fail = |error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
        let text = std::fs::read_to_string(path).map_err(|error| fail(&error))?;
        let geoms: Vec<Geom> = serde_json::from_str(&text).map_err(|error| fail(&error))?;
        let ground = geoms.first().ok_or_else(|| fail(&"no geoms"))?;
        let block = |geom: &Geom| Block {
            name: geom.name.clone(),
            position: geom.pos,
            half_size: geom.size,
            colour: geom.rgba,
        };
        let blocks = |body: &str| geoms.iter().filter(|geom| geom.body == body).map(block).collect::<Vec<_>>();
        let (platforms, walls) = (blocks("ground"), blocks("walls"));
        // The other five geoms are four planes at the sides and the ground.
        if platforms.len() + walls.len() + 5 != geoms.len() || platforms.is_empty() == walls.is_empty() {
            return Err(fail(&"neither an arena of gaps nor one of walls"));
        }
        Ok(Self { length: 2.0 * ground.pos[0], width: 2.0 * ground.size[1], platforms, walls })
    }
}

/// The root's quaternion in `qpos`. dm_control divides it by `np.linalg.norm`, and the machine's BLAS decides how that sum is
/// rounded. So its last bits, and those of no other coordinate, depend on the machine that recorded the rollout. A tracking
/// episode begins in its clip's pose, without a division.
pub(crate) const QUATERNION: Range<usize> = 3..7;

/// How far apart two machines' quaternions may be, in units in the last place. OpenBLAS 0.3.31 has kernels for many processors:
/// over 20,000 headings those for Nehalem, Sandy Bridge, Haswell and Zen move a component by one unit in 16 % and never by two,
/// and that for Prescott by two units in 0.4 % and never by three.
const UNITS: u64 = 2;

/// The recorded first pose, if it is `found` except for the rounding of the quaternion.
pub(crate) fn compare_first_pose<'a>(rollout: &'a Rollout, found: &[f64]) -> Result<&'a [f64; 63], String> {
    let recorded = rollout.array("qpos")?.row(0)?;
    let mut found = found.to_vec();
    let pairs = recorded.iter().zip(&mut found).enumerate();
    for (index, (recorded, found)) in pairs.filter(|(index, _)| QUATERNION.contains(index)) {
        let units = units_apart(*recorded, *found);
        if units > UNITS {
            return Err(format!(
                "{}: row 0: qpos[{index}]: {recorded:?} recorded, {found:?} found: {units} units in the last place apart; the \
                 BLAS of another machine explains {UNITS}",
                rollout.file
            ));
        }
        *found = *recorded;
    }
    rollout.equal(0, "qpos", recorded, &found, 0.0)?;
    recorded.try_into().map_err(|_| format!("{}: row 0: qpos: not 63 numbers", rollout.file))
}

/// The number of floats from one to the other.
pub(crate) fn units_apart(one: f64, other: f64) -> u64 {
    // The bits of a positive float are its place among the floats, counted from zero.
    let place = |number: f64| {
        let distance = number.abs().to_bits().cast_signed();
        if number.is_sign_negative() { -distance } else { distance }
    };
    place(one).abs_diff(place(other))
}

/// Compares every number of every row. The replay goes on from the recorded first pose: the machines' last bits would grow.
fn compare(rollout: &Rollout, replay: &mut Replay) -> Result<(), String> {
    replay.begin_at(compare_first_pose(rollout, replay.simulation().qpos())?);
    let warm = rollout.array("qacc_warmstart_after_reset")?.numbers()?;
    rollout.equal(0, "qacc_warmstart_after_reset", warm, replay.simulation().qacc_warmstart(), 0.0)?;
    compare_row(rollout, 0, replay, None)?;
    for (row, control) in (1..).zip(rollout.controls()?) {
        let step = replay.step_control(control);
        compare_row(rollout, row, replay, Some(step))?;
    }
    Ok(())
}

fn compare_row(rollout: &Rollout, row: usize, replay: &Replay, step: Option<Step>) -> Result<(), String> {
    rollout.compare_common(row, replay.environment(), step)?;
    rollout.compare_observations(row, &replay.dictionary())?;
    for (name, found) in replay.quantities() {
        match name {
            "counter" | "disallowed" | "target" => rollout.exact(row, name, &found)?,
            _ => rollout.close(row, name, &found)?,
        }
    }
    Ok(())
}

fn fail(rollout: &Rollout, name: &str) -> String {
    format!("{}: {name}: not what go-to-target has", rollout.file)
}
