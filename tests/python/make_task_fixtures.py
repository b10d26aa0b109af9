"""Rollouts of dm_control's own go-to-target and corridor tasks, to compare another implementation with.

    python tests/python/make_task_fixtures.py --seed 1 --out tests/fixtures/golden

Needs requirements-tracking.txt and nothing from this repository. The seed decides everything that is drawn. It writes

* `go_to_target_*.npz`: a target that is never reached, and near targets, which move after ten rewarded steps each.
* `gaps_rollout.npz`, `walls_rollout.npz`, and the arena of each, `*_arena.json`: a list of the
  arena's geoms with name, body, position, half sizes and colour, the ground plane first.

A rollout of N steps holds what those of `make_tracking_fixtures.py` hold for every task (obs_layout, obs, qpos, qvel,
act, sensordata, time, ncon, reward, discount, step_type, actions, qacc_warmstart_after_reset), and

    go-to-target: spawn [2], rotation; target [N+1, 3], counter, disallowed, distance [N+1]
    corridors:    xvel, disallowed [N+1], ee_z [N+1, 4]; observations without the camera
"""

import argparse
import json
import os
import pathlib

os.environ.setdefault("MUJOCO_GL", "disable")

import numpy as np
from dm_control import composer
from dm_control.composer.variation import colors, distributions
from dm_control.locomotion import arenas
from dm_control.locomotion.arenas import corridors as corridor_arenas
from dm_control.locomotion.tasks import corridors, go_to_target
from dm_control.locomotion.walkers import cmu_humanoid
from make_tracking_fixtures import row

STEPS = 24
TIMESTEPS = {"physics_timestep": 0.005, "control_timestep": 0.03}  # s


def disallowed(task, physics):
    """Contacts between the ground and a part that is no foot."""
    return np.int64(sum(task._is_disallowed_contact(contact) for contact in physics.data.contact))


class GoToTarget(go_to_target.GoToTarget):
    def measurements(self, physics):
        target = np.array(physics.model.ptr.site("target").pos)
        root = physics.data.ptr.body("walker/root").xpos
        return {
            "target": target,
            "counter": np.int64(self._reward_step_counter),
            "distance": np.linalg.norm(target[:2] - root[:2]),
            "disallowed": disallowed(self, physics),
        }


class Corridor(corridors.RunThroughCorridor):
    def measurements(self, physics):
        return {
            "xvel": np.float64(physics.bind(self._walker.root_body).subtree_linvel[0]),
            "ee_z": np.array(physics.bind(self._walker.end_effectors).xpos[:, -1]),
            "disallowed": disallowed(self, physics),
        }


def rollout(environment, actions):
    """A rollout over `actions`; returns the arrays of the module's docstring."""
    task, physics = environment.task, lambda: environment.physics
    # `row` calls `measurements` without arguments, since tracking needs no physics for it.
    measure = task.measurements
    task.measurements = lambda: measure(physics())
    timestep = environment.reset()
    layout = [[name, int(np.size(value))] for name, value in timestep.observation.items()]
    warm_start = np.array(environment.physics.data.qacc_warmstart)
    rows = [row(environment, timestep)]
    for action in actions:
        timestep = environment.step(action)
        environment._reset_next_step = False  # continue after a failure: more states to compare
        rows.append(row(environment, timestep))
    return {
        "obs_layout": np.array(json.dumps(layout)),
        **{name: np.stack([r[name] for r in rows]) for name in rows[0]},
        "actions": np.array(actions),
        "qacc_warmstart_after_reset": warm_start,
    }


def go_to_target_rollout(target, spawn, rotation, seed, actions):
    task = GoToTarget(
        walker=cmu_humanoid.CMUHumanoidPositionControlledV2020(),
        arena=arenas.Floor(),
        moving_target=True,
        target_spawn_position=target,
        walker_spawn_position=spawn,
        walker_spawn_rotation=rotation,
        **TIMESTEPS,
    )
    environment = composer.Environment(
        task=task, time_limit=25, random_state=seed, strip_singleton_obs_buffer_dim=True
    )
    return {"spawn": np.array(spawn), "rotation": np.float64(rotation), **rollout(environment, actions)}


def arena_geoms(model):
    """The geoms that are not the walker's, the ground plane first."""
    return [
        {
            "name": model.geom(g).name,
            "body": model.body(model.geom_bodyid[g]).name,
            "pos": model.geom_pos[g].tolist(),
            "size": model.geom_size[g].tolist(),
            "rgba": [float(channel) for channel in model.geom_rgba[g]],
        }
        for g in range(model.ngeom)
        if not model.geom(g).name.startswith("walker/")
    ]


def corridor_arena(kind, length):
    """An arena with the supplement's ranges, `length` m long."""
    if kind == "gaps":
        return corridor_arenas.GapsCorridor(
            platform_length=distributions.Uniform(0.3, 2.5),
            gap_length=distributions.Uniform(0.75, 1.25),
            corridor_width=10,
            corridor_length=length,
        )
    unit = distributions.Uniform(0.0, 1.0)
    return corridor_arenas.WallsCorridor(
        wall_gap=5.0,
        wall_width=distributions.Uniform(1, 7),
        wall_height=distributions.Uniform(2.5, 4.0),
        swap_wall_side=distributions.Bernoulli(0.5),
        wall_rgba=colors.RgbVariation(unit, unit, unit, 1.0),
        corridor_width=10,
        corridor_length=length,
        include_initial_padding=False,
    )


def corridor_rollout(arena, seed, actions):
    walker = cmu_humanoid.CMUHumanoidPositionControlledV2020()
    task = Corridor(
        walker=walker, arena=arena, walker_spawn_position=(0.5, 0, 0), target_velocity=3.0, **TIMESTEPS
    )
    walker.observables.egocentric_camera.enabled = False
    environment = composer.Environment(
        task=task, time_limit=45, random_state=seed, strip_singleton_obs_buffer_dim=True
    )
    environment.reset()
    environment._recompile_mjcf_every_episode = False  # keep this arena
    geoms = arena_geoms(environment.physics.model.ptr)
    return geoms, rollout(environment, actions)


def summary(name, arrays):
    last = np.flatnonzero(arrays["step_type"] == 2)
    end = "no end" if not len(last) else f"ends at step {last[0]}"
    print(f"{name}: {len(arrays['actions'])} steps, {end}, return {np.nansum(arrays['reward']):.3f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder to write into")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    # Each rollout has its own stream, so a change to one does not change the others.
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(arguments.seed).spawn(4)]
    seeds = [int(stream.integers(2**31)) for stream in streams]
    actions = [stream.uniform(-0.2, 0.2, (STEPS, 56)) for stream in streams]

    far, near = streams[0], streams[1]
    near_targets = distributions.Uniform(-0.5 * np.ones(2), 0.5 * np.ones(2))
    rollouts = {
        "go_to_target_far": go_to_target_rollout(
            tuple(far.uniform(2, 4, 2)), tuple(far.uniform(-1, 1, 2)), far.uniform(-3, 3), seeds[0], actions[0]
        ),
        "go_to_target_near": go_to_target_rollout(
            near_targets, (0.0, 0.0), near.uniform(-3, 3), seeds[1], actions[1]
        ),
    }
    # A shorter corridor than dm_control's keeps the files small.
    for index, kind in enumerate(("gaps", "walls"), start=2):
        geoms, arrays = corridor_rollout(corridor_arena(kind, 20), seeds[index], actions[index])
        (arguments.out / f"{kind}_arena.json").write_text(json.dumps(geoms, indent=0))
        rollouts[f"{kind}_rollout"] = arrays
    for name, arrays in rollouts.items():
        np.savez_compressed(arguments.out / f"{name}.npz", **arrays)
        summary(name, arrays)


if __name__ == "__main__":
    main()
