"""What a run has written: metrics and evaluations."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from comic import _native

if TYPE_CHECKING:
    import pandas

__all__ = ["Run", "Table", "read"]


class Table(Mapping[str, npt.NDArray[Any]]):
    """Columns of equal length by name.

    The name of a nested member has dots: ``losses.latent_kl``. A number that is missing in a line is NaN.
    """

    def __init__(self, lines: list[dict[str, Any]]) -> None:
        flat = [dict(flatten("", line)) for line in lines]
        names = dict.fromkeys(name for line in flat for name in line)
        self._columns = {name: _column([line.get(name) for line in flat]) for name in names}
        self._length = len(lines)

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        if name not in self._columns:
            raise KeyError(f"no column {name!r} in {self!r}")
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __repr__(self) -> str:
        return f"Table({self._length} rows: {', '.join(self._columns)})"

    def to_pandas(self) -> pandas.DataFrame:
        """A frame with the same columns; needs ``pip install comic-rl[pandas]``."""
        import pandas

        return pandas.DataFrame(dict(self))


@dataclass(frozen=True)
class Run:
    """A run's directory."""

    path: Path
    metrics: Table
    """A row for each line of ``metrics.jsonl``; ``comic-learner metrics`` explains the names."""
    evaluations: Table
    """A row for each evaluation and clip: ``updates``, ``environment_steps``, ``seconds``, ``clip`` (``overall`` is the
    row over all clips), and the quantities of ``comic-actor evaluate --json``."""


def read(path: str | PathLike[str]) -> Run:
    """Reads a run's directory. The run may still train.

    Raises:
        comic.Error: The directory has no metrics, or a line of a file cannot be read.
    """
    path = Path(path)
    if not (path / "metrics.jsonl").is_file():
        raise _native.Error(f"{path}: it has no file metrics.jsonl, so it is no directory of a run that has trained")
    evaluations = path / "evaluations.jsonl"
    rows = [row for line in _lines(evaluations) for row in _by_clip(line)] if evaluations.exists() else []
    return Run(path, Table(_lines(path / "metrics.jsonl")), Table(rows))


def _lines(path: Path) -> list[dict[str, Any]]:
    lines = []
    # The learner may be writing the last line.
    whole, _, _ = path.read_text().rpartition("\n")
    for number, line in enumerate(whole.split("\n") if whole else [], 1):
        try:
            lines.append(json.loads(line))
        except ValueError as error:
            raise _native.Error(f"{path}:{number}: it is no JSON: {error}") from error
    return lines


def _by_clip(line: dict[str, Any]) -> Iterator[dict[str, Any]]:
    progress = {name: line.get(name) for name in ("updates", "environment_steps", "seconds")}
    evaluation = line["evaluation"]
    for row in [*evaluation["clips"], evaluation["overall"]]:
        yield progress | row


def flatten(prefix: str, value: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Each value inside, with a name such as ``losses.latent_kl`` that begins with the prefix."""
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            yield from flatten(f"{prefix}{key}.", inner)
        else:
            yield f"{prefix}{key}", inner


def _column(values: list[Any]) -> npt.NDArray[Any]:
    if all(value is None or isinstance(value, (int, float)) for value in values):
        whole = all(isinstance(value, int) for value in values)
        return np.array([np.nan if value is None else value for value in values], np.int64 if whole else np.float64)
    if all(isinstance(value, str) for value in values):
        return np.array(values)
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column
