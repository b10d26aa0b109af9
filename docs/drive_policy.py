"""Lets an exported policy act in dm_control's own tracking environment.

    comic-learner export --checkpoint runs/mine --part policy --out policy.pt
    comic-actor clips merge builtin:walk --out walk.h5
    python docs/drive_policy.py policy.pt walk.h5 0 24

The numbers are frames of each clip at which an episode starts. The script prints one line of JSON a step. It needs the packages in
tests/python/requirements-tests.txt.
"""

import itertools
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

if len(sys.argv) < 4:
    sys.exit(__doc__)

path, clips, *starts = sys.argv[1:]
policy = torch.jit.load(path, _extra_files=(extra := {"comic.json": ""}))
(*observed, memory), settings = (spec := json.loads(extra["comic.json"]))["inputs"], tomllib.loads(spec["experiment"])["tracking"]
for clip, start in itertools.product(h5py.File(clips), starts):
    environment = composer.Environment(tracking.MultiClipMocapTracking(
        cmu_humanoid.CMUHumanoidPositionControlledV2020, arenas.Floor(), ref_path=clips, reward_type="comic",
        ref_steps=tuple(settings["reference_steps"]), dataset=types.ClipCollection(ids=(clip,), start_steps=(int(start),)),
        always_init_at_clip_start=True, termination_error_threshold=settings["termination_threshold"],
    ), time_limit=settings["time_limit"], strip_singleton_obs_buffer_dim=True)
    step, state = environment.reset(), torch.zeros(1, memory["size"])
    while not step.last():
        output = policy(*(torch.tensor(np.concatenate([
            np.ravel(step.observation["walker/" + part["name"]]) for part in row["entries"]
        ]), dtype=torch.float32)[None] for row in observed), state)
        step, state = environment.step(output[0, :56].double().numpy()), output[:, 56:]
        print(json.dumps({"clip": clip, "start": int(start), "reward": float(step.reward)}))
