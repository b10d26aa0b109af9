"""An algorithm that others wrote learns on these environments."""

from __future__ import annotations

import ppo
import pytest


@pytest.mark.full
def test_ppo_of_stable_baselines3_learns_to_follow_a_walk() -> None:
    lines = ppo.learn("comic", 180, seed=1)
    first, last = lines[1], lines[-1]
    assert last["episode_return"] > 1.5 * first["episode_return"], (first, last)
