"""How far a run was copied to a tracker.

The file ``RUN/track-TRACKER.jsonl`` has the identity of the tracker's run, and which lines became which points. A batch of
lines is written down before it is copied. So its points have the same numbers when it is copied again, whatever the run
has written since. How many points there are, the tracker itself says.
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from comic import _native, files

__all__ = ["Batch", "Position", "Start"]


@dataclass(frozen=True)
class Batch:
    """Lines that are copied together: those of ``metrics.jsonl`` first, then those of ``evaluations.jsonl``."""

    first: int
    """The number of the first point."""
    end: int
    """The number after that of the last point."""
    metrics: tuple[int, int]
    """The bytes of the lines of metrics."""
    evaluations: tuple[int, int]
    """The bytes of the evaluations' lines."""


@dataclass
class Start:
    """The first line of the file: what need not be copied again."""

    identity: str
    """The name of the run for the tracker, drawn at random."""
    points: int = 0
    metrics: int = 0
    evaluations: int = 0
    checkpoints: dict[str, int] = field(default_factory=dict)
    """When a checkpoint that was copied was written, ns."""


class Position:
    """The file, which no other process uses meanwhile."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.batches: list[Batch] = []
        if path.exists():
            self._read()
        else:
            self.start = Start(secrets.token_hex(4))
        self._write()

    @staticmethod
    @contextmanager
    def open(path: Path) -> Iterator[Position]:
        """Opens the file, or makes it.

        Raises:
            comic.Error: Another process uses it, or it is damaged.
        """
        problem = "another process copies this run to this tracker: stop it first"
        with files.locked(path.with_suffix(".lock"), problem):
            yield Position(path)

    def next(self) -> Batch:
        """An empty batch at the end of what was planned."""
        if self.batches:
            last = self.batches[-1]
            return Batch(last.end, last.end, (last.metrics[1],) * 2, (last.evaluations[1],) * 2)
        start = self.start
        return Batch(start.points, start.points, (start.metrics,) * 2, (start.evaluations,) * 2)

    def plan(self, batch: Batch) -> None:
        """Writes down a batch that is going to be copied."""
        with self._path.open("a") as file:
            file.write(json.dumps(asdict(batch)) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self.batches.append(batch)

    def confirm(self, points: int) -> list[Batch]:
        """Forgets the batches whose points the tracker has all, being told how many it has. Returns the others."""
        while self.batches and self.batches[0].end <= points:
            done = self.batches.pop(0)
            self.start.points, self.start.metrics, self.start.evaluations = done.end, done.metrics[1], done.evaluations[1]
        self._write()
        return list(self.batches)

    def _read(self) -> None:
        # A kill may have cut off the last line. Its batch was not copied.
        whole, _, _ = self._path.read_text().rpartition("\n")
        try:
            start, *batches = map(json.loads, whole.split("\n"))
            self.start = Start(**start)
            for batch in batches:
                metrics, evaluations = tuple(batch.pop("metrics")), tuple(batch.pop("evaluations"))
                self.batches.append(Batch(metrics=metrics, evaluations=evaluations, **batch))
        except (TypeError, ValueError, AttributeError, KeyError) as error:
            remedy = "remove it, and everything is copied again, to a new run of the tracker"
            raise _native.Error(f"{self._path}: it is damaged ({error}): {remedy}") from error

    def _write(self) -> None:
        lines = [asdict(self.start), *map(asdict, self.batches)]
        files.replace(self._path, (json.dumps(line) + "\n" for line in lines))
