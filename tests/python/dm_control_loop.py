"""How fast dm_control's own tracking loop is, as shipped: what `actor.env` of `cargo xtask bench actor` stands against.

usage: dm_control_loop.py CLIPS.h5 [--seconds 20] [--seed 1]
Uniform random actions, resets included, the example's settings (recompiling at every reset is dm_control's default).
Prints one JSON line: control steps per second of this one process.
"""
import argparse
import json
import time
import warnings

warnings.simplefilter('ignore')

import h5py  # noqa: E402
import numpy as np  # noqa: E402
from dm_control import composer  # noqa: E402
from dm_control.locomotion import arenas  # noqa: E402
from dm_control.locomotion.tasks.reference_pose import tracking, types  # noqa: E402
from dm_control.locomotion.walkers import cmu_humanoid  # noqa: E402


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('clips')
    parser.add_argument('--seconds', type=float, default=20)
    parser.add_argument('--seed', type=int, default=1)
    arguments = parser.parse_args()
    with h5py.File(arguments.clips) as file:
        names = tuple(file)
    task = tracking.MultiClipMocapTracking(
        walker=cmu_humanoid.CMUHumanoidPositionControlledV2020, arena=arenas.Floor(), ref_path=arguments.clips,
        ref_steps=(1, 2, 3, 4, 5), dataset=types.ClipCollection(ids=names), min_steps=10, reward_type='comic')
    environment = composer.Environment(task=task, time_limit=30, random_state=arguments.seed,
                                       strip_singleton_obs_buffer_dim=True)
    random = np.random.RandomState(arguments.seed)
    environment.reset()
    steps, start = 0, time.time()
    while time.time() - start < arguments.seconds:
        steps += 1
        if environment.step(random.uniform(-1, 1, 56)).last():
            environment.reset()
    print(json.dumps({'steps_per_second': steps / (time.time() - start), 'seconds': arguments.seconds}))


if __name__ == '__main__':
    main()
