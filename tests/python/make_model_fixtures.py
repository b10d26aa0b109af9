"""dm_control's compiled models and camera images, to compare another implementation with.

    MUJOCO_GL=egl python tests/python/make_model_fixtures.py --seed 1 --out tests/fixtures/golden/models

Needs requirements-tracking.txt, and OpenGL through EGL for the images. It writes

* `tracking_model.npz`, `tracking2019_model.npz` (the V2019 body), `go_to_target_model.npz`, `gaps_model.npz`,
  `walls_model.npz`: every numeric array and size of MuJoCo's compiled model, by its name in mjModel.
* `gaps_arena.json`, `walls_arena.json`: the arenas of the last two, as `make_task_fixtures.py` describes them.
* `gaps_camera.npz`, `walls_camera.npz`: rgb [64, 64, 3], the egocentric camera after a reset.
"""

import argparse
import json
import os
import pathlib

os.environ.setdefault("MUJOCO_GL", "egl")

import bind_lxml  # noqa: F401
import numpy as np
from dm_control import composer
from dm_control.locomotion import arenas, mocap
from dm_control.locomotion.tasks import corridors, go_to_target
from dm_control.locomotion.tasks.reference_pose import tracking, types
from dm_control.locomotion.walkers import cmu_humanoid
from make_task_fixtures import TIMESTEPS, arena_geoms, corridor_arena
from make_tracking_fixtures import CLIPS_2019, CLIPS_2020, REFERENCE_STEPS

V2020 = cmu_humanoid.CMUHumanoidPositionControlledV2020
V2019 = cmu_humanoid.CMUHumanoidPositionControlled
CORRIDORS = ("gaps", "walls")
CORRIDOR_LENGTH = 100  # m, dm_control's
# Names, images and what follows from them; `bvh_aabb` holds numbers that are not initialised.
LEFT_OUT = ("names", "names_map", "paths", "signature", "tex_data", "text_data", "bvh_aabb")


def arrays(made):
    model = made.physics.model.ptr
    named = ((name, getattr(model, name)) for name in dir(model) if not name.startswith("_") and name not in LEFT_OUT)
    return {name: np.array(value) for name, value in named if isinstance(value, (np.ndarray, int, float))}


def tracking_task(walker, path, ids):
    return tracking.MultiClipMocapTracking(
        walker=walker,
        arena=arenas.Floor(),
        ref_path=str(path),
        ref_steps=REFERENCE_STEPS,
        min_steps=1,
        dataset=types.ClipCollection(ids=ids),
        reward_type="comic",
    )


def corridor_task(kind):
    walker = V2020()
    walker.observables.egocentric_camera.enabled = False
    return corridors.RunThroughCorridor(
        walker=walker,
        arena=corridor_arena(kind, CORRIDOR_LENGTH),
        walker_spawn_position=(0.5, 0, 0),
        target_velocity=3.0,
        **TIMESTEPS,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1, help="of the arenas")
    parser.add_argument("--out", type=pathlib.Path, required=True, help="folder to write into")
    arguments = parser.parse_args()
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)

    drawn = pathlib.Path(__file__).parent / "../fixtures/golden/synthetic_v2020.h5"
    test_clips = pathlib.Path(mocap.__file__).parent / "test_trajectories.h5"
    tasks = {
        "tracking": tracking_task(V2020, drawn, CLIPS_2020),
        "tracking2019": tracking_task(V2019, test_clips, CLIPS_2019),
        "go_to_target": go_to_target.GoToTarget(walker=V2020(), arena=arenas.Floor(), **TIMESTEPS),
        **{kind: corridor_task(kind) for kind in CORRIDORS},
    }
    for name, task in tasks.items():
        made = composer.Environment(task=task, random_state=arguments.seed)
        if name in CORRIDORS:
            made.reset()  # draws the arena; in go-to-target it would move the target
        np.savez_compressed(out / f"{name}_model.npz", **arrays(made))
        if name in CORRIDORS:
            (out / f"{name}_arena.json").write_text(json.dumps(arena_geoms(made.physics.model.ptr), indent=0))
            options = task._walker.observables.egocentric_camera.scene_option
            image = made.physics.render(64, 64, "walker/egocentric", scene_option=options)
            np.savez_compressed(out / f"{name}_camera.npz", rgb=image)
        print(f"{name}: {made.physics.model.ptr.ngeom} geoms")


if __name__ == "__main__":
    main()
