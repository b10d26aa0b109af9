"""What torch_vmpo_update.py and torch_svg0_update.py share: layers, Gaussians, and the clock."""

import argparse
import json
import os
import statistics
import sys
import time

sys.setdlopenflags(os.RTLD_LAZY)  # see bare_torch.py

import torch
from torch import nn
from torch.distributions import Independent, Normal
from torch.nn import functional

MIN_STD = 1e-3


def torso(inputs, hidden):
    """Linear, layer norm and tanh first; then linear and ELU."""
    layers = [nn.Linear(inputs, hidden[0]), nn.LayerNorm(hidden[0]), nn.Tanh()]
    for before, after in zip(hidden, hidden[1:]):
        layers += [nn.Linear(before, after), nn.ELU()]
    return nn.Sequential(*layers)


def mlp(inputs, hidden, outputs):
    """A torso and a linear head."""
    return nn.Sequential(*torso(inputs, hidden), nn.Linear(hidden[-1], outputs))


def mean_and_std(parameters):
    mean, raw = parameters.chunk(2, dim=-1)
    return mean, functional.softplus(raw) + MIN_STD


def gaussian(mean, std):
    return Independent(Normal(mean, std, validate_args=False), 1, validate_args=False)


def standard_normal(like):
    return gaussian(torch.zeros_like(like), torch.ones_like(like))


def measure(description, prepare):
    """Times the update that `prepare` makes: a function that takes nothing and returns its losses as numbers."""
    parser = argparse.ArgumentParser(description=description.split("\n")[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=10, help="updates to time at most")
    parser.add_argument("--seconds", type=float, default=60.0, help="start no further update after so long")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(arguments.seed)

    update = prepare()
    for _ in range(2):  # Adam allocates its moments at the first
        update()

    milliseconds, begin = [], time.perf_counter()
    while len(milliseconds) < arguments.repeats:
        if milliseconds and time.perf_counter() - begin > arguments.seconds:
            break
        start = time.perf_counter()
        parts = update()
        milliseconds.append(1e3 * (time.perf_counter() - start))
        if any(part != part for part in parts):
            raise SystemExit("a loss is not a number")
    print(
        json.dumps(
            {
                "milliseconds": statistics.median(milliseconds),
                "threads": arguments.threads,
                "repeats": len(milliseconds),
            }
        )
    )
