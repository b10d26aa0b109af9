"""A run's directory as points of curves."""

from __future__ import annotations

import json
import sys
import time
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from comic import _native
from comic.exported import experiment_without_directories
from comic.runs import flatten

__all__ = ["Lines", "Point", "configuration", "evaluations", "experiment", "is_over", "metrics"]

# The longest line is an evaluation of many clips. The learner accepts reports of 1 MiB.
_LONGEST_LINE = 16 << 20
# Lines that are read at once.
_MOST_LINES = 256
# More than the longest line of metrics, so that the end of a file has a whole one.
_END = 1 << 20
# Most clips that have a curve each, as in TensorBoard.
_MOST_CLIP_CURVES = 64
# Bytes of the largest film; the learner accepts no larger one.
_LARGEST_FILM = 1 << 20
# Trackers store double precision.
_LARGEST = 1e300
# Updates, environment steps and seconds at most: MLflow's database has whole numbers of 64 bits, and milliseconds.
_LARGEST_PLACE = 2**53
# The most levels of names in names. The learner writes three.
_DEEPEST = 8
# The learner writes an evaluation's film right after its line.
_FILM_DELAY = 2.0


@dataclass(frozen=True)
class Point:
    """What one line says, under TensorBoard's names."""

    environment_steps: int
    """Environment steps that the run had trained on."""
    seconds: float
    """Wall clock since the run's first unroll."""
    values: dict[str, float]
    """Finite numbers by name: ``losses/latent_kl``, ``evaluation/normalised_reward``."""
    film: Path | None = None
    """Where the evaluation's film is, if it has one."""

    def read_film(self) -> bytes | None:
        """The film, a whole GIF. ``None`` if there is none, or the learner has removed it to make room for others."""
        try:
            with (self.film or Path()).open("rb") as file:
                film = file.read(_LARGEST_FILM + 1)
        except OSError:
            return None
        return film if len(film) <= _LARGEST_FILM and film.startswith(b"GIF8") and film.endswith(b";") else None


class Lines:
    """The whole lines of a file that grows. The file may not exist yet."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def end(self, begin: int) -> int:
        """Where some of the whole lines end that begin at the byte ``begin``; ``begin`` if there is none yet."""
        return begin + sum(len(line) for line in self._raw(begin))

    def read(self, begin: int, end: int) -> Iterator[dict[str, Any]]:
        """The lines between two bytes. A line that is no JSON object is left out with a warning."""
        for line in self._raw(begin):
            if begin >= end:
                return
            begin += len(line)
            try:
                value = json.loads(line)
            # Brackets in brackets exhaust the stack.
            except (ValueError, RecursionError):
                value = None
            if isinstance(value, dict):
                yield value
            else:
                print(f"{self.path}: the line before byte {begin} is no JSON object and is left out", file=sys.stderr)

    def last(self) -> dict[str, Any]:
        """The last whole line; empty if there is none."""
        if not self.path.exists():
            return {}
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            file.seek(max(0, size - _END))
            *whole, _ = file.read(_END).split(b"\n")
        try:
            value = json.loads(whole[-1])
        except (IndexError, ValueError, RecursionError):
            return {}
        return value if isinstance(value, dict) else {}

    def is_settled(self) -> bool:
        """Whether the file was not written in the last two seconds."""
        return not self.path.exists() or abs(time.time() - self.path.stat().st_mtime) > _FILM_DELAY

    def _raw(self, begin: int) -> Iterator[bytes]:
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            if self.path.stat().st_size < begin:
                problem = "it is shorter than what was copied already, so it is another run's file"
                raise _native.Error(f"{self.path}: {problem}")
            file.seek(begin)
            for _ in range(_MOST_LINES):
                line = file.readline(_LONGEST_LINE)
                if len(line) == _LONGEST_LINE:
                    raise _native.Error(f"{self.path}: the line at byte {begin} is longer than {_LONGEST_LINE} bytes")
                # The learner may be writing the last line.
                if not line.endswith(b"\n"):
                    return
                yield line
                begin += len(line)


def metrics(line: Mapping[str, Any]) -> Point | None:
    """The point of a line of ``metrics.jsonl``. ``None`` if its place in the run is not known."""
    values = dict(_numbers("", line))
    return _point(line, values)


def evaluations(run: Path, line: Mapping[str, Any]) -> Point | None:
    """The point of a line of ``evaluations.jsonl``, with its film. ``None`` if its place in the run is not known."""
    report = line.get("evaluation")
    if not isinstance(report, Mapping) or (line.get("environment_steps", 0) == 0 and line.get("updates", 0) != 0):
        return None
    overall = report.get("overall")
    values = dict(_numbers("evaluation/", overall)) if isinstance(overall, Mapping) else {}
    clips = report.get("clips")
    clips = [clip for clip in clips if isinstance(clip, Mapping)] if isinstance(clips, list) else []
    if len(clips) <= _MOST_CLIP_CURVES:
        for clip in clips:
            reward = {"normalised_reward": clip.get("normalised_reward")}
            values |= _numbers(f"evaluation_clips/{str(clip.get('clip'))[:200]}/", reward)
    return _point(line, values, run / "films")


def _point(line: Mapping[str, Any], values: dict[str, float], films: Path | None = None) -> Point | None:
    numbers = dict(_numbers("", line))
    updates, steps, seconds = (numbers.get(name, 0) for name in ("updates", "environment_steps", "seconds"))
    if not all(0 <= number <= _LARGEST_PLACE for number in (updates, steps, seconds)):
        return None
    film = None if films is None else films / f"{int(updates):010}.gif"
    return Point(int(steps), seconds, values, film)


def _numbers(prefix: str, value: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            if prefix.count("/") < _DEEPEST:
                yield from _numbers(f"{prefix}{key}/", inner)
        # Also leaves out numbers that are not finite.
        elif isinstance(inner, (int, float)) and not isinstance(inner, bool) and -_LARGEST < inner < _LARGEST:
            yield f"{prefix}{key}", inner


def configuration(run: Path) -> dict[str, Any]:
    """The fields of the run's experiment with their values: ``vmpo.epsilon_eta``. Files have no directories."""
    return dict(flatten("", tomllib.loads(experiment(run))))


def experiment(run: Path) -> str:
    """The run's ``experiment.toml``. The names of its clips and of its low level have no directories.

    Raises:
        comic.Error: It is no experiment, or a name cannot be replaced.
    """
    path = run / "experiment.toml"
    try:
        return experiment_without_directories(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise _native.Error(f"{path}: it cannot be read: {error}") from error
    except (ValueError, _native.Error) as error:
        raise _native.Error(f"{path}: {error}") from error


def is_over(run: Path) -> bool:
    """Whether the last line of metrics has used up the experiment's budget. A run without a budget is never over."""
    budget = dict(_numbers("", tomllib.loads(experiment(run))))
    last = dict(_numbers("", Lines(run / "metrics.jsonl").last()))
    used = {
        "minutes": last.get("seconds", 0) / 60,
        "environment_steps": last.get("environment_steps", 0),
        "updates": last.get("updates", 0),
    }
    return any(0 < budget.get(f"budget/{limit}", 0) <= value for limit, value in used.items())
