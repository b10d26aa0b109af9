"""Pictures for people, and the camera images that policies see. They need OpenGL."""

from __future__ import annotations

from pathlib import Path

import comic
import comic.dm
import gymnasium
import numpy as np
import pytest
from conftest import SMALL
from gymnasium.utils.env_checker import check_env


def test_the_checker_accepts_pictures() -> None:
    arguments = {"render_mode": "rgb_array", "render_size": (64, 48)}
    with gymnasium.make("comic/Tracking-v0", disable_env_checker=True, **arguments) as environment:
        check_env(environment.unwrapped)
        assert environment.unwrapped.render().shape == (48, 64, 3)


@pytest.mark.parametrize("name", ["Gaps", "Walls"])
def test_the_checker_accepts_camera_images(name: str) -> None:
    with gymnasium.make(f"comic/{name}-v0", disable_env_checker=True) as environment:
        check_env(environment.unwrapped, skip_render_check=True)


def test_a_humanoid_is_seen_and_moves() -> None:
    environment = comic.Environment(render_mode="rgb_array", render_size=(96, 96), ghost="beside", termination_threshold=10.0)
    environment.reset(seed=1)
    first = environment.render()
    for _ in range(8):
        environment.step(np.zeros(56))
    second = environment.render()
    changed = np.abs(first.astype(int) - second).max(axis=2) > 30
    assert 0.005 < changed.mean() < 0.6


def test_camera_images_of_a_vector_are_those_of_its_environments() -> None:
    batch = comic.make_vec("gaps", num_envs=2, threads=2)
    observations, _ = batch.reset(seed=5)
    assert observations["image"].shape == (2, 64, 64, 3) and observations["image"].dtype == np.uint8
    for index in range(2):
        single, _ = comic.Environment("gaps").reset(seed=5 + index)
        np.testing.assert_array_equal(single["vector"], observations["vector"][index])
        np.testing.assert_array_equal(single["image"], observations["image"][index])


def test_dm_envs_adapter_has_the_camera() -> None:
    environment = comic.dm.Environment("walls", random_state=1)
    step = environment.reset()
    image = step.observation["walker/egocentric_camera"]
    environment.observation_spec()["walker/egocentric_camera"].validate(image)
    assert image.std() > 1


def test_a_camera_needs_no_image_where_the_experiment_has_none() -> None:
    environment = comic.Environment("gaps", gaps={"corridor": {"vision": "off"}})
    assert environment.observation_space.shape == (environment.reset()[0].shape[0],)


def test_a_policy_that_sees_acts_on_what_a_vector_observes(tmp_path: Path) -> None:
    list(comic.train("gaps", run=tmp_path / "run", actors=1, budget={"updates": 1}, **SMALL))
    policy = comic.load(tmp_path / "run")
    batch = comic.make_vec("gaps", num_envs=2, preset=policy.experiment)
    observations, _ = batch.reset(seed=5)
    actions = policy(observations, begins=np.ones(2, dtype=bool))
    batch.action_space.contains(actions) or pytest.fail("actions outside the space")
    black = observations | {"image": np.zeros_like(observations["image"])}
    assert np.abs(actions - policy(black, begins=np.ones(2, dtype=bool))).max() > 1e-6
