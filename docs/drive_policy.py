"""Lets an exported policy act in dm_control's own tracking environment: python docs/drive_policy.py policy.pt walk.h5 0 24

    comic-learner export --checkpoint runs/mine --part policy --out policy.pt
    comic-actor clips merge builtin:walk --out walk.h5

The numbers are frames of each clip at which an episode starts (0). It needs tests/python/requirements-export.txt, and prints what
`comic-actor evaluate --rewards FILE` writes: an object an episode, with its clip, its start and the reward of each of 20 steps.
"""

import json
import os
import sys
import tomllib

os.environ.setdefault("MUJOCO_GL", "disable")

import h5py
import numpy as np
import torch
from dm_control import composer
from dm_control.locomotion import arenas
from dm_control.locomotion.tasks.reference_pose import tracking, types
from dm_control.locomotion.walkers import cmu_humanoid

if len(sys.argv) < 3:
    sys.exit(__doc__)
path, clips, starts = sys.argv[1], sys.argv[2], [int(start) for start in sys.argv[3:] or [0]]
policy = torch.jit.load(path, _extra_files=(extra := {"comic.json": ""}))
*observed, memory = (spec := json.loads(extra["comic.json"]))["inputs"]
settings, names = tomllib.loads(spec["experiment"])["tracking"], tuple(h5py.File(clips))
task = tracking.MultiClipMocapTracking(
    cmu_humanoid.CMUHumanoidPositionControlledV2020, arenas.Floor(), ref_path=clips, reward_type="comic",
    ref_steps=tuple(settings["reference_steps"]), dataset=types.ClipCollection(ids=names),
    min_steps=settings["min_steps"], termination_error_threshold=settings["termination_threshold"])
environment = composer.Environment(task, time_limit=settings["time_limit"], strip_singleton_obs_buffer_dim=True)
for clip, start in ((clip, start) for clip in range(len(names)) for start in starts):
    task._possible_starts, task._start_probabilities = [(clip, start)], np.ones(1)
    step, state, rewards = environment.reset(), torch.zeros(1, memory["size"]), []
    while not step.last() and len(rewards) < 20:
        rows = [[np.ravel(step.observation["walker/" + part["name"]]) for part in row["entries"]] for row in observed]
        output = policy(*(torch.tensor(np.concatenate(row), dtype=torch.float32)[None] for row in rows), state)
        step, state = environment.step(output[0, :56].double().numpy()), output[:, 56:]
        rewards.append(float(step.reward))
    print(json.dumps({"clip": names[clip], "start": start, "rewards": rewards}))
