"""The derivative of the rewards with respect to the actions."""

from __future__ import annotations

from typing import Any

import comic
import numpy as np
import pytest

STEPS = 6
# What is differentiated is then the reward itself, and all later rewards count alike.
GRADIENT = {
    "decay": 1.0,
    "root_velocity": 0.0,
    "appendages": 1.0,
    "body_quaternions": 1.0,
    "center_of_mass": 1.0,
    "joints_velocity": 1.0,
}
FIELDS: dict[str, Any] = {
    "clips": "builtin:walk",
    "tracking": {"termination_threshold": 10.0, "gradient": GRADIENT},
}
START = {"clip": "CMU_007_01", "start": 20}


def returns(environment: comic.Environment, actions: np.ndarray) -> float:
    environment.reset(options=START)
    return sum(environment.step(action)[1] for action in actions)


def test_it_has_the_direction_and_size_of_finite_differences() -> None:
    environment = comic.Environment(record_gradients=True, **FIELDS)
    (clip,) = comic.clips.read("builtin:walk")
    actions = comic.clips.pose_to_action(clip.joints[21 : 21 + STEPS])
    returns(environment, actions)
    gradient = environment.action_gradient()
    assert gradient.shape == (STEPS, 56)
    step = 1e-4
    differences = np.zeros((2, 56))
    environment = comic.Environment(**FIELDS)
    for index in np.ndindex(2, 56):
        for sign in (1, -1):
            moved = actions.copy()
            moved[index] += sign * step
            differences[index] += sign * returns(environment, moved) / (2 * step)
    ours, theirs = gradient[:2].ravel(), differences.ravel()
    cosine = ours @ theirs / np.linalg.norm(ours) / np.linalg.norm(theirs)
    print(f"cosine {cosine:.3f}, ratio of norms {np.linalg.norm(ours) / np.linalg.norm(theirs):.3f}")
    assert cosine > 0.9
    assert 0.6 < np.linalg.norm(ours) / np.linalg.norm(theirs) < 1.6


def test_a_batch_has_the_derivatives_of_its_environments() -> None:
    single = comic.Environment(record_gradients=True, **FIELDS)
    batch = comic.make_vec(num_envs=3, threads=2, record_gradients=True, **FIELDS)
    actions = np.random.default_rng(4).normal(0, 0.1, (STEPS, 3, 56))
    batch.reset(options=START)
    for step in actions:
        batch.step(step)
    gradients = batch.action_gradient()
    assert gradients.shape == (3, STEPS, 56)
    for index in range(3):
        returns(single, actions[:, index])
        np.testing.assert_array_equal(single.action_gradient(), gradients[index])
    assert batch.action_gradient().shape == (3, 0, 56)


def test_the_row_of_a_step_that_only_reset_is_zero() -> None:
    batch = comic.make_vec(num_envs=1, record_gradients=True, clips="builtin:walk")
    batch.reset(options={"clip": 0, "start": batch.starts[0][2] - 1})
    ended = []
    while not any(ended):
        _, _, terminated, truncated, _ = batch.step(np.zeros((1, 56)))
        ended.append(bool(terminated[0] | truncated[0]))
    batch.step(np.zeros((1, 56)))
    batch.step(np.zeros((1, 56)))
    gradient = batch.action_gradient()[0]
    assert [bool(row.any()) for row in gradient] == [True] * len(ended) + [False, True]


def test_it_says_why_there_is_none() -> None:
    with pytest.raises(RuntimeError, match="record_gradients=True"):
        comic.Environment().action_gradient()


def test_a_recording_has_a_longest_length() -> None:
    environments = comic.make_vec(record_gradients=True, clips="builtin:walk")
    environments.reset()
    for _ in range(512):
        environments.step(np.zeros((1, 56)))
    with pytest.raises(RuntimeError, match="512 steps are recorded; call it before the next step"):
        environments.step(np.zeros((1, 56)))
    assert environments.action_gradient().shape == (1, 512, 56)
    environments.step(np.zeros((1, 56)))
