"""Training: one learner and its actors on this machine."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Generator
from itertools import count
from os import PathLike
from pathlib import Path
from typing import Any

from comic import _native, experiment, programs
from comic.environments import whole
from comic.experiment import Clips, Preset

__all__ = ["train"]

# The learner opens the clips and builds the networks before it serves.
_START_LIMIT = 120.0
# The learner writes its last checkpoint, and actors send their last unrolls.
_END_LIMIT = 60.0
_POLL = 0.2
# The exit code of a learner that was told to stop, and has written its checkpoint.
_STOPPED = 4


def train(
    preset: Preset = "quickstart",
    *,
    run: str | PathLike[str] | None = None,
    actors: int = 2,
    evaluator: bool = True,
    minutes: float | None = None,
    clips: Clips | None = None,
    resume: bool = False,
    **fields: Any,
) -> Generator[dict[str, Any], None, None]:
    """Trains, and yields each line of the run's metrics as it is written.

    The programs ``comic-learner`` and ``comic-actor`` do the work; they are looked for in ``COMIC_BIN`` and in ``PATH``.
    They end when the budget is used up, when the iterator is closed, or when this process ends. A run that was stopped
    can be resumed::

        for line in comic.train("quickstart", run="runs/mine", minutes=3):
            print(line["environment_steps"], line["normalised_reward"])

    Args:
        preset: A preset's name, an experiment's file or an experiment.
        run: The run's directory; by default the next free one of ``runs/PRESET-1``, ``-2`` and so on.
        actors: Number of actor processes.
        evaluator: Starts a process that evaluates the newest checkpoint every two minutes, without noise, for
            :attr:`comic.runs.Run.evaluations`.
        minutes: Minutes to train, instead of the experiment's budget.
        clips: Clips instead of the experiment's.
        resume: Goes on with the run in ``run``.
        **fields: Fields of the experiment, see :mod:`comic.experiment`.

    Raises:
        comic.Error: A field or a clip is wrong, the directory has a run already, a program is missing, or the learner or
            an actor failed. The message has the end of its log.
    """
    # Everything that can be wrong at the start is refused before the first line is asked for.
    actors = whole("actors", actors, 1, 1024)
    if minutes is not None:
        fields["budget.minutes"] = float(minutes)
    resolved = experiment.resolve(preset, clips=clips, **fields)
    for name in ("comic-learner", "comic-actor"):
        programs.find(name)
    directory = _directory(resolved.fields["name"], run, resume)
    return _train(resolved.toml, directory, actors, evaluator, resolved.fields)


def _directory(name: str, run: str | PathLike[str] | None, resume: bool) -> Path:
    if run is None:
        if resume:
            raise _native.Error("run: name the directory of the run that is to be resumed")
        run = next(path for path in (Path(f"runs/{name}-{number}") for number in count(1)) if not path.exists())
    directory = Path(run).absolute()
    if (directory / "checkpoints").is_dir() != resume:
        problem = "it has no checkpoints, so there is no run to resume" if resume else "it has a run already"
        raise _native.Error(f"run: {directory}: {problem}")
    return directory


def _train(
    toml: str, directory: Path, actors: int, evaluator: bool, fields: dict[str, Any]
) -> Generator[dict[str, Any], None, None]:
    directory.mkdir(parents=True, exist_ok=True)
    document = directory / "asked.toml"
    document.write_text(toml)
    log = directory / "learner.log"
    metrics = _Tail(directory / "metrics.jsonl")
    listening = _Tail(log)
    started: list[subprocess.Popen[bytes]] = []
    try:
        arguments = ["--preset", str(document), "--run", str(directory), "--address", "127.0.0.1", "--port", "0"]
        learner = programs.child("comic-learner", arguments, log)
        started.append(learner)
        url = f"http://{_address(learner, listening, log)}"
        arguments = ["--learner", url]
        if fields["unroll"]["lockstep"]:
            # A batch waits for every environment, so the actors together must have all of them.
            environments = -(-fields["unroll"]["batch"] // (actors * fields["actor"]["threads"]))
            arguments += ["--environments", str(environments)]
        names = [f"actor-{number}" for number in range(1, actors + 1)]
        workers = {name: programs.child("comic-actor", arguments, directory / f"{name}.log") for name in names}
        started.extend(workers.values())
        if evaluator:
            # Training goes on without it if it fails; its log says why.
            arguments = ["evaluate", "--learner", url, "--watch"]
            started.append(programs.child("comic-actor", arguments, directory / "evaluator.log"))
        while learner.poll() is None:
            yield from map(json.loads, metrics.lines())
            for name, worker in workers.items():
                # An actor ends well when the run is over.
                if worker.poll() and learner.poll() is None:
                    raise _failure(f"comic-actor ended with {worker.returncode}", directory / f"{name}.log")
            time.sleep(_POLL)
        yield from map(json.loads, metrics.lines())
        if learner.returncode not in (0, _STOPPED):
            raise _failure(f"comic-learner ended with {learner.returncode}", log)
    finally:
        _stop(started)


def _address(learner: subprocess.Popen[bytes], lines: _Tail, log: Path) -> str:
    """Where the learner listens. It prints the address when it serves."""
    deadline = time.monotonic() + _START_LIMIT
    while time.monotonic() < deadline:
        for line in lines.lines():
            if line.startswith("{") and "listening" in (said := json.loads(line)):
                return str(said["listening"])
        if learner.poll() is not None:
            raise _failure(f"comic-learner ended with {learner.returncode} before it served", log)
        time.sleep(0.05)
    raise _failure(f"comic-learner did not serve within {_START_LIMIT:.0f} s", log)


def _stop(processes: list[subprocess.Popen[bytes]]) -> None:
    """Ends what still runs, the learner first: it writes a checkpoint, and tells its actors that the run is over."""
    for process in processes:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_END_LIMIT)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _failure(problem: str, log: Path) -> _native.Error:
    last = log.read_text(errors="replace").splitlines()[-5:]
    return _native.Error("\n".join([f"{problem}; the end of {log}:", *last]))


class _Tail:
    """The lines that are appended to a file from now on. The file may not exist yet."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = path.stat().st_size if path.exists() else 0
        self._rest = b""

    def lines(self) -> list[str]:
        """The complete lines since the last call."""
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._read)
            new = file.read()
        self._read += len(new)
        *lines, self._rest = (self._rest + new).split(b"\n")
        return [line.decode(errors="replace") for line in lines]
