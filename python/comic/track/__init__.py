"""Copies a run to a tracker while it trains: Weights & Biases, MLflow or Trackio.

The learner knows no tracker. A process beside it follows the run's directory::

    python -m comic.track runs/mine --to wandb

It may be killed and started again at any moment, and so may the learner. The book's page "Trackers and search" says what is
guaranteed then.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Literal

from comic import _native
from comic.track import points
from comic.track.points import Lines, Point
from comic.track.position import Batch, Position
from comic.track.trackers import TRACKERS, About, Tracker, find

__all__ = ["CHECKPOINTS", "TRACKERS", "About", "Checkpoints", "Point", "Tracker", "follow"]

Checkpoints = Literal["none", "best", "all"]
"""Which checkpoints are copied: ``best`` is the one of the best evaluation so far, ``all`` every one that is found."""
CHECKPOINTS: tuple[Checkpoints, ...] = ("none", "best", "all")

# When the budget is used up, the learner still writes its last line and its last checkpoint.
_END_DELAY = 10.0


def follow(
    run: str | PathLike[str],
    to: str | Tracker,
    *,
    project: str = "comic",
    name: str | None = None,
    checkpoints: Checkpoints = "none",
    once: bool = False,
    every: float = 5.0,
    timeout: float = 3600.0,
    stop: threading.Event | None = None,
) -> int:
    """Copies a run to a tracker until the run's budget is used up. Returns how many points the tracker has then.

    What the tracker has already is not copied again.

    Args:
        run: The run's directory. It may not exist yet.
        to: The tracker's name, ``wandb``, ``mlflow`` or ``trackio``, or a tracker.
        project: The project of Weights & Biases and Trackio, the experiment of MLflow.
        name: The run's name for the tracker; by default the directory's.
        checkpoints: Which checkpoints are copied, too.
        once: Ends when everything is copied that is there, though the run may not be over.
        every: Seconds from one look at the directory to the next.
        timeout: Seconds without anything new, after which it gives up.
        stop: Ends soon after this event is set, when what was read is copied.

    Raises:
        comic.Error: The tracker is unknown, not installed, or fails; it has fewer points than it had; another process
            copies this run to it; a file is damaged or cannot be written; there was nothing new for too long.
    """
    run, stop = Path(run).absolute(), stop or threading.Event()
    if checkpoints not in CHECKPOINTS:
        raise _native.Error(f"checkpoints: {checkpoints!r}; choose one of {', '.join(CHECKPOINTS)}")
    tracker = find(to) if isinstance(to, str) else to
    if not _has_begun(run, every, 0.0 if once else timeout, stop):
        return 0
    with Position.open(run / f"track-{tracker.name}.jsonl") as position:
        about = About(
            position.start.identity, name or run.name, project, points.configuration(run), points.experiment(run)
        )
        copy = _Copy(run, tracker, position, checkpoints)
        copy.begin(about)
        news = time.monotonic()
        while not stop.is_set():
            settled = copy.is_settled()
            if copy.step():
                news = time.monotonic()
                continue
            quiet = time.monotonic() - news
            if once and settled or quiet >= _END_DELAY and points.is_over(run):
                break
            if quiet >= timeout:
                copy.end(over=False)
                raise _native.Error(f"{run}: nothing new for {timeout:g} s, and its budget is not used up")
            stop.wait(min(every, 0.5) if once else every)
        return copy.end(over=points.is_over(run))


def _has_begun(run: Path, every: float, timeout: float, stop: threading.Event) -> bool:
    """Waits until the run has metrics. Says whether it has; it has none when ``stop`` is set before."""
    deadline = time.monotonic() + timeout
    while not (run / "metrics.jsonl").exists():
        if time.monotonic() >= deadline:
            raise _native.Error(f"{run}: it has no metrics.jsonl after {timeout:g} s: is it the directory of a run?")
        if stop.wait(min(every, 1.0)):
            return False
    return True


class _Copy:
    """Copies one run to one tracker."""

    def __init__(self, run: Path, tracker: Tracker, position: Position, checkpoints: Checkpoints) -> None:
        self._run, self._tracker, self._position, self._checkpoints = run, tracker, position, checkpoints
        self._metrics, self._evaluations = Lines(run / "metrics.jsonl"), Lines(run / "evaluations.jsonl")
        self._copied = dict(position.start.checkpoints)

    def begin(self, about: About) -> None:
        """Begins the tracker's run, and copies what was planned before and did not arrive."""
        with self._asked("begin its run"):
            stored = self._tracker.begin(about)
        for batch in self._position.confirm(stored):
            first = max(stored, batch.first)
            self._log(first, list(self._points(batch))[first - batch.first :])

    def is_settled(self) -> bool:
        """Whether the newest evaluation has its film, if there will be one."""
        return self._evaluations.is_settled()

    def step(self) -> bool:
        """Copies some of what is new. Says whether there was anything."""
        last = self._position.next()
        batch = replace(last, metrics=(last.metrics[1], self._metrics.end(last.metrics[1])))
        if self.is_settled():
            batch = replace(batch, evaluations=(last.evaluations[1], self._evaluations.end(last.evaluations[1])))
        news = batch != last
        if news:
            found = list(self._points(batch))
            batch = replace(batch, end=batch.first + len(found))
            self._position.plan(batch)
            self._log(batch.first, found)
        return self._copy_checkpoints() or news

    def end(self, over: bool) -> int:
        """Waits until the tracker has everything, and returns how many points it has."""
        with self._asked("store everything"):
            self._tracker.end(over)
        self._position.start.checkpoints = self._copied
        self._position.finish()
        return self._position.start.points

    def _log(self, first: int, found: list[Point]) -> None:
        if found:
            with self._asked("store points"):
                self._tracker.log(first, found)

    @contextmanager
    def _asked(self, what: str) -> Iterator[None]:
        """Says what the tracker was asked for when it fails. Each tracker has errors of its own."""
        try:
            yield
        except _native.Error:
            raise
        except Exception as error:
            remedy = "see that you are logged in, that the store is there, and that it can be written; then start this again"
            problem = f"the tracker {self._tracker.name} cannot {what}: {type(error).__name__}: {error}"
            raise _native.Error(f"{self._run}: {problem}\n{remedy}") from error

    def _points(self, batch: Batch) -> Iterator[Point]:
        found = map(points.metrics, self._metrics.read(*batch.metrics))
        evaluated = (points.evaluations(self._run, line) for line in self._evaluations.read(*batch.evaluations))
        yield from (point for point in chain(found, evaluated) if point is not None)

    def _copy_checkpoints(self) -> bool:
        news = False
        for checkpoint in self._chosen():
            written = _written(checkpoint)
            if written is None or self._copied.get(checkpoint.name) == written:
                continue
            with tempfile.TemporaryDirectory() as directory:
                copy = Path(directory) / checkpoint.name
                if not _duplicate(checkpoint, copy):
                    continue
                with self._asked(f"store {checkpoint.name}"):
                    self._tracker.checkpoint(copy)
            self._copied[checkpoint.name] = written
            news = True
        # Names of checkpoints that were removed are not needed any more.
        self._copied = {name: time for name, time in self._copied.items() if (self._directory / name).exists()}
        return news

    @property
    def _directory(self) -> Path:
        return self._run / "checkpoints"

    def _chosen(self) -> list[Path]:
        match self._checkpoints:
            case "none":
                return []
            case "best":
                best = self._directory / "best"
                return [best.resolve()] if best.exists() else []
            case "all":
                return sorted(path for name in ("initial", "checkpoint-*") for path in self._directory.glob(name))


def _written(checkpoint: Path) -> int | None:
    """When the checkpoint was written, ns. ``None`` if it is not there."""
    try:
        return (checkpoint / "MANIFEST.json").stat().st_mtime_ns
    except OSError:
        return None


def _duplicate(checkpoint: Path, copy: Path) -> bool:
    """Copies a checkpoint. Says whether the copy is whole: the learner may be removing the original."""
    copy.mkdir()
    try:
        manifest = json.loads((checkpoint / "MANIFEST.json").read_bytes())
        parts = {Path(part).name: checksum for part, checksum in manifest.items()}
        for part in ["MANIFEST.json", *parts]:
            shutil.copyfile(checkpoint / part, copy / part)
    except FileNotFoundError:
        return False
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise _native.Error(f"{checkpoint}: it cannot be copied: {error}") from error
    return all(hashlib.sha256((copy / part).read_bytes()).hexdigest() == parts[part] for part in parts)
