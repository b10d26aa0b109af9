"""How fast dm_control's own loops are, as shipped: what `actor.env` of `cargo xtask bench actor --task T` stands against.

usage: dm_control_loop.py [--task tracking --clips CLIPS.h5 | go-to-target | gaps | walls] [--camera] [--seconds 20]
Uniform random actions, resets included, the published examples' settings (a corridor's arena is compiled at every
reset). --camera leaves the corridors' egocentric camera on, as the examples have it, and needs OpenGL.
Prints one JSON line: control steps per second of this one process.
"""
import argparse
import json
import os
import sys
import time
import warnings

warnings.simplefilter('ignore')
# Only the camera needs OpenGL.
os.environ.setdefault('MUJOCO_GL', 'egl' if '--camera' in sys.argv else 'disable')

import bind_lxml  # noqa: E402, F401
import h5py  # noqa: E402
import numpy as np  # noqa: E402
from dm_control import composer  # noqa: E402
from dm_control.composer.variation import distributions  # noqa: E402
from dm_control.locomotion import arenas  # noqa: E402
from dm_control.locomotion.arenas import corridors as corridor_arenas  # noqa: E402
from dm_control.locomotion.tasks import corridors, go_to_target  # noqa: E402
from dm_control.locomotion.tasks.reference_pose import tracking, types  # noqa: E402
from dm_control.locomotion.walkers import cmu_humanoid  # noqa: E402

TIMESTEPS = {'physics_timestep': 0.005, 'control_timestep': 0.03}


def tracking_task(arguments):
    with h5py.File(arguments.clips) as file:
        names = tuple(file)
    return 30, tracking.MultiClipMocapTracking(
        walker=cmu_humanoid.CMUHumanoidPositionControlledV2020, arena=arenas.Floor(), ref_path=arguments.clips,
        ref_steps=(1, 2, 3, 4, 5), dataset=types.ClipCollection(ids=names), min_steps=10, reward_type='comic')


def go_to_target_task(_):
    return 30, go_to_target.GoToTarget(
        walker=cmu_humanoid.CMUHumanoidPositionControlledV2020(), arena=arenas.Floor(), **TIMESTEPS)


def corridor_task(arena, camera):
    walker = cmu_humanoid.CMUHumanoidPositionControlledV2020()
    walker.observables.egocentric_camera.enabled = camera
    return 30, corridors.RunThroughCorridor(
        walker=walker, arena=arena, walker_spawn_position=(0.5, 0, 0), target_velocity=3.0, **TIMESTEPS)


def gaps_task(arguments):
    # basic_cmu_2019.cmu_humanoid_run_gaps
    return corridor_task(corridor_arenas.GapsCorridor(
        platform_length=distributions.Uniform(.3, 2.5), gap_length=distributions.Uniform(.5, 1.25),
        corridor_width=10, corridor_length=100), arguments.camera)


def walls_task(arguments):
    # basic_cmu_2019.cmu_humanoid_run_walls
    return corridor_task(corridor_arenas.WallsCorridor(
        wall_gap=4., wall_width=distributions.Uniform(1, 7), wall_height=3.0, corridor_width=10, corridor_length=100,
        include_initial_padding=False), arguments.camera)


TASKS = {'tracking': tracking_task, 'go-to-target': go_to_target_task, 'gaps': gaps_task, 'walls': walls_task}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', choices=TASKS, default='tracking')
    parser.add_argument('--clips')
    parser.add_argument('--camera', action='store_true')
    parser.add_argument('--seconds', type=float, default=20)
    parser.add_argument('--seed', type=int, default=1)
    arguments = parser.parse_args()
    if arguments.task == 'tracking' and not arguments.clips:
        parser.error('tracking needs --clips CLIPS.h5')
    time_limit, task = TASKS[arguments.task](arguments)
    environment = composer.Environment(
        task=task, time_limit=time_limit, random_state=arguments.seed, strip_singleton_obs_buffer_dim=True)
    random = np.random.RandomState(arguments.seed)
    environment.reset()
    steps, start = 0, time.time()
    while time.time() - start < arguments.seconds:
        steps += 1
        if environment.step(random.uniform(-1, 1, 56)).last():
            environment.reset()
    print(json.dumps({
        'task': arguments.task, 'steps_per_second': steps / (time.time() - start), 'seconds': arguments.seconds}))


if __name__ == '__main__':
    main()
