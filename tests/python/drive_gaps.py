"""Lets an exported policy that sees act in dm_control's own corridor with gaps.

    comic-learner export --checkpoint runs/gaps --part policy --out policy.pt
    python tests/python/drive_gaps.py policy.pt 20

It needs OpenGL, and the packages in requirements-tests.txt. The policy's description alone says what the inputs are, and in which
order. The number is that of steps. The script prints one line of JSON a step: the reward, the largest action, and the largest
change of the action when the image is black instead.
"""

import json
import os
import sys

os.environ.setdefault("MUJOCO_GL", "egl")

import bind_lxml  # noqa: F401
import numpy as np
import torch
from dm_control import composer
from dm_control.locomotion.tasks import corridors
from dm_control.locomotion.walkers import cmu_humanoid
from make_task_fixtures import TIMESTEPS, corridor_arena

if len(sys.argv) != 3:
    sys.exit(__doc__)

policy = torch.jit.load(sys.argv[1], _extra_files=(extra := {"comic.json": ""}))
spec = json.loads(extra["comic.json"])
walker = cmu_humanoid.CMUHumanoidPositionControlledV2020()
walker.observables.egocentric_camera.enabled = True
task = corridors.RunThroughCorridor(
    walker=walker, arena=corridor_arena("gaps", 20), walker_spawn_position=(0.5, 0, 0), target_velocity=3.0, **TIMESTEPS
)
environment = composer.Environment(task, time_limit=45, random_state=1, strip_singleton_obs_buffer_dim=True)


def value(vector, observation, memory):
    """An input of the policy, [1, size]."""
    match vector["name"]:
        case "image":
            return torch.tensor(observation["walker/egocentric_camera"].reshape(1, vector["size"]))
        case "recurrent_state":
            return memory
        case _:
            parts = [np.ravel(observation["walker/" + part["name"]]) for part in vector.get("entries", [])]
            return torch.tensor(np.concatenate([np.empty(0), *parts]), dtype=torch.float32)[None]


step, memory = environment.reset(), torch.zeros(1, spec["inputs"][-1]["size"])
for _ in range(int(sys.argv[2])):
    inputs = {vector["name"]: value(vector, step.observation, memory) for vector in spec["inputs"]}
    output = policy(*inputs.values())
    blind = policy(*(inputs | {"image": torch.zeros_like(inputs["image"])}).values())
    action, memory = output[:, :56], output[:, 56:]
    step = environment.step(action[0].double().numpy())
    print(json.dumps({
        "reward": float(step.reward),
        "largest_action": float(action.abs().max()),
        "change_when_blind": float((action - blind[:, :56]).abs().max()),
    }))
    if step.last():
        break
