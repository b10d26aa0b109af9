"""One environment, as Gymnasium has it."""

from __future__ import annotations

import operator
import secrets
from collections.abc import Mapping
from typing import Any, Literal

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from comic import _native, experiment
from comic.experiment import Clips, Preset

__all__ = ["IMAGE_SHAPE", "TASKS", "Environment", "observation_names", "register"]

Camera = Literal["tracking", "egocentric", "side"]
Ghost = Literal["on", "beside"]
Observation = Any
"""float32 ``[size]``, or a dictionary of ``vector`` and ``image``: the task decides."""
Action = npt.NDArray[Any]

TASKS: tuple[str, ...] = tuple(_native.tasks())
"""Names of the tasks, as experiments and command lines write them."""

IMAGE_SHAPE = (64, 64, 3)
"""Of a camera image: rows from the top, columns, and red, green, blue."""

ACTIONS = 56


def register() -> None:
    """Registers ``comic/Tracking-v0`` and the other tasks with Gymnasium."""
    for task in TASKS:
        name = "".join(word.capitalize() for word in task.split("-"))
        gymnasium.register(
            id=f"comic/{name}-v0",
            entry_point="comic.environments:Environment",
            vector_entry_point="comic.vector:VectorEnvironment",
            kwargs={"task": task},
        )


def observation_names(task: str = "tracking", **options: Any) -> dict[str, slice]:
    """Where each part of an observation vector lies, in order. The names are dm_control's without ``walker/``.

    ``observation[..., names["joints_pos"]]`` is a part. The arguments are those of :class:`Environment`.
    """
    return _parts(make_native(task, [0], **options))


class Environment(gymnasium.Env[Observation, Action]):
    """One environment.

    An observation is a float32 vector: proprioception, and then what the task observes
    (:func:`comic.observation_names`). With camera images it is a dictionary of ``vector`` and ``image`` (uint8,
    ``[64, 64, 3]``). An action has 56 entries, one for each actuator in control order; -1 ... 1 is the joint's range.

    ``info`` has, after a step:

    - ``reward_terms``: name and value. Their sum is the reward.
    - ``terminated``, ``truncated``, ``diverged``: A simulation that diverged has also terminated.
    - ``clip``, ``start``: The clip and the frame at which the episode began; in a task without clips the start is 0,
      or the episode's seed if there was one in ``options``.
    - ``head_height``: In metres. It is absent after a reset.
    - ``success`` and ``measures``: At the episode's end, by the task's own definition.

    Args:
        task: A task's name, see :data:`comic.TASKS`.
        preset: A preset's name, an experiment's file or an experiment, instead of the paper's values. The task is always ``task``.
        clips: Clips instead of the experiment's. Tasks without a reference take start poses from them.
        render_mode: ``"rgb_array"`` draws pictures. It needs EGL and no display.
        render_size: Width and height of a picture in pixels.
        camera: Where pictures are drawn from.
        ghost: Draws the reference with the humanoid, at its place or beside it.
        record_gradients: Makes :meth:`action_gradient` possible. A step then takes longer.
        **fields: Fields of the experiment, see :mod:`comic.experiment`.

    Raises:
        comic.Error: A field, a clip or a file is wrong.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 33}

    def __init__(
        self,
        task: str = "tracking",
        *,
        preset: Preset | None = None,
        clips: Clips | None = None,
        render_mode: Literal["rgb_array"] | None = None,
        render_size: tuple[int, int] = (480, 480),
        camera: Camera = "tracking",
        ghost: Ghost | None = None,
        record_gradients: bool = False,
        **fields: Any,
    ) -> None:
        seeds = [fresh_seed()]
        self._native = make_native(
            task, seeds, preset=preset, clips=clips, record_gradients=record_gradients, **fields
        )
        self.render_mode = render_mode
        self._film = make_film(render_mode, render_size, camera, ghost)
        self.metadata = {**self.metadata, "render_fps": round(1 / self._native.control_timestep)}
        self.observation_space = observation_space(self._native)
        self.action_space: spaces.Box = action_space()
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
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: All random numbers from now on are those of this seed.
            options: ``{"clip": NAME_OR_INDEX, "start": FRAME}`` begins there; either may be absent. In a task without
                clips the start is the seed of the episode.
        """
        super().reset(seed=seed)
        start = chosen_start(self._native, options)
        answer = self._native.reset([True], [native_seed(seed)], start)
        return self._observation(answer), self._info(answer)

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control step. MuJoCo clips actions outside -1 ... 1."""
        answer = self._native.step(commands(action, (ACTIONS,))[None])
        info = self._info(answer)
        info["reward_terms"] = dict(
            zip(self._native.reward_terms, answer["reward_terms"][0].tolist(), strict=True)
        )
        for name in ("terminated", "truncated", "diverged", "head_height"):
            info[name] = answer[name][0].item()
        if info["terminated"] or info["truncated"]:
            info["success"] = answer["success"][0].item()
            info["measures"] = {name: values[0].item() for name, values in answer["measures"].items()}
        reward = answer["reward"][0].item()
        return self._observation(answer), reward, info["terminated"], info["truncated"], info

    def action_gradient(self) -> npt.NDArray[np.float32]:
        """The simulator's derivative of the rewards with respect to the actions, ``[T, 56]``.

        Row t is the derivative of the reward of step t and of the later steps, for the T steps since the last call. It
        is what ``vmpo.action_gradient`` uses. Call it after at most 512 steps.

        Raises:
            RuntimeError: The environment was made without ``record_gradients``, the task has no derivative, or too many
                steps were taken.
        """
        gradients: npt.NDArray[np.float32] = self._native.take_gradients()[0]
        return gradients

    def state(self) -> dict[str, npt.NDArray[np.float64]]:
        """``qpos``, ``qvel`` and ``act`` of the simulation, in MuJoCo's order."""
        return dict(zip(("qpos", "qvel", "act"), map(np.asarray, self._native.state(0)), strict=True))

    def render(self) -> npt.NDArray[np.uint8] | None:
        """A picture, uint8 ``[height, width, 3]``; ``None`` without a ``render_mode``."""
        return None if self._film is None else self._film.draw(self._native, 0)

    def _observation(self, answer: Mapping[str, Any]) -> Observation:
        vector = answer["observation"][0]
        return {"vector": vector, "image": answer["image"][0]} if "image" in answer else vector

    def _info(self, answer: Mapping[str, Any]) -> dict[str, Any]:
        return {"clip": self._native.clips[answer["clip"][0]], "start": answer["start"][0].item()}


def make_native(
    task: str,
    seeds: list[int],
    *,
    preset: Preset | None = None,
    clips: Clips | None = None,
    threads: int = 1,
    autoreset: str = "Disabled",
    record_gradients: bool = False,
    **fields: Any,
) -> _native.Environments:
    """The native environments of a task."""
    resolved = experiment.resolve(preset, clips=clips, **fields, task=task)
    return _native.Environments(resolved.toml, seeds, threads, autoreset, record_gradients)


def make_film(
    render_mode: str | None, size: tuple[int, int], camera: Camera, ghost: Ghost | None
) -> _native.Film | None:
    """What draws pictures, for a render mode that has some."""
    match render_mode:
        case None:
            return None
        case "rgb_array":
            width, height = (whole("render_size", side, 16, 2048) for side in size)
            return _native.Film(width, height, camera, ghost)
    raise _native.Error(f"render_mode: no mode {render_mode!r}; give 'rgb_array' or None")


def observation_space(native: _native.Environments) -> spaces.Space[Any]:
    """The space of one environment's observations."""
    size = sum(size for _, size in native.observation_names)
    vector = spaces.Box(-np.inf, np.inf, (size,), np.float32)
    if not native.has_images:
        return vector
    return spaces.Dict({"vector": vector, "image": spaces.Box(0, 255, IMAGE_SHAPE, np.uint8)})


def action_space() -> spaces.Box:
    """The space of one environment's actions."""
    return spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)


def commands(action: npt.ArrayLike, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """An action in double precision, if it has the shape."""
    numbers = np.asarray(action, dtype=np.float64)
    if numbers.shape != shape:
        raise _native.Error(f"action: its shape is {numbers.shape}; give {shape}")
    return numbers


def named_starts(native: _native.Environments) -> list[tuple[str, int, int, float]]:
    """The starts with the clips' names."""
    return [(native.clips[clip], first, end, probability) for clip, first, end, probability in native.starts]


def chosen_start(native: _native.Environments, options: Mapping[str, Any] | None) -> tuple[int, int] | None:
    """The clip's index and the frame that a reset's options ask for."""
    chosen = {} if options is None else {name: options[name] for name in ("clip", "start") if name in options}
    if not chosen:
        return None
    clip = chosen.get("clip", 0)
    if isinstance(clip, str):
        if clip not in native.clips:
            raise _native.Error(f"clip: no clip {clip!r}; the clips are {', '.join(native.clips)}")
        clip = native.clips.index(clip)
    clip = whole("clip", clip, 0, len(native.clips) - 1)
    if "start" in chosen:
        return clip, whole("start", chosen["start"], 0, 2**31)
    return clip, next((first for other, first, *_ in native.starts if other == clip), 0)


def fresh_seed() -> int:
    """A seed that nobody has had before."""
    return secrets.randbits(63)


def native_seed(seed: int | None) -> int | None:
    """A seed in the native range."""
    return None if seed is None else whole("seed", seed, 0, None) % 2**64


def whole(name: str, value: Any, least: int, largest: int | None) -> int:
    """A whole number of this range."""
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or number < least or (largest is not None and number > largest):
        bound = "" if largest is None else f" to {largest}"
        raise _native.Error(f"{name}: {value!r}; give a whole number from {least}{bound}")
    return number


def _parts(native: _native.Environments) -> dict[str, slice]:
    parts, begin = {}, 0
    for name, size in native.observation_names:
        parts[name] = slice(begin, begin + size)
        begin += size
    return parts
