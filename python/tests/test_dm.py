"""The adapter for dm_env, beside dm_control's own environments."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")

import comic
import comic.dm
import numpy as np
import pytest
from dm_control import composer
from dm_control.locomotion import arenas
from dm_control.locomotion.tasks import go_to_target
from dm_control.locomotion.tasks.reference_pose import tracking, types
from dm_control.locomotion.walkers import cmu_humanoid


def their_tracking(clips: Path) -> Any:
    walker = cmu_humanoid.CMUHumanoidPositionControlledV2020
    return tracking.MultiClipMocapTracking(
        walker,
        arenas.Floor(),
        ref_path=str(clips),
        ref_steps=(1, 2, 3, 4, 5),
        dataset=types.ClipCollection(ids=("CMU_007_01",), start_steps=(30,)),
        always_init_at_clip_start=True,
        reward_type="comic",
    )


def their_go_to_target(_: Path) -> Any:
    walker = cmu_humanoid.CMUHumanoidPositionControlledV2020()
    return go_to_target.GoToTarget(walker, arenas.Floor(), physics_timestep=0.005, control_timestep=0.03)


@pytest.mark.parametrize(("task", "make"), [("tracking", their_tracking), ("go-to-target", their_go_to_target)])
def test_names_and_specs_are_dm_controls(task: str, make: Any, tmp_path: Path) -> None:
    clips = tmp_path / "walk.h5"
    comic.clips.merge("builtin:walk", clips)
    theirs = composer.Environment(make(clips), strip_singleton_obs_buffer_dim=True)
    ours = comic.dm.Environment(task, clips="builtin:walk", random_state=1)
    expected = theirs.observation_spec()
    # The policies do not see all that dm_control observes.
    for name, spec in ours.observation_spec().items():
        assert spec.shape == (int(np.prod(expected[name].shape)),), name
    action, other = ours.action_spec(), theirs.action_spec()
    assert (action.shape, action.dtype, action.name) == (other.shape, other.dtype, other.name)
    np.testing.assert_array_equal(action.minimum, other.minimum)
    np.testing.assert_array_equal(action.maximum, other.maximum)
    assert ours.reward_spec().shape == theirs.reward_spec().shape
    assert ours.discount_spec() == theirs.discount_spec()


def test_an_episode_has_dm_envs_steps() -> None:
    environment = comic.dm.Environment(clips="builtin:walk", random_state=1)
    first = environment.step(np.zeros(56))
    assert first.first() and first.reward is None and first.discount is None
    steps = 0
    last = first
    while not last.last():
        last = environment.step(np.random.default_rng(steps).uniform(-1, 1, 56))
        steps += 1
        for name, spec in environment.observation_spec().items():
            spec.validate(last.observation[name])
    assert steps > 1 and last.discount == 0
    assert environment.step(np.zeros(56)).first()


def test_a_seed_decides_the_episodes() -> None:
    one, other = (comic.dm.Environment(clips="builtin:walk", random_state=4) for _ in range(2))
    for _ in range(3):
        mine, theirs = one.reset().observation, other.reset().observation
        assert all(np.array_equal(mine[name], theirs[name]) for name in mine)
