"""Following a run. A tracker that writes each point to a file stands for the real ones; test_trackers.py has those."""

from __future__ import annotations

import gc
import hashlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import comic
import pytest
from comic import track
from comic.track.points import Point
from comic.track.position import Batch, Position

GIF = b"GIF89a and so on;"


class Recorder:
    """Appends points to a file, and stores each at once. A point that it has already is an error."""

    name = "recorder"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints: list[str] = []
        self.about: track.About | None = None

    def begin(self, about: track.About) -> int:
        self.about = about
        return len(self.points())

    def log(self, first: int, points: Sequence[Point]) -> None:
        assert first == len(self.points())
        for point in points:
            line = {"steps": point.environment_steps, "film": point.read_film() is not None} | point.values
            with self.path.open("a") as file:
                file.write(json.dumps(line) + "\n")
                file.flush()
                os.fsync(file.fileno())

    def checkpoint(self, directory: Path) -> None:
        assert (directory / "MANIFEST.json").exists() and (directory / "policy").read_text() == directory.name
        self.checkpoints.append(directory.name)

    def end(self, over: bool) -> None:
        self.over = over

    def points(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.path.read_text().splitlines()] if self.path.exists() else []


class Directory:
    """A run's directory, written as a learner does."""

    def __init__(self, path: Path, updates: int = 100) -> None:
        self.path = path
        path.mkdir()
        (path / "experiment.toml").write_text(f'name = "x"\n[budget]\nupdates = {updates}\n[vmpo]\nlambda = 0.9\n')
        (path / "metrics.jsonl").touch()

    def metrics(self, *updates: int, epoch: int = 1) -> None:
        self._append("metrics.jsonl", [
            {"updates": number, "environment_steps": 10 * number, "seconds": number / 2, "learner_epoch": epoch,
             "reward": None, "losses": {"kl": 0.5 * number}}
            for number in updates
        ])  # fmt: skip

    def evaluations(self, *updates: int) -> None:
        self._append("evaluations.jsonl", [
            {"updates": number, "environment_steps": 10 * number, "seconds": 1.0,
             "evaluation": {"deterministic": True, "clips": [{"clip": "walk", "normalised_reward": number / 200}],
                            "overall": {"clip": "overall", "normalised_reward": number / 100}}}
            for number in updates
        ])  # fmt: skip
        self.settle()

    def settle(self) -> None:
        """Makes the newest evaluation so old that its film must be there."""
        os.utime(self.path / "evaluations.jsonl", (1, 1))

    def film(self, updates: int, film: bytes = GIF) -> None:
        (self.path / "films").mkdir(exist_ok=True)
        (self.path / "films" / f"{updates:010}.gif").write_bytes(film)

    def checkpoint(self, name: str) -> None:
        directory = self.path / "checkpoints" / name
        directory.mkdir(parents=True)
        part = name.encode()
        (directory / "policy").write_bytes(part)
        (directory / "MANIFEST.json").write_text(json.dumps({"policy": hashlib.sha256(part).hexdigest()}))

    def _append(self, name: str, lines: list[dict[str, Any]]) -> None:
        with (self.path / name).open("a") as file:
            file.writelines(json.dumps(line) + "\n" for line in lines)


@pytest.fixture
def run(tmp_path: Path) -> Directory:
    return Directory(tmp_path / "run")


@pytest.fixture
def recorder(tmp_path: Path) -> Recorder:
    return Recorder(tmp_path / "recorded.jsonl")


def copied(recorder: Recorder) -> list[tuple[str, int]]:
    """What was recorded: the kind of each point, and its updates."""
    return [
        ("evaluation" if "evaluation/normalised_reward" in point else "metrics", point["steps"] // 10)
        for point in recorder.points()
    ]


def test_a_run_is_copied_with_the_names_that_tensorboard_shows(run: Directory, recorder: Recorder) -> None:
    run.metrics(1)
    run.evaluations(3)
    run.film(3)
    assert track.follow(run.path, recorder, once=True, project="p") == 2
    metrics = {"updates": 1, "environment_steps": 10, "seconds": 0.5, "learner_epoch": 1, "losses/kl": 0.5}
    evaluation = {"evaluation/normalised_reward": 0.03, "evaluation_clips/walk/normalised_reward": 0.015}
    assert recorder.points() == [{"steps": 10, "film": False} | metrics, {"steps": 30, "film": True} | evaluation]
    about = recorder.about
    assert about is not None and (about.name, about.project) == ("run", "p")
    assert about.configuration == {"name": "x", "budget.updates": 100, "vmpo.lambda": 0.9}


def test_what_is_copied_already_is_not_copied_again(run: Directory, recorder: Recorder) -> None:
    run.metrics(1, 2)
    track.follow(run.path, recorder, once=True)
    identity = recorder.about and recorder.about.identity
    run.metrics(3)
    assert track.follow(run.path, recorder, once=True) == 3
    assert copied(recorder) == [("metrics", number) for number in (1, 2, 3)]
    assert recorder.about and recorder.about.identity == identity


def test_a_kill_between_any_two_writes_loses_nothing_and_repeats_nothing(tmp_path: Path) -> None:
    for moment in range(1, 100):
        run, recorder = Directory(tmp_path / f"run-{moment}"), Recorder(tmp_path / f"recorded-{moment}")
        run.metrics(1, 2, 3)
        run.evaluations(2)
        process = multiprocessing.get_context("fork").Process(target=follow_until_killed, args=(run, recorder, moment))
        process.start()
        process.join(60)
        # Now the same place in the files would have other lines.
        run.metrics(4, 5)
        run.evaluations(4)
        assert track.follow(run.path, recorder, once=True) == 7
        first = [("metrics", 1), ("metrics", 2), ("metrics", 3), ("evaluation", 2)]
        found = copied(recorder)
        assert sorted(found) == sorted([*first, ("metrics", 4), ("metrics", 5), ("evaluation", 4)]), (moment, found)
        if process.exitcode == 0:
            break
        assert process.exitcode == -signal.SIGKILL
    # Each point is a write, and so are the beginning, the plan and the end.
    assert moment > 7, moment


def follow_until_killed(run: Directory, recorder: Recorder, moment: int) -> None:
    """Follows, and dies right after something was written to the disk for the `moment`th time."""
    sync, left = os.fsync, [moment]

    def count(file: int) -> None:
        sync(file)
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    os.fsync = count
    track.follow(run.path, recorder, once=True)


def test_what_a_tracker_took_and_lost_is_copied_again(run: Directory, recorder: Recorder) -> None:
    run.metrics(1, 2)
    track.follow(run.path, recorder, once=True)
    run.metrics(3, 4)
    run.evaluations(4)
    recorder.end = None  # type: ignore[assignment]
    with pytest.raises(comic.Error, match="the tracker recorder cannot store everything: TypeError"):
        track.follow(run.path, recorder, once=True)
    lines = recorder.path.read_text().splitlines(keepends=True)
    recorder.path.write_text("".join(lines[:3]))
    run.metrics(5)
    del recorder.end
    track.follow(run.path, recorder, once=True)
    assert copied(recorder) == [("metrics", number) for number in (1, 2, 3, 4)] + [("evaluation", 4), ("metrics", 5)]


@pytest.mark.parametrize(("kept", "more"), [(1, 0), (0, 0), (2, 1)])
def test_a_tracker_with_other_points_than_were_copied_is_refused(
    run: Directory, recorder: Recorder, kept: int, more: int
) -> None:
    run.metrics(1, 2)
    track.follow(run.path, recorder, once=True)
    lines = recorder.path.read_text().splitlines(keepends=True)
    found = lines[:kept] + more * lines[:1]
    recorder.path.write_text("".join(found))
    run.metrics(3)
    message = f"track-recorder.jsonl: 2 points were copied, .* now it has {kept + more}: start this as before .* or remove"
    for _ in range(2):
        with pytest.raises(comic.Error, match=message):
            track.follow(run.path, recorder, once=True)
    assert recorder.path.read_text() == "".join(found)
    # The two remedies: the store as it was, and everything again to a new run.
    recorder.path.write_text("".join(lines))
    assert track.follow(run.path, recorder, once=True) == 3
    (run.path / "track-recorder.jsonl").unlink()
    recorder.path.unlink()
    assert track.follow(run.path, recorder, once=True) == 3
    assert copied(recorder) == [("metrics", number) for number in (1, 2, 3)]


@pytest.mark.parametrize("call", ["begin", "log", "checkpoint", "end"])
def test_what_a_tracker_could_not_do_is_said_with_the_remedy(run: Directory, recorder: Recorder, call: str) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError("no route to the server")

    run.metrics(1)
    run.checkpoint("initial")
    setattr(recorder, call, fail)
    message = "the tracker recorder cannot .*: RuntimeError: no route to the server\nsee that you are logged in"
    with pytest.raises(comic.Error, match=message):
        track.follow(run.path, recorder, once=True, checkpoints="all")


def test_a_directory_that_cannot_be_written_is_named(run: Directory, recorder: Recorder) -> None:
    run.metrics(1)
    # A directory in the place of the file: permissions do not stop root.
    (run.path / "track-recorder.lock").mkdir()
    with pytest.raises(comic.Error, match="track-recorder.lock: it cannot be written .*: check the directory's permissions"):
        track.follow(run.path, recorder, once=True)


def test_what_was_copied_is_not_kept_in_memory(run: Directory) -> None:
    with Position.open(run.path / "track-recorder.jsonl") as position:
        planned = []
        for number in range(100):
            batch = Batch(first=number, end=number + 1, metrics=(number, number + 1), evaluations=(0, 0))
            planned.append(weakref.ref(batch))
            position.plan(batch)
        del batch
        gc.collect()
        assert [batch for batch in planned[:-1] if batch() is not None] == []
    with Position.open(run.path / "track-recorder.jsonl") as position:
        assert [batch.first for batch in position.confirm(97)] == [97, 98, 99]
    with Position.open(run.path / "track-recorder.jsonl") as position:
        assert (position.start.points, position.next().first) == (97, 100)
        position.finish()
        assert len(position.path.read_text().splitlines()) == 1


def test_trackers_get_no_directories_of_this_machine(run: Directory, recorder: Recorder) -> None:
    run.metrics(1)
    experiment = run.path / "experiment.toml"
    clips = '[[clips]]\nsource = "/home/me/walks.h5#A,B"\n[[clips]]\nsource = "builtin:walk"\n'
    experiment.write_text(f'name = "x"\n{clips}[transfer]\nlow_level = "/home/me/walk.low-level"\n')
    track.follow(run.path, recorder, once=True)
    about = recorder.about
    assert about is not None
    assert about.configuration == {
        "name": "x",
        "clips": [{"source": "walks.h5#A,B"}, {"source": "builtin:walk"}],
        "transfer.low_level": "walk.low-level",
    }
    assert about.experiment == experiment.read_text().replace("/home/me/", "")
    # A name that TOML writes in another way.
    experiment.write_text("[[clips]]\nsource = '/home/\"me\"/walks.h5'\n")
    with pytest.raises(comic.Error, match="experiment.toml: .* names the directory of .* cannot be removed: rename the file"):
        track.follow(run.path, recorder, once=True)


def test_half_a_line_waits_for_its_other_half(run: Directory, recorder: Recorder) -> None:
    run.metrics(1)
    path = run.path / "metrics.jsonl"
    path.write_text(path.read_text() + '{"updates":2,"environ')
    assert track.follow(run.path, recorder, once=True) == 1
    path.write_text(path.read_text() + 'ment_steps":20}\n')
    assert track.follow(run.path, recorder, once=True) == 2
    assert recorder.points()[1] == {"steps": 20, "film": False, "updates": 2, "environment_steps": 20}


def test_a_plan_that_a_kill_cut_off_is_made_again(run: Directory, recorder: Recorder) -> None:
    run.metrics(1)
    track.follow(run.path, recorder, once=True)
    with (run.path / "track-recorder.jsonl").open("a") as file:
        file.write('{"first": 1, "end": 2, "met')
    run.metrics(2)
    for _ in range(2):
        assert track.follow(run.path, recorder, once=True) == 2
    assert copied(recorder) == [("metrics", 1), ("metrics", 2)]


def test_a_learner_that_resumes_goes_back_in_steps_and_every_line_is_copied(run: Directory, recorder: Recorder) -> None:
    run.metrics(1, 2, 3)
    track.follow(run.path, recorder, once=True)
    run.metrics(2, 3, 4, epoch=2)
    track.follow(run.path, recorder, once=True)
    assert [(point["steps"], point["learner_epoch"]) for point in recorder.points()] == [
        (10, 1), (20, 1), (30, 1), (20, 2), (30, 2), (40, 2)
    ]  # fmt: skip


def test_lines_that_are_no_point_are_left_out(run: Directory, recorder: Recorder, capsys: Any) -> None:
    with (run.path / "metrics.jsonl").open("a") as file:
        file.write(f'{"[" * 100_000}\n{{"environment_steps":1e299}}\n{{"environment_steps":-1}}\n{{"seconds":1e17}}\n')
        file.write('nonsense\n[1]\n{"updates":1,"environment_steps":10,"a":1e999,"b":NaN,"c":true,"d":"x"}\n')
    # An evaluation that was started by hand does not know its environment steps.
    by_hand = '{"updates":1,"environment_steps":0,"evaluation":{}}\n{"evaluation":3}\n'
    (run.path / "evaluations.jsonl").write_text(by_hand)
    run.settle()
    assert track.follow(run.path, recorder, once=True) == 1
    assert recorder.points() == [{"steps": 10, "film": False, "updates": 1, "environment_steps": 10}]
    assert capsys.readouterr().err.count("no JSON object") == 3


def test_a_film_that_is_not_whole_is_left_out(run: Directory, recorder: Recorder) -> None:
    run.evaluations(1, 2)
    run.film(1, GIF[:-1])
    run.film(2, b"\x89PNG;")
    track.follow(run.path, recorder, once=True)
    assert [point["film"] for point in recorder.points()] == [False, False]


def test_it_waits_for_the_run_and_ends_with_it(
    tmp_path: Path, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track, "_END_DELAY", 0.0)
    ended: list[int] = []
    follower = threading.Thread(target=lambda: ended.append(track.follow(tmp_path / "run", recorder, every=0.01)))
    follower.start()
    run = Directory(tmp_path / "run", updates=2)
    run.metrics(1)
    run.metrics(2)
    follower.join(30)
    assert ended == [2] and recorder.over


def test_it_gives_up_on_a_run_that_does_not_begin_or_says_nothing_new(run: Directory, recorder: Recorder) -> None:
    with pytest.raises(comic.Error, match="absent: it has no metrics.jsonl after 0.05 s"):
        track.follow(run.path / "absent", recorder, every=0.01, timeout=0.05)
    run.metrics(1)
    with pytest.raises(comic.Error, match="nothing new for 0.05 s, and its budget is not used up"):
        track.follow(run.path, recorder, every=0.01, timeout=0.05)
    assert copied(recorder) == [("metrics", 1)] and not recorder.over


def test_the_checkpoints_that_are_chosen_are_copied_once(run: Directory, recorder: Recorder) -> None:
    for name in ("initial", *(f"checkpoint-{number:010}" for number in range(1, 6))):
        run.checkpoint(name)
    # The learner is removing these two, and one is damaged.
    (run.path / "checkpoints" / "checkpoint-0000000003" / "policy").unlink()
    (run.path / "checkpoints" / "checkpoint-0000000004" / "MANIFEST.json").unlink()
    (run.path / "checkpoints" / "checkpoint-0000000005" / "policy").write_text("damaged")
    (run.path / "checkpoints" / "best").symlink_to("checkpoint-0000000001")
    for _ in range(2):
        track.follow(run.path, recorder, once=True)
        assert recorder.checkpoints == []
    for _ in range(2):
        track.follow(run.path, recorder, once=True, checkpoints="best")
        assert recorder.checkpoints == ["checkpoint-0000000001"]
    for _ in range(2):
        track.follow(run.path, recorder, once=True, checkpoints="all")
        assert recorder.checkpoints == ["checkpoint-0000000001", "checkpoint-0000000002", "initial"]


def test_one_process_at_a_time_copies_a_run(run: Directory, recorder: Recorder) -> None:
    class Second(Recorder):
        def end(self, over: bool) -> None:
            with pytest.raises(comic.Error, match="track-recorder.lock: another process copies this run"):
                track.follow(run.path, recorder, once=True)

    track.follow(run.path, Second(recorder.path), once=True)


def test_files_that_cannot_be_continued_are_refused(run: Directory, recorder: Recorder) -> None:
    run.metrics(1, 2)
    track.follow(run.path, recorder, once=True)
    (run.path / "metrics.jsonl").write_text("")
    with pytest.raises(comic.Error, match="metrics.jsonl: it is shorter than what was copied"):
        track.follow(run.path, recorder, once=True)
    (run.path / "track-recorder.jsonl").write_text('{"identity":"x","no_such":1}\n')
    with pytest.raises(comic.Error, match="track-recorder.jsonl: it is damaged .*: remove it"):
        track.follow(run.path, recorder, once=True)


def test_a_tracker_that_is_unknown_or_not_installed_is_refused_with_the_remedy(
    run: Directory, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(comic.Error, match="no tracker 'aim': choose one of wandb, mlflow, trackio"):
        track.follow(run.path, "aim")
    for name in track.TRACKERS:
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(comic.Error, match=rf"pip install comic-rl\[{name}\]"):
            track.follow(run.path, name)


def test_a_release_of_trackio_that_cannot_be_asked_is_refused_with_the_one_that_can(
    run: Directory, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.metrics(1)
    other = SimpleNamespace(init=lambda **_: SimpleNamespace())
    monkeypatch.setitem(sys.modules, "trackio", other)
    with pytest.raises(comic.Error, match=r"how many points it has: pip install trackio==0\.\d+"):
        track.follow(run.path, "trackio", once=True)


def test_importing_the_package_imports_no_tracker() -> None:
    others = {"wandb", "mlflow", "trackio", "optuna"}
    script = f"import comic, comic.track, comic.sweep, sys; assert not {others} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", script], check=True)
