"""Several environments of one task, which step in native threads."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from comic import _native
from comic.environments import (
    ACTIONS,
    Action,
    Camera,
    Ghost,
    Observation,
    _parts,
    action_space,
    chosen_start,
    commands,
    fresh_seed,
    make_film,
    make_native,
    named_starts,
    native_seed,
    observation_space,
    whole,
)
from comic.experiment import Clips, Preset

__all__ = ["VectorEnvironment", "make_vec"]

Seeds = int | Sequence[int | None] | npt.NDArray[np.integer[Any]]


def make_vec(task: str = "tracking", num_envs: int = 1, **options: Any) -> VectorEnvironment:
    """Several environments of one task. The options are those of :class:`VectorEnvironment`."""
    return VectorEnvironment(task, num_envs=num_envs, **options)


class VectorEnvironment(VectorEnv[Observation, Action, npt.NDArray[Any]]):
    """Several environments of one task.

    A step runs in ``threads`` native threads and without Python's lock. The arrays it returns are new, and belong to the
    caller: float32 ``[N, size]`` for observations (a dictionary with ``image``, uint8 ``[N, 64, 64, 3]``, where the task
    has a camera), float64 ``[N]`` for rewards. Actions are ``[N, 56]``.

    ``info`` has arrays of N entries with the names of :class:`comic.Environment`'s, each with its mask as Gymnasium has
    it (``_clip`` for ``clip``). ``success`` and ``measures`` hold only for episodes that ended in this step. With
    ``SAME_STEP``, the last observation of an episode that ended is in ``final_obs``, and its ``info`` in ``final_info``.

    Args:
        task: A task's name, see :data:`comic.TASKS`.
        num_envs: Number of environments.
        threads: Number of threads, by default the cores that this process may use.
        autoreset_mode: What happens after an episode's end, as Gymnasium defines it.
        preset: See :class:`comic.Environment`, like the rest.
    """

    def __init__(
        self,
        task: str = "tracking",
        *,
        num_envs: int = 1,
        threads: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        preset: Preset | None = None,
        clips: Clips | None = None,
        render_mode: Literal["rgb_array"] | None = None,
        render_size: tuple[int, int] = (480, 480),
        camera: Camera = "tracking",
        ghost: Ghost | None = None,
        record_gradients: bool = False,
        **fields: Any,
    ) -> None:
        mode = AutoresetMode(autoreset_mode)
        num_envs = whole("num_envs", num_envs, 1, 2**20)
        self._native = make_native(
            task,
            [fresh_seed() for _ in range(num_envs)],
            preset=preset,
            clips=clips,
            threads=len(os.sched_getaffinity(0)) if threads is None else whole("threads", threads, 1, 2**20),
            autoreset=mode.value,
            record_gradients=record_gradients,
            **fields,
        )
        self._mode = mode
        self._clips = np.array(self._native.clips)
        self._everywhere = np.ones(num_envs, dtype=np.bool_)
        self._film = make_film(render_mode, render_size, camera, ghost)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(1 / self._native.control_timestep),
            "autoreset_mode": mode,
        }
        self.single_observation_space = observation_space(self._native)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_names = _parts(self._native)

    @property
    def clips(self) -> list[str]:
        """Names of the clips."""
        return self._native.clips

    @property
    def starts(self) -> list[tuple[str, int, int, float]]:
        """Where episodes can start: clip, first frame, end (excluded), probability of the clip."""
        return named_starts(self._native)

    def reset(
        self, *, seed: Seeds | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode in each environment.

        Args:
            seed: With a number s, environment k has the seed s + k.
            options: ``reset_mask``, bool ``[N]``, chooses the environments; ``clip`` and ``start`` are as in
                :meth:`comic.Environment.reset`, for all of them.
        """
        seeds: list[int | None]
        if seed is None:
            seeds = [None] * self.num_envs
        elif isinstance(seed, (Sequence, np.ndarray)):
            seeds = [native_seed(each) for each in seed]
        else:
            first = whole("seed", seed, 0, None)
            super().reset(seed=first)
            seeds = [native_seed(first + index) for index in range(self.num_envs)]
        mask = self._everywhere if options is None else np.asarray(options.get("reset_mask", self._everywhere))
        if mask.dtype != np.bool_:
            raise _native.Error(f"reset_mask: its type is {mask.dtype}; give an array of bool")
        answer = self._native.reset(mask.tolist(), seeds, chosen_start(self._native, options))
        return self._observation(answer), self._episodes(answer, mask, "")

    def step(
        self, actions: Action
    ) -> tuple[Observation, npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], dict[str, Any]]:
        """One control step of every environment."""
        answer = self._native.step(commands(actions, (self.num_envs, ACTIONS)))
        terminated, truncated = answer["terminated"], answer["truncated"]
        ended = terminated | truncated
        info = self._episodes(answer, self._everywhere, "") | self._step(answer, self._everywhere)
        if ended.any():
            achieved = self._masked(
                {"success": answer["success"], "measures": self._masked(answer["measures"], ended)}, ended
            )
            if self._mode is AutoresetMode.SAME_STEP:
                last = self._step(answer, ended) | self._episodes(answer, ended, "final_") | achieved
                info |= self._masked({"final_obs": self._last(answer, ended), "final_info": last}, ended)
            else:
                info |= achieved
        return self._observation(answer), answer["reward"], terminated, truncated, info

    def action_gradient(self) -> npt.NDArray[np.float32]:
        """The simulator's derivative of the rewards with respect to the actions, ``[N, T, 56]``.

        See :meth:`comic.Environment.action_gradient`. The row of a step that only reset its environment is 0, and no
        derivative reaches from one episode into another.
        """
        return self._native.take_gradients()

    def state(self, index: int = 0) -> dict[str, npt.NDArray[np.float64]]:
        """``qpos``, ``qvel`` and ``act`` of environment ``index``, in MuJoCo's order."""
        return dict(zip(("qpos", "qvel", "act"), map(np.asarray, self._native.state(index)), strict=True))

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:
        """A picture of each environment, uint8 ``[height, width, 3]``; ``None`` without a ``render_mode``."""
        film = self._film
        return None if film is None else tuple(film.draw(self._native, index) for index in range(self.num_envs))

    def _observation(self, answer: Mapping[str, Any]) -> Observation:
        if "image" in answer:
            return {"vector": answer["observation"], "image": answer["image"]}
        vector: npt.NDArray[np.float32] = answer["observation"]
        return vector

    def _last(self, answer: Mapping[str, Any], ended: npt.NDArray[np.bool_]) -> npt.NDArray[np.object_]:
        """The last observations of the episodes that ended, ``None`` elsewhere."""
        last = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(ended):
            vector = answer["final_observation"][index]
            has_image = "final_image" in answer
            last[index] = {"vector": vector, "image": answer["final_image"][index]} if has_image else vector
        return last

    def _episodes(self, answer: Mapping[str, Any], mask: npt.NDArray[np.bool_], prefix: str) -> dict[str, Any]:
        values = {"clip": self._clips[answer[f"{prefix}clip"]], "start": answer[f"{prefix}start"]}
        return self._masked(values, mask)

    def _step(self, answer: Mapping[str, Any], mask: npt.NDArray[np.bool_]) -> dict[str, Any]:
        terms = dict(zip(self._native.reward_terms, answer["reward_terms"].T, strict=True))
        names = ("terminated", "truncated", "diverged", "head_height")
        values = {"reward_terms": self._masked(terms, mask)} | {name: answer[name] for name in names}
        return self._masked(values, mask)

    @staticmethod
    def _masked(values: Mapping[str, Any], mask: npt.NDArray[np.bool_]) -> dict[str, Any]:
        return dict(values) | {f"_{name}": mask for name in values}
