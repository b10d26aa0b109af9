"""How far a run was copied to a tracker.

The file ``RUN/track-TRACKER.jsonl`` has the identity of the tracker's run, and which lines became which points. A batch of
lines is written down before it is copied. So its points have the same numbers when it is copied again, whatever the run
has written since. How many points there are, the tracker itself says.
"""

from __future__ import annotations

import json
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
        self.path = path
        # What an earlier process planned, until it is known how much of it arrived.
        self._earlier: list[Batch] = []
        if path.exists():
            self._read()
        else:
            self.start = Start(secrets.token_hex(4))
        self._last = self._earlier[-1] if self._earlier else self._confirmed()
        self._write(self._earlier)

    @staticmethod
    @contextmanager
    def open(path: Path) -> Iterator[Position]:
        """Opens the file, or makes it.

        Raises:
            comic.Error: Another process uses it, it is damaged, or it cannot be written.
        """
        problem = "another process copies this run to this tracker: stop it first"
        with files.locked(path.with_suffix(".lock"), problem):
            yield Position(path)

    def next(self) -> Batch:
        """An empty batch at the end of what was planned."""
        last = self._last
        return Batch(last.end, last.end, (last.metrics[1],) * 2, (last.evaluations[1],) * 2)

    def plan(self, batch: Batch) -> None:
        """Writes down a batch that is going to be copied."""
        files.append(self.path, json.dumps(asdict(batch)))
        self._last = batch

    def confirm(self, points: int) -> list[Batch]:
        """Being told at the start how many points the tracker has, returns the batches that it has not whole.

        Raises:
            comic.Error: It has fewer points than it once had, or more than were planned.
        """
        if not self.start.points <= points <= self._last.end:
            raise _native.Error(
                f"{self.path}: {self._last.end} points were copied, of which the tracker had stored at least "
                f"{self.start.points}, and now it has {points}: start this as before (same working directory, project, "
                f"name and store), or remove the file to copy everything again, to a new run of the tracker"
            )
        earlier, self._earlier = self._earlier, []
        missing = [batch for batch in earlier if batch.end > points]
        if len(missing) < len(earlier):
            self._move_start(earlier[len(earlier) - len(missing) - 1])
        self._write(missing)
        return missing

    def finish(self) -> None:
        """Forgets every batch, because the tracker has all their points."""
        self._move_start(self._last)
        self._write([])

    def _confirmed(self) -> Batch:
        """An empty batch at the end of what the tracker has for certain."""
        start = self.start
        return Batch(start.points, start.points, (start.metrics,) * 2, (start.evaluations,) * 2)

    def _move_start(self, last: Batch) -> None:
        self.start.points, self.start.metrics, self.start.evaluations = last.end, last.metrics[1], last.evaluations[1]

    def _read(self) -> None:
        try:
            # A kill may have cut off the last line. Its batch was not copied.
            whole, _, _ = self.path.read_text(encoding="utf-8").rpartition("\n")
            start, *batches = map(json.loads, whole.split("\n"))
            self.start = Start(**start)
            for batch in batches:
                metrics, evaluations = tuple(batch.pop("metrics")), tuple(batch.pop("evaluations"))
                self._earlier.append(Batch(metrics=metrics, evaluations=evaluations, **batch))
        except (TypeError, ValueError, AttributeError, KeyError, RecursionError) as error:
            remedy = "remove it, and everything is copied again, to a new run of the tracker"
            raise _native.Error(f"{self.path}: it is damaged ({error}): {remedy}") from error

    def _write(self, batches: list[Batch]) -> None:
        lines = [asdict(self.start), *map(asdict, batches)]
        files.replace(self.path, (json.dumps(line) + "\n" for line in lines))
