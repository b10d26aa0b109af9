"""Reads a file of clips with dm_control's own loader, and compares its features with MuJoCo's kinematics.

    python tests/python/read_clips.py FILE.h5

Needs requirements-tracking.txt. Prints one JSON object: for each clip its frames, seconds between them, and the largest
difference of each feature from what the V2020 humanoid has in the stored pose (m, or a quaternion's part, whatever its
sign).
"""

import json
import os
import sys
import warnings

os.environ.setdefault("MUJOCO_GL", "disable")

import mujoco
import numpy as np
from dm_control import mjcf
from dm_control.locomotion.arenas import floors
from dm_control.locomotion.mocap import loader
from dm_control.locomotion.tasks.reference_pose import utils
from dm_control.locomotion.walkers import cmu_humanoid

# dm_control's HDF5 loader asks protobuf for a deprecated field at every message.
warnings.filterwarnings("ignore", category=DeprecationWarning)


def features(walker, physics, pose):
    data = physics.data.ptr
    data.qpos[:3], data.qpos[3:7], data.qpos[7:] = pose["position"], pose["quaternion"], pose["joints"]
    mujoco.mj_kinematics(physics.model.ptr, data)
    mujoco.mj_comPos(physics.model.ptr, data)
    root = physics.bind(walker.root_body)
    ends = physics.bind(walker.end_effectors).xpos
    appendages = (np.vstack([ends, physics.bind(walker.head).xpos]) - root.xpos) @ root.xmat.reshape(3, 3)
    bodies = physics.bind(walker.mocap_tracking_bodies)
    return {
        "center_of_mass": physics.bind(mjcf.get_attachment_frame(walker.mjcf_model)).subtree_com,
        "end_effectors": appendages[:4],
        "appendages": appendages,
        "body_positions": bodies.xpos,
        "body_quaternions": bodies.xquat,
    }


def difference(name, ours, theirs):
    ours, theirs = np.ravel(ours), np.ravel(theirs)
    if name != "body_quaternions":
        return float(np.abs(ours - theirs).max())
    ours, theirs = ours.reshape(-1, 4), theirs.reshape(-1, 4)
    return float(np.minimum(np.abs(ours - theirs).max(1), np.abs(ours + theirs).max(1)).max())


def main():
    arena = floors.Floor()
    walker = utils.add_walker(cmu_humanoid.CMUHumanoidPositionControlledV2020, arena)
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    clips = loader.HDF5TrajectoryLoader(sys.argv[1])
    report = {}
    for key in clips.keys():
        trajectory = clips.get_trajectory(key, zero_out_velocities=False)
        poses = trajectory.as_dict()
        poses = {name.removeprefix("walker/"): value for name, value in poses.items()}
        frames = len(poses["position"])
        worst = {}
        for frame in range(frames):
            pose = {name: value[frame] for name, value in poses.items()}
            for name, theirs in features(walker, physics, pose).items():
                worst[name] = max(worst.get(name, 0.0), difference(name, pose[name], theirs))
        report[key] = {"frames": frames, "dt": trajectory.dt, "differences": worst}
    print(json.dumps(report))


main()
