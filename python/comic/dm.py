"""The environments for code that is written for ``dm_env``; needs ``pip install comic-rl[dm-env]``."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import dm_env
import numpy as np
import numpy.typing as npt
from dm_env import specs

from comic import _native
from comic.environments import ACTIONS, IMAGE_SHAPE, commands, fresh_seed, make_native, native_seed
from comic.experiment import Clips, Preset

__all__ = ["Environment"]

_CAMERA = "walker/egocentric_camera"


class Environment(dm_env.Environment):  # type: ignore[misc]
    """One environment with the names and specs of dm_control's ``composer.Environment``.

    Each part of an observation has its own name: ``walker/joints_pos``, and so on. Values are what the tasks compute in
    double precision, rounded to single precision as the policies see them.

    Args:
        task: A task's name, see :data:`comic.TASKS`.
        random_state: The seed.
        preset: See :class:`comic.Environment`, like the rest.
    """

    def __init__(
        self,
        task: str = "tracking",
        *,
        random_state: int | None = None,
        preset: Preset | None = None,
        clips: Clips | None = None,
        **fields: Any,
    ) -> None:
        seed = native_seed(random_state)
        seeds = [fresh_seed() if seed is None else seed]
        self._native = make_native(task, seeds, preset=preset, clips=clips, **fields)
        self._parts = [(f"walker/{name}", size) for name, size in self._native.observation_names]
        # dm_env's first step begins an episode, whatever it is.
        self._over = True

    def reset(self) -> dm_env.TimeStep:
        """Begins an episode."""
        self._over = False
        return dm_env.restart(self._observation(self._native.reset([True], [None], None)))

    def step(self, action: npt.ArrayLike) -> dm_env.TimeStep:
        """One control step; after an episode's end it begins a new episode."""
        if self._over:
            return self.reset()
        answer = self._native.step(commands(action, (ACTIONS,))[None])
        observation, reward = self._observation(answer), answer["reward"][0].item()
        self._over = bool(answer["terminated"][0] or answer["truncated"][0])
        if answer["terminated"][0]:
            return dm_env.termination(reward, observation)
        if answer["truncated"][0]:
            return dm_env.truncation(reward, observation)
        return dm_env.transition(reward, observation)

    def observation_spec(self) -> OrderedDict[str, specs.Array]:
        """An array for each part."""
        parts = OrderedDict((name, specs.Array((size,), np.float32, name)) for name, size in self._parts)
        if self._native.has_images:
            parts[_CAMERA] = specs.BoundedArray(IMAGE_SHAPE, np.uint8, 0, 255, _CAMERA)
        return parts

    def action_spec(self) -> specs.BoundedArray:
        """56 numbers within -1 ... 1, in control order."""
        names = "\t".join(f"walker/{name}" for name in _native.actuators())
        return specs.BoundedArray((ACTIONS,), np.float64, -1.0, 1.0, names)

    def _observation(self, answer: dict[str, Any]) -> OrderedDict[str, npt.NDArray[Any]]:
        row, begin = answer["observation"][0], 0
        observation = OrderedDict[str, npt.NDArray[Any]]()
        for name, size in self._parts:
            observation[name] = row[begin : begin + size]
            begin += size
        if self._native.has_images:
            observation[_CAMERA] = answer["image"][0]
        return observation
