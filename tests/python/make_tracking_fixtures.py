"""Rollouts of dm_control's own tracking task, to compare another implementation with.

    python tests/python/make_tracking_fixtures.py --seed 1 --out tests/fixtures/golden

Needs requirements-tracking.txt and nothing from this repository. Everything drawn comes from the seed, so one seed
gives the same bytes again on the same machine; another machine's libm may move the last digits. Written are

* `synthetic_v2020.h5`: two clips of 40 frames at 0.03 s for the V2020 humanoid, in the layout of dm_control's CMU
  files. `DRAWN_001_01` stands and sways; `DRAWN_002_01` moves every joint through much of its range while the root
  travels and turns. Joints and the root's path are sums of random sinusoids; every other feature is forward
  kinematics of the humanoid, so the clips are kinematically exact and not dynamically feasible.
* `tracking_*.npz`: three rollouts on them; `tracking2019_*.npz`: one on a clip of dm_control's test file, which fits
  the V2019 humanoid (30 bodies, no actuator filter, frames of 0.05 s).

A rollout of N steps holds, all float64 but for the integers and strings:

    clip, start, clip_id        index in the data set, first frame, name in the HDF5 file
    actions [N, 56]             in the order of the actuators, within [-1, 1]
    obs_layout                  JSON [[name, size], ...]: how a row of `obs` is cut
    obs [N+1, O]                row 0 after the reset, row i after action i; likewise below
    qpos [N+1, 63], qvel [N+1, 62], act [N+1, 56 or 0], sensordata [N+1, 37], time [N+1], ncon [N+1]
    reward, discount [N+1]      NaN in row 0
    step_type [N+1]             0 first, 1 mid, 2 last; stepping goes on after a failure, without a reset
    reward_channels, reward_terms [N+1, 5]    names and weighted terms, which add up to the reward
    termination_error, truncate, end_mocap, mocap_step [N+1]
    qacc_warmstart_after_reset [62]
"""

import argparse
import json
import os
import pathlib
import warnings

os.environ.setdefault("MUJOCO_GL", "disable")

import h5py
import mujoco
import numpy as np
from dm_control import composer, mjcf
from dm_control.locomotion import arenas, mocap
from dm_control.locomotion.tasks.reference_pose import tracking, types, utils
from dm_control.locomotion.walkers import cmu_humanoid

DT = 0.03  # s, the CMU files' frame interval
FRAMES = 40
STEPS = 12
REFERENCE_STEPS = (1, 2, 3, 4, 5)
TIME_LIMIT = 30.0  # s, as in dm_control's example
CLIPS_2020 = ("DRAWN_001_01", "DRAWN_002_01")
CLIPS_2019 = ("cmuv2019_001", "cmuv2019_002")
CHANNELS = ("appendages", "body_quaternions", "center_of_mass", "joints_velocity", "termination")
# Root orientation of the upright humanoid, which is modelled lying (y axis up), w x y z.
UPRIGHT = np.array([0.7071067811865476, 0.7071067811865475, 0.0, 0.0])


# dm_control's HDF5 loader asks protobuf for a deprecated field at every message.
warnings.filterwarnings("ignore", category=DeprecationWarning, module="dm_control|google")


# ---------------------------------------------------------------------------------------------------------- clips


class Kinematics:
    """The V2020 humanoid on dm_control's floor, posed frame by frame."""

    def __init__(self):
        arena = arenas.Floor()
        self.walker = utils.add_walker(cmu_humanoid.CMUHumanoidPositionControlledV2020, arena)
        self.physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
        self.model, self.data = self.physics.model.ptr, self.physics.data.ptr
        self.range = np.array(self.physics.bind(self.walker.mocap_joints).range)  # [56, 2] rad
        names = [joint.name for joint in self.walker.mocap_joints]
        self.joint = {name: index for index, name in enumerate(names)}
        geoms = [self.model.geom(g) for g in range(self.model.ngeom)]
        self.floor = next(g.id for g in geoms if not g.name.startswith("walker/"))
        self.solid = [g.id for g in geoms if g.name.startswith("walker/") and g.contype[0]]

    def pose(self, qpos, qvel):
        utils.set_walker(self.physics, self.walker, qpos, qvel)
        self.physics.forward()

    def height(self):
        """Distance from the floor to the lowest solid geom, m."""
        return min(
            mujoco.mj_geomDistance(self.model, self.data, self.floor, geom, 10.0, np.zeros(6)) for geom in self.solid
        )

    def clip(self, position, quaternion, joints):
        """Features [T, ...] of a motion, its height shifted in every frame so that it just touches the floor."""
        rest = np.zeros(62)
        qpos = np.concatenate([position, quaternion, np.clip(joints, self.range[:, 0], self.range[:, 1])], axis=1)
        for frame in qpos:
            self.pose(frame, rest)
            frame[2] -= self.height()
        rows = []
        for t, frame in enumerate(qpos):
            before, after = max(t - 1, 0), min(t + 1, len(qpos) - 1)
            qvel = np.zeros(62)  # qvel's first three are the world's, the next three the root's own frame
            mujoco.mj_differentiatePos(self.model, qvel, DT * (after - before), qpos[before], qpos[after])
            self.pose(frame, qvel)
            rows.append({k: np.ravel(v).copy() for k, v in utils.get_features(self.physics, self.walker).items()})
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def wander(random, width, frequencies, count=3):
    """`width` smooth functions of time within [-1, 1], [FRAMES, width]: each a mean of `count` sinusoids."""
    time = np.arange(FRAMES)[:, None, None] * DT
    frequency = random.uniform(*frequencies, (width, count))  # Hz
    phase = random.uniform(0, 2 * np.pi, (width, count))
    return np.sin(2 * np.pi * frequency * time + phase).mean(axis=2)


def turned(yaw):
    """The upright orientation turned about the world's vertical by yaw [T] rad: [T, 4]."""
    quaternion = np.zeros((len(yaw), 4))
    for row, angle in zip(quaternion, yaw):
        mujoco.mju_mulQuat(row, np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]), UPRIGHT)
    return quaternion


def standing(kinematics, random):
    """Knees slightly bent, arms down, every joint swaying by a few hundredths of its range."""
    pose = np.zeros(56)
    for side, sign in (("l", 1.0), ("r", -1.0)):
        for joint, angle in (("femurrx", -0.15), ("tibiarx", 0.2), ("radiusrx", 0.3), ("humerusrz", 1.0 * sign)):
            pose[kinematics.joint[side + joint]] = angle
    width = np.ptp(kinematics.range, axis=1)
    joints = pose + 0.03 * width * wander(random, 56, (0.2, 0.6))
    position = np.hstack([0.03 * wander(random, 2, (0.2, 0.5)), np.full((FRAMES, 1), 1.2)])
    return kinematics.clip(position, turned(0.1 * wander(random, 1, (0.2, 0.5))[:, 0]), joints)


def dancing(kinematics, random):
    """Every joint through up to 80 % of its range, the root drifting along a line and turning."""
    low, high = kinematics.range.T
    joints = (low + high) / 2 + 0.4 * (high - low) * wander(random, 56, (0.3, 1.2))
    velocity = random.uniform(-1.0, 1.0, 2)  # m/s
    drift = np.arange(FRAMES)[:, None] * DT * velocity + 0.05 * wander(random, 2, (0.5, 1.0))
    position = np.hstack([drift, np.full((FRAMES, 1), 1.5)])
    yaw = random.uniform(-np.pi, np.pi) + np.arange(FRAMES) * DT * random.uniform(-1.5, 1.5)
    return kinematics.clip(position, turned(yaw), joints)


def write_clips(path, clips):
    """dm_control's layout: a group for each clip, data sets [features, frames], one chunk each, shuffled, deflated."""
    with h5py.File(path, "w") as file:
        for name, features in clips.items():
            group = file.create_group(name)
            group.attrs["dt"] = np.float64(DT)
            group.attrs["num_steps"] = np.int64(FRAMES)
            for part, value in (("year", 2020), ("month", 1), ("day", 1)):
                group.attrs[part] = np.int64(value)
            group.create_group("props")
            walker = group.create_group("walkers/walker_0")
            walker.attrs["name"] = np.bytes_("walker")
            walker.attrs["model"] = np.int64(4)  # CMU_2020 in dm_control's mocap.proto
            walker.attrs["mass"] = np.float64(0.0)
            for names in ("end_effector_names", "appendage_names"):
                walker.attrs[names] = np.array([], dtype="S1")
            walker.create_group("scaling")
            walker.create_group("markers")
            for feature, rows in features.items():
                walker.create_dataset(
                    feature, data=rows.T, chunks=rows.T.shape, shuffle=True, compression="gzip", compression_opts=9
                )


# ------------------------------------------------------------------------------------------------------- rollouts


class FixedStart(tracking.MultiClipMocapTracking):
    """dm_control's task with a single start (clip index, frame) instead of all possible ones."""

    def __init__(self, start, **arguments):
        self._start = start
        super().__init__(**arguments)

    def _get_possible_starts(self):
        self._possible_starts = [self._start]
        self._start_probabilities = np.ones(1)

    def servo_action(self, frames_ahead, noise):
        """The action whose position targets are the pose `frames_ahead` frames later, plus noise [56]."""
        joints = self._clip_reference_features["joints"][self._time_step + frames_ahead]
        return np.clip(self._walker.cmu_pose_to_actuation(joints) + noise, -1.0, 1.0)

    def measurements(self):
        """Private values of the task after a reset or a step."""
        return {
            "termination_error": np.float64(self._termination_error),
            "reward_terms": np.array([np.ravel(self.last_reward_channels[c])[0] for c in CHANNELS], np.float64),
            "mocap_step": np.int64(self._time_step),
            "truncate": np.int64(self._should_truncate),
            "end_mocap": np.int64(self._end_mocap),
        }


def row(environment, timestep):
    data = environment.physics.data
    return {
        "obs": np.concatenate([np.ravel(np.asarray(v, np.float64)) for v in timestep.observation.values()]),
        "reward": np.float64(np.nan if timestep.reward is None else timestep.reward),
        "discount": np.float64(np.nan if timestep.discount is None else timestep.discount),
        "step_type": np.int64(timestep.step_type),
        "qpos": np.array(data.qpos),
        "qvel": np.array(data.qvel),
        "act": np.array(data.act),
        "sensordata": np.array(data.sensordata),
        "time": np.float64(data.time),
        "ncon": np.int64(data.ncon),
        **environment.task.measurements(),
    }


def rollout(walker, path, ids, clip, start, steps, act):
    """`steps` steps from one start; `act(task)` gives the next action. Returns the arrays of the module's docstring."""
    task = FixedStart(
        (clip, start),
        walker=walker,
        arena=arenas.Floor(),
        ref_path=str(path),
        ref_steps=REFERENCE_STEPS,
        dataset=types.ClipCollection(ids=ids),
        reward_type="comic",
    )
    environment = composer.Environment(
        task=task, time_limit=TIME_LIMIT, random_state=0, strip_singleton_obs_buffer_dim=True
    )
    timestep = environment.reset()
    layout = [[name, int(np.size(value))] for name, value in timestep.observation.items()]
    warm_start = np.array(environment.physics.data.qacc_warmstart)
    actions, rows = [], [row(environment, timestep)]
    for _ in range(steps):
        actions.append(act(task))
        timestep = environment.step(actions[-1])
        environment._reset_next_step = False  # continue after a failure: more states to compare
        rows.append(row(environment, timestep))
    return {
        "clip": np.int64(clip),
        "start": np.int64(start),
        "clip_id": np.array(ids[clip]),
        "reward_channels": np.array(CHANNELS),
        "obs_layout": np.array(json.dumps(layout)),
        **{name: np.stack([r[name] for r in rows]) for name in rows[0]},
        "actions": np.array(actions),
        "qacc_warmstart_after_reset": warm_start,
    }


def uniform(random, bound):
    return lambda task: random.uniform(-bound, bound, 56)


def servo(random, noise):
    return lambda task: task.servo_action(1, noise * random.standard_normal(56))


def summary(name, arrays):
    last = np.flatnonzero(arrays["step_type"] == 2)
    end = "no end" if not len(last) else f"ends at step {last[0]} with discount {arrays['discount'][last[0]]:.0f}"
    print(
        f"{name}: {arrays['clip_id']} from frame {arrays['start']}, {len(arrays['actions'])} steps, {end}; "
        f"error up to {arrays['termination_error'].max():.3f}, reward {np.nanmin(arrays['reward']):.3f} to "
        f"{np.nanmax(arrays['reward']):.3f}, up to {arrays['ncon'].max()} contacts"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder to write into")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    clips = arguments.out / "synthetic_v2020.h5"
    test_clips = pathlib.Path(mocap.__file__).parent / "test_trajectories.h5"
    # One stream a purpose: a change to one rollout leaves the others as they are.
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(arguments.seed).spawn(7)]
    kinematics = Kinematics()
    write_clips(
        clips,
        {CLIPS_2020[0]: standing(kinematics, streams[0]), CLIPS_2020[1]: dancing(kinematics, streams[1])},
    )

    v2020 = cmu_humanoid.CMUHumanoidPositionControlledV2020
    v2019 = cmu_humanoid.CMUHumanoidPositionControlled
    # The clip ends when no frame is left beyond the furthest reference.
    to_the_end = FRAMES - REFERENCE_STEPS[-1] - 1 - STEPS
    somewhere = int(streams[6].integers(0, to_the_end))
    plan = {
        "tracking_uniform": (v2020, clips, CLIPS_2020, 1, somewhere, STEPS, uniform(streams[2], 1.0)),
        "tracking_servo_to_the_end": (v2020, clips, CLIPS_2020, 0, to_the_end, STEPS, servo(streams[3], 0.0)),
        "tracking_small_noise": (v2020, clips, CLIPS_2020, 0, 0, STEPS + 2, uniform(streams[4], 0.2)),
        "tracking2019_uniform": (v2019, test_clips, CLIPS_2019, 1, 0, 4, uniform(streams[5], 0.5)),
    }
    for name, case in plan.items():
        arrays = rollout(*case)
        np.savez_compressed(arguments.out / f"{name}.npz", **arrays)
        summary(name, arrays)


if __name__ == "__main__":
    main()
