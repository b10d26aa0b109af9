"""Real runs in real trackers: offline Weights & Biases, MLflow's database and Trackio's own, read back."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import comic
import pytest
from conftest import SMALL
from test_track import Directory

pytestmark = pytest.mark.full

TRACKERS = ["wandb", "mlflow", "trackio"]
LIMIT = 120.0

Curves = dict[str, list[tuple[int, float]]]
"""For each name the environment steps and values, in the order of the lines."""


@dataclass
class Followed:
    """A run that was followed by every tracker. Its learner was killed once, and so was each follower."""

    run: Path
    store: Path

    def identity(self, tracker: str) -> str:
        return str(json.loads((self.run / f"track-{tracker}.jsonl").read_text().splitlines()[0])["identity"])

    def expected(self) -> Curves:
        """The curves that the run's own files have."""
        curves: Curves = defaultdict(list)
        for line in lines(self.run / "metrics.jsonl"):
            for name, value in numbers("", line):
                if name == "environment_steps":
                    continue
                curves[name].append((line["environment_steps"], value))
        for line in lines(self.run / "evaluations.jsonl"):
            for name, value in numbers("evaluation/", line["evaluation"]["overall"]):
                curves[name].append((line["environment_steps"], value))
        return dict(curves)


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Followed]:
    store = tmp_path_factory.mktemp("trackers")
    run = store / "run"
    environment = store_in(store)

    def follow(tracker: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "comic.track", str(run), "--to", tracker]
        command += ["--every", "0.2", "--checkpoints", "best", "--timeout", str(LIMIT)]
        return subprocess.Popen(command, env=environment, cwd=store)

    # They wait for the run.
    followers = {tracker: follow(tracker) for tracker in TRACKERS}
    fields = SMALL | {"learner": {"metrics_seconds": 0.2, "checkpoint_seconds": 2.0}, "budget": {"minutes": 0.6}}

    def train(resume: bool) -> None:
        for _ in comic.train("tracking-mlp", run=run, actors=1, clips="builtin:walk", resume=resume, **fields):
            pass

    failures: list[comic.Error] = []

    def train_and_fail() -> None:
        try:
            train(False)
        except comic.Error as error:
            failures.append(error)

    training = threading.Thread(target=train_and_fail)
    training.start()
    try:
        evaluated = run / "evaluations.jsonl"
        until("an evaluation", lambda: evaluated.exists() and len(lines(run / "metrics.jsonl")) > 40)
        for tracker in TRACKERS:
            until(f"{tracker} copies", lambda: planned(run, tracker) > 20)
            followers[tracker].send_signal(signal.SIGKILL)
            followers[tracker].wait()
            followers[tracker] = follow(tracker)
        found = subprocess.run(["pgrep", "--full", f"^[^ ]*comic-learner .*{run}"], capture_output=True, check=True)
        os.kill(int(found.stdout), signal.SIGKILL)
        training.join(LIMIT)
        assert failures and "comic-learner ended with -9" in str(failures[0])
        train(True)
        # The budget is used up, so they end by themselves.
        assert [follower.wait(LIMIT) for follower in followers.values()] == [0, 0, 0]
    finally:
        for follower in followers.values():
            follower.kill()
    epochs = [line["learner_epoch"] for line in lines(run / "metrics.jsonl")]
    assert {1, 2} <= set(epochs)
    yield Followed(run, store)


def store_in(store: Path) -> dict[str, str]:
    """The environment in which every tracker stores in this directory."""
    return os.environ | {
        "WANDB_MODE": "offline",
        "WANDB_DIR": str(store),
        "WANDB_DATA_DIR": str(store),
        "MLFLOW_TRACKING_URI": f"sqlite:///{store}/mlflow.db",
        "TRACKIO_DIR": str(store / "trackio"),
    }


def until(what: str, happens: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LIMIT
    while not happens():
        assert time.monotonic() < deadline, f"{what}: not within {LIMIT} s"
        time.sleep(0.05)


def planned(run: Path, tracker: str) -> int:
    """The points that a follower has planned to copy."""
    path = run / f"track-{tracker}.jsonl"
    batches = path.read_text().splitlines()[1:] if path.exists() else []
    return int(json.loads(batches[-1])["end"]) if batches else 0


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


def numbers(prefix: str, value: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for key, inner in value.items():
        if isinstance(inner, dict):
            yield from numbers(f"{prefix}{key}/", inner)
        elif isinstance(inner, (int, float)):
            yield f"{prefix}{key}", inner


def read(tracker: str, store: Path, identity: str) -> Curves:
    """The curves that a tracker has stored, each value as often as it was stored."""
    rows = {"wandb": read_wandb, "mlflow": read_mlflow, "trackio": read_trackio}[tracker](store, identity)
    found: Curves = defaultdict(list)
    for row in rows:
        for name, value in row.items():
            if isinstance(value, (int, float)):
                found[name].append((row["environment_steps"], value))
    # An evaluation is a row of its own, and its file's line has no such curve.
    found.pop("environment_steps", None)
    return found


def read_wandb(store: Path, identity: str) -> list[dict[str, Any]]:
    from comic.track import offline

    rows = list(offline.history(store / "wandb", identity))
    assert [row["_step"] for row in rows] == list(range(len(rows)))
    return rows


def read_mlflow(store: Path, identity: str) -> list[dict[str, Any]]:
    [run] = mlflow_runs(store, identity)
    client = mlflow_client(store)
    names = [name for name in run.data.metrics if name != "environment_steps"]
    # MLflow orders by time: by the order of the lines, unless the run went back.
    return [
        {name: metric.value, "environment_steps": metric.step}
        for name in names
        for metric in client.get_metric_history(run.info.run_id, name)
    ]


def mlflow_client(store: Path) -> Any:
    import mlflow

    return mlflow.MlflowClient(tracking_uri=f"sqlite:///{store}/mlflow.db")


def mlflow_runs(store: Path, identity: str) -> Any:
    client = mlflow_client(store)
    experiment = client.get_experiment_by_name("comic").experiment_id
    return client.search_runs([experiment], filter_string=f"tags.`comic.identity` = '{identity}'")


def read_trackio(store: Path, identity: str) -> list[dict[str, Any]]:
    # Trackio takes its directory from the environment when it is imported.
    script = (
        "import json, sys; from trackio.sqlite_storage import SQLiteStorage\n"
        "print(json.dumps(SQLiteStorage.get_logs('comic', sys.argv[1])))"
    )
    environment = os.environ | {"TRACKIO_DIR": str(store / "trackio")}
    asked = [sys.executable, "-c", script, f"run-{identity}"]
    rows = json.loads(subprocess.run(asked, env=environment, capture_output=True, check=True).stdout)
    assert [row["step"] for row in rows] == list(range(len(rows)))
    return list(rows)


@pytest.mark.parametrize("tracker", ["wandb", "trackio"])
def test_every_line_of_a_run_is_there_once_and_in_order(followed: Followed, tracker: str) -> None:
    found, expected = read(tracker, followed.store, followed.identity(tracker)), followed.expected()
    assert {name: found[name] for name in expected} == expected


def test_mlflow_has_every_point_once(followed: Followed) -> None:
    found, expected = read("mlflow", followed.store, followed.identity("mlflow")), followed.expected()
    for name, curve in expected.items():
        assert set(found[name]) == set(curve), name
        # A learner that waits for its actors repeats a point: MLflow stores points once that have one step, time and value.
        assert Counter(found[name]) <= Counter(curve), name


@pytest.mark.parametrize("tracker", TRACKERS)
def test_every_film_is_there(followed: Followed, tracker: str) -> None:
    places = {
        "wandb": "wandb/offline-run-*/files/media/videos/evaluation/*.gif",
        "mlflow": "mlruns/*/*/artifacts/films/*.gif",
        "trackio": "trackio/media/**/*.gif",
    }
    films = {film.read_bytes() for film in followed.store.glob(places[tracker])}
    assert films == {film.read_bytes() for film in (followed.run / "films").glob("*.gif")}


def test_mlflow_has_the_experiment_and_the_best_checkpoint(followed: Followed) -> None:
    [run] = mlflow_runs(followed.store, followed.identity("mlflow"))
    assert run.info.status == "FINISHED" and run.info.run_name == "run"
    assert run.data.params["vmpo.gradient_steps"] == "1" and run.data.params["name"] == "tracking-mlp"
    best = (followed.run / "checkpoints" / "best").resolve()
    [copy] = followed.store.glob(f"mlruns/*/*/artifacts/checkpoints/{best.name}")
    assert {part.name: part.read_bytes() for part in copy.iterdir()} == {
        part.name: part.read_bytes() for part in best.iterdir()
    }


def test_weights_and_biases_and_trackio_have_the_best_checkpoint(followed: Followed) -> None:
    from comic.track import offline

    best = (followed.run / "checkpoints" / "best").resolve()
    parts = {part.name: part.read_bytes() for part in best.iterdir()}
    records = offline.records(followed.store / "wandb", followed.identity("wandb"))
    artifacts = [record.artifact for record in records if record.WhichOneof("record_type") == "artifact"]
    [artifact] = [artifact for artifact in artifacts if best.name in artifact.aliases][-1:]
    assert {part.path: Path(part.local_path).read_bytes() for part in artifact.manifest.contents} == parts
    stored = [path.read_bytes() for path in (followed.store / "trackio").rglob("*") if path.is_file()]
    assert all(part in stored for part in parts.values())


def copy_once(run: Path, tracker: str, environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "comic.track", str(run), "--to", tracker, "--once"]
    ended = subprocess.run(command, env=environment, cwd=run.parent, capture_output=True, text=True, check=False)
    assert "Traceback" not in ended.stderr, ended.stderr
    return ended


@pytest.mark.parametrize("tracker", ["wandb", "trackio"])
def test_another_store_than_before_is_refused(tracker: str, tmp_path: Path) -> None:
    run = Directory(tmp_path / "run")
    run.metrics(1, 2)
    stores = [tmp_path / "first", tmp_path / "second"]
    for store in stores:
        store.mkdir()
    assert copy_once(run.path, tracker, store_in(stores[0])).returncode == 0
    run.metrics(3)
    refused = copy_once(run.path, tracker, store_in(stores[1]))
    assert refused.returncode == 1
    assert f"track-{tracker}.jsonl: 2 points were copied" in refused.stderr, refused.stderr
    ended = copy_once(run.path, tracker, store_in(stores[0]))
    assert ended.returncode == 0 and ended.stdout.startswith("the tracker has 3 points\n"), ended.stderr


def test_weights_and_biases_get_no_name_of_the_machine_or_its_directories(tmp_path: Path) -> None:
    from comic.track import offline

    run = Directory(tmp_path / "run")
    run.metrics(1)
    with (run.path / "experiment.toml").open("a") as file:
        file.write(f'[[clips]]\nsource = "{tmp_path}/walks.h5"\n')
    assert copy_once(run.path, "wandb", store_in(tmp_path)).returncode == 0
    records = list(offline.records(tmp_path / "wandb", Followed(run.path, tmp_path).identity("wandb")))
    kinds = {record.WhichOneof("record_type") for record in records}
    assert {"run", "history"} <= kinds and not {"environment", "output"} & kinds
    assert {record.run.host for record in records} == {""}
    text = "".join(map(str, records))
    assert "walks.h5" in text and str(tmp_path) not in text and sys.prefix not in text


def test_mlflow_takes_the_reward_of_a_clip_of_any_name(tmp_path: Path) -> None:
    run = Directory(tmp_path / "run")
    run.metrics(1)
    clips = [{"clip": name, "normalised_reward": 0.5} for name in ("..", "a//b", "./x", "", "/", "gehen, schön", "x" * 999)]
    line = {"updates": 1, "environment_steps": 10, "seconds": 1.0, "evaluation": {"overall": {}, "clips": clips}}
    (run.path / "evaluations.jsonl").write_text(json.dumps(line) + "\n")
    run.settle()
    ended = copy_once(run.path, "mlflow", store_in(tmp_path))
    assert ended.stdout == "the tracker has 2 points\n", ended.stderr
    [copy] = mlflow_runs(tmp_path, Followed(run.path, tmp_path).identity("mlflow"))
    names = {name.split("/", 1)[1] for name in copy.data.metrics if name.startswith("evaluation_clips/")}
    rewards = {f"{name}/normalised_reward" for name in ("_", "a/_/b", "_/x", "_/_", "gehen_ sch_n", "x" * 200)}
    assert names == rewards


def test_a_tracker_that_refuses_the_run_says_why(tmp_path: Path) -> None:
    run = Directory(tmp_path / "run")
    run.metrics(1)
    environment = store_in(tmp_path)
    assert copy_once(run.path, "mlflow", environment).returncode == 0
    client = mlflow_client(tmp_path)
    client.delete_experiment(client.get_experiment_by_name("comic").experiment_id)
    refusals = {
        "mlflow": (environment, "deleted"),
        "wandb": (environment | {"WANDB_MODE": "online", "WANDB_API_KEY": "", "HOME": str(tmp_path)}, "[Aa][Pp][Ii].key"),
    }
    for tracker, (where, reason) in refusals.items():
        ended = copy_once(run.path, tracker, where)
        assert ended.returncode == 1
        message = rf"the tracker {tracker} cannot begin its run: .*{reason}[^$]*see that you are logged in"
        assert re.search(message, ended.stderr), ended.stderr


# The tracker has taken every point, and may not have stored the last ones.
KILLED_AT_THE_END = """
import os, signal, sys
from comic import track
tracker = track.TRACKERS[sys.argv[2]]
tracker.end = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
track.follow(sys.argv[1], sys.argv[2], once=True)
"""


@pytest.mark.parametrize("tracker", TRACKERS)
def test_points_that_a_killed_tracker_had_taken_are_stored_after_the_restart(tracker: str, tmp_path: Path) -> None:
    run = Directory(tmp_path / "run")
    run.metrics(*range(1, 501))
    environment = store_in(tmp_path)
    killed = subprocess.run(
        [sys.executable, "-c", KILLED_AT_THE_END, str(run.path), tracker], env=environment, cwd=tmp_path, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    run.metrics(501)
    command = [sys.executable, "-m", "comic.track", str(run.path), "--to", tracker, "--once"]
    subprocess.run(command, env=environment, cwd=tmp_path, check=True)
    found = read(tracker, tmp_path, Followed(run.path, tmp_path).identity(tracker))
    assert found["losses/kl"] == [(10 * number, 0.5 * number) for number in range(1, 502)]
