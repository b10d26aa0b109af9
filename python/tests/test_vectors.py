"""Several environments: equal to single ones, in any number of threads, and with Gymnasium's rules of autoreset."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from typing import Any

import comic
import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

CLIPS = ["builtin:walk", "builtin:jump"]


def actions(step: int, count: int) -> np.ndarray:
    return np.random.default_rng(step).uniform(-1, 1, (count, 56)).astype(np.float32)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_it_does_what_gymnasiums_own_vector_of_single_environments_does(mode: AutoresetMode) -> None:
    ours = comic.make_vec(num_envs=3, threads=2, autoreset_mode=mode, clips=CLIPS)
    theirs = SyncVectorEnv([lambda: comic.Environment(clips=CLIPS)] * 3, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    (one, own), (other, info) = ours.reset(seed=9), theirs.reset(seed=9)
    np.testing.assert_array_equal(one, other)
    compare_info(own, info, ["clip", "start"])
    endings = 0
    for step in range(40):
        mine, reference = ours.step(actions(step, 3)), theirs.step(actions(step, 3))
        for own, expected in zip(mine[:4], reference[:4], strict=True):
            np.testing.assert_array_equal(own, expected)
        ended = mine[2] | mine[3]
        endings += int(ended.sum())
        compare_info(mine[4], reference[4], ["clip", "start"])
        if ended.any() and mode is AutoresetMode.SAME_STEP:
            for own, expected in zip(mine[4]["final_obs"], reference[4]["final_obs"], strict=True):
                assert (own is None) == (expected is None)
                if own is not None:
                    np.testing.assert_array_equal(own, expected)
            np.testing.assert_array_equal(mine[4]["_final_info"], reference[4]["_final_info"])
            names = ["clip", "start", "success", "terminated", "truncated", "head_height"]
            compare_info(mine[4]["final_info"], reference[4]["final_info"], names)
            compare_info(mine[4]["final_info"]["reward_terms"], reference[4]["final_info"]["reward_terms"], None)
        elif ended.any():
            compare_info(mine[4], reference[4], ["success", "head_height"])
    assert endings > 3


def compare_info(own: dict[str, Any], expected: dict[str, Any], names: list[str] | None) -> None:
    for name in [name for name in expected if not name.startswith("_")] if names is None else names:
        mask = expected[f"_{name}"]
        assert not (mask & ~own[f"_{name}"]).any(), name
        np.testing.assert_array_equal(np.asarray(own[name])[mask], np.asarray(expected[name])[mask], name)


def test_threads_do_not_change_anything() -> None:
    def rollout(threads: int) -> list[Any]:
        environments = comic.make_vec(num_envs=5, threads=threads, clips=CLIPS)
        seen = [environments.reset(seed=3)[0]]
        for step in range(25):
            seen += environments.step(actions(step, 5))[:4]
        return seen

    for one, other in zip(rollout(1), rollout(4), strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_observation_that_was_given_never_changes_and_is_not_a_copy() -> None:
    environments = comic.make_vec(num_envs=2, clips="builtin:walk")
    first, _ = environments.reset(seed=1)
    kept = first.copy()
    second = environments.step(actions(0, 2))[0]
    gc.collect()
    np.testing.assert_array_equal(first, kept)
    assert not np.shares_memory(first, second)
    assert first.flags.c_contiguous and first.flags.writeable and first.dtype == np.float32


def test_other_python_threads_run_during_a_step() -> None:
    environments = comic.make_vec(num_envs=64, threads=1, clips="builtin:walk")
    environments.reset(seed=1)
    counted, stop = [0], threading.Event()

    def count() -> None:
        while not stop.is_set():
            counted[0] += 1
            time.sleep(0)

    counter = threading.Thread(target=count)
    counter.start()
    # A step that held the lock would let the other thread count once at most.
    before = counted[0]
    environments.step(actions(0, 64))
    during = counted[0] - before
    stop.set()
    counter.join()
    assert during > 20


def test_the_owner_resets_some_where_autoreset_is_disabled() -> None:
    environments = comic.make_vec(num_envs=3, autoreset_mode="Disabled", clips="builtin:walk")
    environments.reset(seed=1)
    terminated = np.zeros(3, bool)
    while not terminated.any():
        observations, _, terminated, truncated, _ = environments.step(np.zeros((3, 56)))
        terminated |= truncated
    with pytest.raises(comic.Error, match="is over: reset it first"):
        environments.step(np.zeros((3, 56)))
    after, info = environments.reset(options={"reset_mask": terminated})
    np.testing.assert_array_equal((after == observations).all(axis=1), ~terminated)
    np.testing.assert_array_equal(info["_clip"], terminated)
    environments.step(np.zeros((3, 56)))


def test_gymnasium_makes_a_vector_by_its_name() -> None:
    environments = gymnasium.make_vec("comic/GetUp-v0", num_envs=2, vectorization_mode="vector_entry_point")
    assert isinstance(environments.unwrapped, comic.VectorEnvironment)
    observations, _ = environments.reset(seed=1)
    assert environments.observation_space.contains(observations)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs: 0; give a whole number from 1"),
        ({"threads": 0.5}, "threads: 0.5; give a whole number from 1"),
        ({"autoreset_mode": "Never"}, "Never"),
    ],
)
def test_a_wrong_argument_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        comic.make_vec(**arguments)


def test_arrays_of_another_size_are_refused() -> None:
    environments = comic.make_vec(num_envs=2, clips="builtin:walk")
    environments.reset()
    with pytest.raises(comic.Error, match=r"its shape is \(3, 56\); give \(2, 56\)"):
        environments.step(np.zeros((3, 56)))
    with pytest.raises(comic.Error, match="there are 2 environments"):
        environments.reset(seed=[1])
    with pytest.raises(comic.Error, match="seed: -1; give a whole number from 0"):
        environments.reset(seed=[1, -1])
    with pytest.raises(comic.Error, match="give an array of bool"):
        environments.reset(options={"reset_mask": np.ones(2)})


def test_the_order_of_actions_in_memory_does_not_matter() -> None:
    environments = comic.make_vec(num_envs=3, clips="builtin:walk")
    rows = np.random.default_rng(2).uniform(-1, 1, (3, 56))
    rewards = []
    for action in [rows, np.asfortranarray(rows), np.repeat(rows, 2, axis=1)[:, ::2], rows.astype(">f8"), rows.tolist()]:
        environments.reset(seed=1)
        rewards.append(environments.step(action)[1])
    assert (rewards == rewards[0]).all()


def test_a_fork_is_told_that_it_has_no_threads() -> None:
    environments = comic.make_vec(num_envs=2, threads=2, clips="builtin:walk")
    child = os.fork()
    if child == 0:
        # Without an answer the alarm ends the child.
        signal.alarm(10)
        try:
            environments.reset()
        except RuntimeError as error:
            os._exit(0 if "after the fork" in str(error) else 2)
        os._exit(1)
    assert os.waitpid(child, 0)[1] == 0
