"""Runs exported policies in onnxruntime and in PyTorch, on dm_control's observations.

    comic-learner export --checkpoint runs/mine --part policy --out policies/mine.onnx
    comic-learner export --checkpoint runs/mine --part policy --out policies/mine.pt
    python tests/python/run_onnx.py policies

It needs the packages in requirements-tests.txt. Each policy of the directory runs on five pieces of a golden rollout of its task, as
five environments, and its memory is fed back. The script prints one line of JSON a step: the inputs, the output in onnxruntime, that
of the first environment alone, and the output in PyTorch.
"""

import json
import pathlib
import sys

import numpy as np
import onnxruntime
import torch

if len(sys.argv) != 2:
    sys.exit(__doc__)

GOLDEN = pathlib.Path(__file__).parents[1] / "fixtures/golden"
ROLLOUTS = {"tracking": "tracking_small_noise", "go-to-target": "go_to_target_far", "gaps": "gaps_rollout"}
ROWS = 5
# Other tests use the other cores.
torch.set_num_threads(1)
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1


def observations(spec):
    """The inputs of each step but the memory, `[ROWS, size]`; entries by their names, rows from different times."""
    task = next(vector["name"].removeprefix("observation:") for vector in spec["inputs"] if ":" in vector["name"])
    rollout = np.load(GOLDEN / f"{ROLLOUTS[task]}.npz")
    layout = json.loads(str(rollout["obs_layout"]))
    ends = np.cumsum([size for _, size in layout])
    columns = {name: np.arange(end - size, end) for (name, size), end in zip(layout, ends)}
    steps = len(rollout["obs"]) // ROWS
    pixels = np.load(GOLDEN / "models/gaps_camera.npz")["rgb"]
    for step in range(steps):
        rows = rollout["obs"][step + steps * np.arange(ROWS)].astype(np.float32)
        inputs = {}
        for vector in spec["inputs"][:-1]:
            if vector["name"] == "image":
                inputs["image"] = np.stack([np.roll(pixels, 5 * step + row, axis=1).ravel() for row in range(ROWS)])
            else:
                # Of the reference, the first steps, if the policy sees fewer.
                chosen = [columns["walker/" + entry["name"]][: entry["size"]] for entry in vector.get("entries", [])]
                inputs[vector["name"]] = rows[:, np.concatenate([np.empty(0, int), *chosen])]
        yield inputs


def lists(arrays):
    """The same arrays as lists, which JSON has."""
    return {name: array.tolist() for name, array in arrays.items()}


for path in sorted(pathlib.Path(sys.argv[1]).glob("*.onnx")):
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    spec = json.loads(session.get_modelmeta().custom_metadata_map["comic"])
    script = torch.jit.load(path.with_suffix(".pt"), _extra_files=(extra := {"comic.json": ""}))
    assert json.loads(extra["comic.json"]) == spec
    names = [each.name for each in session.get_outputs()]

    def run(inputs):
        """The outputs by name."""
        fed = {each.name: inputs[each.name] for each in session.get_inputs()}
        return dict(zip(names, session.run(names, fed)))

    empty = np.zeros((ROWS, spec["inputs"][-1]["size"]), np.float32)
    memory, memory_alone, memory_in_torch = empty, empty[:1], torch.tensor(empty)
    for inputs in observations(spec):
        outputs = run(inputs | {"recurrent_state": memory})
        alone = run({name: rows[:1] for name, rows in inputs.items()} | {"recurrent_state": memory_alone})
        in_torch = script(*map(torch.tensor, inputs.values()), memory_in_torch)
        memory, memory_alone = (each.get("next_recurrent_state", empty) for each in (outputs, alone))
        memory_in_torch = in_torch[:, outputs["action"].shape[1]:]
        print(json.dumps({
            "policy": path.stem,
            "inputs": lists(inputs),
            "outputs": lists(outputs),
            "alone": lists(alone),
            "torch": in_torch.tolist(),
        }))
