"""Policies that were exported as TorchScript."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from comic import _native, programs
from comic.experiment import Experiment

if TYPE_CHECKING:
    import torch

__all__ = ["Policy", "load"]


class Policy:
    """A policy without noise, for a batch of environments. It keeps the memory of each environment.

    Call it with the observations of N environments and get their actions::

        policy = comic.load("runs/mine")
        environments = comic.make_vec(policy.task, num_envs=16, autoreset_mode="SameStep", preset=policy.experiment)
        observations, _ = environments.reset()
        begins = None
        while True:
            observations, _, terminated, truncated, _ = environments.step(policy(observations, begins))
            begins = terminated | truncated

    With ``SAME_STEP`` an observation begins an episode where its own step ended one. With ``NEXT_STEP`` it does so where
    the step before ended one.
    """

    def __init__(self, module: torch.jit.ScriptModule, description: Mapping[str, Any]) -> None:
        inputs = description["inputs"]
        self._module = module
        self._proprioception, self._task = inputs[0]["size"], inputs[1]["size"]
        self._image = next((part["size"] for part in inputs if part["name"] == "image"), 0)
        self._memory_size = next(part["size"] for part in inputs if part["name"] == "recurrent_state")
        self._memory: torch.Tensor | None = None
        self.description = dict(description)

    @property
    def experiment(self) -> Experiment:
        """The experiment that the policy was trained with."""
        return Experiment(self.description["experiment"])

    @property
    def task(self) -> str:
        """The task's name."""
        return str(self.experiment.fields["task"])

    def reset(self) -> None:
        """Forgets all environments: the next call begins an episode in each."""
        self._memory = None

    def __call__(self, observations: Any, begins: npt.ArrayLike | None = None) -> npt.NDArray[np.float32]:
        """The actions, ``[N, 56]``, each within -1 ... 1; ``[56]`` for one observation without a batch.

        Args:
            observations: What the environments gave: ``[N, size]``, or a dictionary of ``vector`` and ``image``.
            begins: bool ``[N]``: where this observation is the first of an episode. At the first call, and after
                :meth:`reset`, it is so for all.
        """
        import torch

        vector = observations["vector"] if isinstance(observations, Mapping) else observations
        rows = torch.as_tensor(np.atleast_2d(np.asarray(vector, dtype=np.float32)))
        if rows.shape[-1] != self._proprioception + self._task:
            raise _native.Error(
                f"observations: {rows.shape[-1]} entries; the policy's task {self.task} has "
                f"{self._proprioception + self._task}: make the environment with preset=policy.experiment"
            )
        memory = self._memory_of(len(rows), begins)
        inputs = [rows[:, : self._proprioception], rows[:, self._proprioception :]]
        if self._image:
            if not isinstance(observations, Mapping):
                raise _native.Error("observations: this policy sees; give a dictionary of vector and image")
            image = np.ascontiguousarray(observations["image"], dtype=np.uint8)
            inputs.append(torch.as_tensor(image).reshape(len(rows), self._image))
        inputs.append(memory)
        with torch.inference_mode():
            try:
                output = self._module(*inputs)
            except RuntimeError as error:
                if not self._image:
                    raise
                # Until 0.1.0 a module took the image last.
                raise _native.Error(f"the policy cannot act: export it again with this release ({error})") from error
        actions, self._memory = output[:, : -self._memory_size or None], output[:, -self._memory_size :]
        numbers: npt.NDArray[np.float32] = actions.numpy()
        return numbers if np.ndim(vector) == 2 else numbers[0]

    def _memory_of(self, count: int, begins: npt.ArrayLike | None) -> torch.Tensor:
        import torch

        memory = self._memory
        if memory is None:
            memory = torch.zeros(count, self._memory_size)
        elif len(memory) != count:
            raise _native.Error(
                f"observations: {count} environments, and there were {len(memory)} before; call policy.reset() first"
            )
        elif begins is not None:
            continues = ~np.asarray(begins, dtype=np.bool_).reshape(count, 1)
            # Not by a product: a memory that is not finite must be forgotten, too.
            memory = torch.where(torch.as_tensor(continues), memory, torch.zeros(()))
        return memory


def load(path: str | PathLike[str]) -> Policy:
    """Reads a policy.

    Args:
        path: A file ``policy.pt`` that ``comic-learner export`` wrote; or a run's directory or a checkpoint, which the
            program exports first.

    Raises:
        comic.Error: The file is no policy, or the program is missing or refuses.
        ImportError: torch is missing: ``pip install comic-rl[torch]``.
    """
    path = Path(path)
    if not path.exists():
        raise _native.Error(f"{path}: there is no such file or directory")
    if path.is_dir():
        with tempfile.TemporaryDirectory() as directory:
            exported = Path(directory) / "policy.pt"
            arguments = ["export", "--part", "policy", "--checkpoint", str(path), "--out", str(exported)]
            programs.run("comic-learner", arguments)
            return _read(exported)
    return _read(path)


def _read(path: Path) -> Policy:
    import torch

    extra = {"comic.json": ""}
    try:
        with warnings.catch_warnings():
            # Newer versions of torch recommend another format to those who write files.
            warnings.simplefilter("ignore", FutureWarning)
            module: torch.jit.ScriptModule = torch.jit.load(  # type: ignore[no-untyped-call]
                str(path), map_location="cpu", _extra_files=extra
            )
        description = json.loads(extra["comic.json"])
    except (RuntimeError, ValueError) as error:
        raise _native.Error(
            f"{path}: it is no policy that `comic-learner export --part policy --out FILE.pt` wrote"
        ) from error
    return Policy(module.eval(), description)
