"""The trackers: a class each, behind one protocol."""

from __future__ import annotations

import contextlib
import importlib
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from comic import _native
from comic.track import offline
from comic.track.points import Point

__all__ = ["TRACKERS", "About", "MLflow", "Tracker", "Trackio", "WeightsAndBiases", "find"]

# What MLflow's server accepts in one call.
_MLFLOW_METRICS = 1000
_MLFLOW_PARAMETERS = 100
_MLFLOW_NAME = 250
# The release of Trackio with which this was tested.
_TRACKIO = "0.43.0"


@dataclass(frozen=True)
class About:
    """What a tracker is told of a run first."""

    identity: str
    """Distinguishes the run from others of its name."""
    name: str
    project: str
    configuration: dict[str, Any]
    """The experiment's fields by name."""
    experiment: str
    """The text of ``experiment.toml``. No file in it has a directory, nor has one in the configuration."""


class Tracker(Protocol):
    """Where a run is copied to."""

    name: str
    """The name of the tracker, which is also that of its package."""

    def begin(self, about: About) -> int:
        """Begins the run, or continues it, and says how many of its points the tracker has: the first ones."""

    def log(self, first: int, points: Sequence[Point]) -> None:
        """Takes points, which are numbered from ``first`` on. It may store them later, but in this order."""

    def checkpoint(self, directory: Path) -> None:
        """Stores a copy of a checkpoint."""

    def end(self, over: bool) -> None:
        """Stores everything that it was given. ``over`` says whether the run is over."""


class WeightsAndBiases:
    """Weights & Biases. ``WANDB_MODE=offline`` needs no account, and ``wandb sync`` uploads later."""

    name = "wandb"

    def __init__(self) -> None:
        self._wandb = _package("wandb")

    def begin(self, about: About) -> int:
        wandb = self._wandb
        # Without the output, the load and the packages of this process, which are not the learner's; and without the
        # names of this machine, its users and its directories.
        settings = wandb.Settings(
            console="off", x_disable_stats=True, disable_git=True, save_code=False, x_save_requirements=False,
            x_disable_meta=True, x_disable_machine_info=True, host="",
        )  # fmt: skip
        self._run = wandb.init(
            project=about.project, id=about.identity, name=about.name, resume="allow", settings=settings
        )
        self._run.config.update(about.configuration, allow_val_change=True)
        # A learner that resumes repeats environment steps. The step of Weights & Biases is the number of the point.
        self._run.define_metric("environment_steps")
        self._run.define_metric("*", step_metric="environment_steps")
        if not self._run.offline:
            return int(self._run.step)
        return offline.points(Path(self._run.dir).parents[1], about.identity)

    def log(self, first: int, points: Sequence[Point]) -> None:
        for number, point in enumerate(points, first):
            values: dict[str, Any] = point.values | {"environment_steps": point.environment_steps}
            with _film(point) as film:
                if film is not None:
                    values["evaluation/film"] = self._wandb.Video(str(film), format="gif")
                self._run.log(values, step=number, commit=True)

    def checkpoint(self, directory: Path) -> None:
        artifact = self._wandb.Artifact(f"checkpoint-{self._run.id}", type="model")
        artifact.add_dir(str(directory))
        self._run.log_artifact(artifact, aliases=[directory.name])

    def end(self, over: bool) -> None:
        self._run.finish()


class MLflow:
    """MLflow. ``MLFLOW_TRACKING_URI`` names the server or the file: ``sqlite:///mlflow.db``."""

    name = "mlflow"
    # The tag that says how many points the run has.
    _POINTS = "comic.points"
    _IDENTITY = "comic.identity"

    def __init__(self) -> None:
        self._mlflow = _package("mlflow")
        self._entities = importlib.import_module("mlflow.entities")

    def begin(self, about: About) -> int:
        self._client = self._mlflow.MlflowClient()
        experiment = self._client.get_experiment_by_name(about.project)
        project = self._client.create_experiment(about.project) if experiment is None else experiment.experiment_id
        found = self._client.search_runs([project], filter_string=f"tags.`{self._IDENTITY}` = '{about.identity}'")
        tags = {self._IDENTITY: about.identity}
        run = found[0] if found else self._client.create_run(project, tags=tags, run_name=about.name)
        self._run, self._start = run.info.run_id, run.info.start_time
        # MLflow changes no parameter. A resumed run may have another budget: the artifact has the newest experiment.
        values = {name: str(value) for name, value in about.configuration.items() if name not in run.data.params}
        parameters = [self._entities.Param(name, value) for name, value in values.items()]
        for begin in range(0, len(parameters), _MLFLOW_PARAMETERS):
            self._client.log_batch(self._run, params=parameters[begin : begin + _MLFLOW_PARAMETERS])
        self._client.log_text(self._run, about.experiment, "experiment.toml")
        self._client.update_run(self._run, status="RUNNING")
        return int(run.data.tags.get(self._POINTS, 0))

    def log(self, first: int, points: Sequence[Point]) -> None:
        metrics = []
        for point in points:
            # The same time at each attempt: MLflow's database stores a point once that was sent twice.
            time = self._start + round(1000 * point.seconds)
            for name, value in point.values.items():
                metrics.append(self._entities.Metric(_allowed(name), value, time, point.environment_steps))
        for begin in range(0, len(metrics), _MLFLOW_METRICS):
            self._client.log_batch(self._run, metrics=metrics[begin : begin + _MLFLOW_METRICS])
        for point in points:
            with _film(point) as film:
                if film is not None:
                    self._client.log_artifact(self._run, str(film), "films")
        self._client.set_tag(self._run, self._POINTS, first + len(points))

    def checkpoint(self, directory: Path) -> None:
        self._client.log_artifacts(self._run, str(directory), f"checkpoints/{directory.name}")

    def end(self, over: bool) -> None:
        if over:
            self._client.set_terminated(self._run)


class Trackio:
    """Trackio. It stores in the directory ``TRACKIO_DIR``, or in the Space of Hugging Face ``TRACKIO_SPACE_ID``."""

    name = "trackio"

    def __init__(self) -> None:
        self._trackio = _package("trackio")

    def begin(self, about: About) -> int:
        # Trackio finds a run by its name. It writes to the standard output.
        with contextlib.redirect_stdout(sys.stderr):
            self._run = self._trackio.init(
                project=about.project,
                name=f"{about.name}-{about.identity}",
                config=about.configuration,
                resume="allow",
                embed=False,
                auto_log_cpu=False,
                auto_log_gpu=False,
            )
        # What the store has, be it local or not. Trackio has no public name for it.
        try:
            return int(self._run._next_step)
        except AttributeError as error:
            problem = f"this release cannot be asked how many points it has: pip install trackio=={_TRACKIO}"
            raise _native.Error(f"Trackio: {problem}") from error

    def log(self, first: int, points: Sequence[Point]) -> None:
        for number, point in enumerate(points, first):
            values: dict[str, Any] = point.values | {"environment_steps": point.environment_steps}
            with _film(point) as film:
                if film is not None:
                    values["evaluation/film"] = self._trackio.Video(str(film))
                self._run.log(values, step=number)

    def checkpoint(self, directory: Path) -> None:
        name = f"checkpoint-{self._run.name}"
        self._run.log_artifact(str(directory), name=name, type="model", aliases=[directory.name])

    def end(self, over: bool) -> None:
        with contextlib.redirect_stdout(sys.stderr):
            self._run.finish()


TRACKERS: dict[str, Callable[[], Tracker]] = {
    tracker.name: tracker for tracker in (WeightsAndBiases, MLflow, Trackio)
}
"""The trackers by name."""


def find(name: str) -> Tracker:
    """The tracker of this name.

    Raises:
        comic.Error: There is none, or its package is not installed.
    """
    if name not in TRACKERS:
        raise _native.Error(f"there is no tracker {name!r}: choose one of {', '.join(TRACKERS)}")
    return TRACKERS[name]()


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise _native.Error(f"the tracker {name} is not installed ({error}): pip install comic-rl[{name}]") from error


@contextlib.contextmanager
def _film(point: Point) -> Iterator[Path | None]:
    """A copy of the point's film, because the learner may remove the original."""
    film = point.read_film()
    if film is None or point.film is None:
        yield None
        return
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(directory) / point.film.name
        copy.write_bytes(film)
        yield copy


def _allowed(name: str) -> str:
    """A name of a metric that MLflow allows; clips may have any name."""
    letters = (letter if letter.isascii() and (letter.isalnum() or letter in "_-. /:") else "_" for letter in name)
    # The name is a path, and must be the shortest one to its place.
    parts = "".join(letters)[:_MLFLOW_NAME].split("/")
    return "/".join("_" if part in ("", ".", "..") else part for part in parts)[:_MLFLOW_NAME]
