"""How fast environments step from Python: what `cargo xtask bench python` stands against `actor.env`.

usage: python_environments.py [--seconds 30]
Uniform random actions, resets included, one clip. The measurements take turns in segments of a second. Prints one JSON line
for each: `figure`, `value` (the median, control steps per second of all environments together), `unit`. `python.env.N` are N
environments in one thread, `python.env.N.two` in two threads; `python.dm_control` is dm_control's own loop.
"""
import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

import comic
import dm_control_loop
import numpy as np
from dm_control import composer

CLIPS = 'builtin:CMU_007_01'
SEGMENT = 1.0


def single():
    """A loop over one environment."""
    environment = comic.Environment(clips=CLIPS)
    environment.reset(seed=1)
    random = np.random.default_rng(1)

    def segment():
        steps, start = 0, time.perf_counter()
        while time.perf_counter() - start < SEGMENT:
            *_, terminated, truncated, _ = environment.step(random.uniform(-1, 1, 56))
            if terminated or truncated:
                environment.reset()
            steps += 1
        return steps / (time.perf_counter() - start)
    return segment


def vector(count, threads):
    """A loop over several environments. The same step resets those whose episode is over."""
    environments = comic.make_vec(num_envs=count, threads=threads, autoreset_mode='SameStep', clips=CLIPS)
    environments.reset(seed=1)
    random = np.random.default_rng(1)

    def segment():
        steps, start = 0, time.perf_counter()
        while time.perf_counter() - start < SEGMENT:
            environments.step(random.uniform(-1, 1, (count, 56)))
            steps += count
        return steps / (time.perf_counter() - start)
    return segment


def dm_control(directory):
    """dm_control's own loop."""
    clips = Path(directory) / 'walk.h5'
    comic.clips.merge(CLIPS, clips)
    _, task = dm_control_loop.tracking_task(argparse.Namespace(clips=str(clips)))
    environment = composer.Environment(task=task, time_limit=30, random_state=1, strip_singleton_obs_buffer_dim=True)
    random = np.random.RandomState(1)
    environment.reset()

    def segment():
        steps, start = 0, time.perf_counter()
        while time.perf_counter() - start < SEGMENT:
            if environment.step(random.uniform(-1, 1, 56)).last():
                environment.reset()
            steps += 1
        return steps / (time.perf_counter() - start)
    return segment


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=30)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        loops = {
            'python.env.1': single(),
            'python.env.16': vector(16, 1),
            'python.env.256': vector(256, 1),
            'python.env.256.two': vector(256, 2),
            'python.dm_control': dm_control(directory),
        }
        values = {name: [] for name in loops}
        start = time.perf_counter()
        while time.perf_counter() - start < arguments.seconds:
            for name, segment in loops.items():
                values[name].append(segment())
    for name, measured in values.items():
        print(json.dumps({'figure': name, 'value': statistics.median(measured), 'unit': 'steps/s'}))


if __name__ == '__main__':
    main()
