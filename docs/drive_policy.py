"""Drives an exported policy in dm_control's own tracking environment.

    comic-learner export --checkpoint runs/mine --part policy --out policy.pt
    comic-actor clips merge builtin:walk --out walk.h5
    python docs/drive_policy.py policy.pt walk.h5 --starts 0 24 48 --steps 20

Needs torch and what dm_control's tracking needs (tests/python/requirements-export.txt). Prints what `comic-actor evaluate
--rewards FILE` writes: one JSON object an episode, with its clip, its start (a frame) and the reward of every step.
"""

import argparse
import json
import os
import tomllib
import warnings

os.environ.setdefault("MUJOCO_GL", "disable")

import h5py
import numpy as np
import torch
from dm_control import composer
from dm_control.locomotion import arenas
from dm_control.locomotion.tasks.reference_pose import tracking, types
from dm_control.locomotion.walkers import cmu_humanoid

# dm_control's HDF5 loader asks protobuf for a deprecated field at every message.
warnings.filterwarnings("ignore", category=DeprecationWarning)

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("policy", help="TorchScript of `comic-learner export`")
parser.add_argument("clips", help="clips in dm_control's HDF5 layout")
parser.add_argument("--starts", type=int, nargs="+", default=[0], help="frames of each clip at which an episode starts")
parser.add_argument("--steps", type=int, default=20, help="the most steps of an episode")
arguments = parser.parse_args()

# The environment, as the experiment in the file describes it.
extra = {"comic.json": ""}
policy = torch.jit.load(arguments.policy, _extra_files=extra)
spec = json.loads(extra["comic.json"])
settings = tomllib.loads(spec["experiment"])["tracking"]
clips = tuple(h5py.File(arguments.clips))
task = tracking.MultiClipMocapTracking(
    walker=cmu_humanoid.CMUHumanoidPositionControlledV2020,
    arena=arenas.Floor(),
    ref_path=arguments.clips,
    ref_steps=tuple(settings["reference_steps"]),
    dataset=types.ClipCollection(ids=clips),
    min_steps=settings["min_steps"],
    termination_error_threshold=settings["termination_threshold"],
    reward_type="comic",
)
environment = composer.Environment(task, time_limit=settings["time_limit"], strip_singleton_obs_buffer_dim=True)

# The policy: three rows in, one row out, which is the action and what to remember.
proprioception, observation, memory = spec["inputs"]
actions = spec["outputs"][0]["size"]


def row(vector):
    parts = [np.ravel(timestep.observation["walker/" + entry["name"]]) for entry in vector["entries"]]
    return torch.from_numpy(np.concatenate(parts).astype(np.float32))[None]


for index, clip in enumerate(clips):
    for start in arguments.starts:
        task._possible_starts, task._start_probabilities = [(index, start)], np.ones(1)
        timestep, remembered, rewards = environment.reset(), torch.zeros(1, memory["size"]), []
        while not timestep.last() and len(rewards) < arguments.steps:
            output = policy(row(proprioception), row(observation), remembered)
            action, remembered = output[:, :actions], output[:, actions:]
            timestep = environment.step(action[0].double().numpy())
            rewards.append(float(timestep.reward))
        print(json.dumps({"clip": clip, "start": start, "rewards": rewards}))
