"""Searching with Optuna. What needs Optuna, or a run, is marked `full`."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import comic
import numpy as np
import pytest
from comic import sweep
from conftest import SMALL

FILE = """
preset = "tracking-mlp"
trials = 2
actors = 1
clips = ["builtin:walk"]
sampler = { class = "RandomSampler", seed = 1 }
[set]
"budget.minutes" = 0.2
network = { encoder = [32], value = [32], mlp = { hidden = [32] } }
unroll = { length = 4, batch = 8 }
vmpo = { gradient_steps = 1, minibatch_unrolls = 8 }
actor = { threads = 1, environments = 2 }
learner = { metrics_seconds = 0.2, checkpoint_seconds = 1.0 }
[search]
"vmpo.epsilon_mean" = { low = 0.1, high = 1.0, log = true }
"""


def evaluation(steps: int, reward: float, **others: Any) -> str:
    report = {"deterministic": True, "overall": {"normalised_reward": reward}}
    return json.dumps({"updates": 1, "environment_steps": steps, "evaluation": report} | others) + "\n"


def test_the_curve_has_evaluations_without_noise_and_the_newest_at_steps_that_were_repeated(tmp_path: Path) -> None:
    assert sweep.curve(tmp_path) == ([], [])
    noisy = {"evaluation": {"deterministic": False, "overall": {"normalised_reward": 0.9}}}
    (tmp_path / "evaluations.jsonl").write_text(
        evaluation(0, 0.1, updates=0)
        + evaluation(1000, 0.2)
        + evaluation(1500, 0.9, **noisy)
        # Started by hand: its place is not known.
        + evaluation(0, 0.9)
        + "nonsense\n3\n{}\n"
        + evaluation(2000, 0.8)
        + evaluation(1000, 0.3)
        + evaluation(1800, 0.5)
        + evaluation(4000, 0.9).rstrip("\n")
    )
    assert sweep.curve(tmp_path) == ([0, 1000, 1800], [0.1, 0.3, 0.5])


def test_reports_are_at_equal_steps_and_only_between_evaluations() -> None:
    assert list(sweep.reports([], [], 100)) == []
    assert list(sweep.reports([0], [0.5], 100)) == []
    assert list(sweep.reports([150, 250, 450], [0.0, 1.0, 0.0], 100)) == [
        (200, pytest.approx(0.5)),
        (300, pytest.approx(0.75)),
        (400, pytest.approx(0.25)),
    ]
    assert [step for step, _ in sweep.reports([0, 200], [0.0, 1.0], 100)] == [100, 200]


def test_without_optuna_the_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(comic.Error, match=r"pip install comic-rl\[optuna\]"):
        sweep.search(tmp_path, {"learning_rate": [1e-3]}, trials=1)


@pytest.mark.full
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vmpo.epsilon_mean": {"low": 1}}, "vmpo.epsilon_mean: a range has low and high"),
        ({"vmpo.epsilon_mean": {"low": -1.0, "high": 1.0}}, "vmpo.epsilon_mean"),
        ({"vmpo.epsilon_maen": [1.0]}, "vmpo.epsilon_mean"),
        ({"vmpo.gradient_steps": []}, "give a range or a list of values"),
        ({"vmpo.gradient_steps": 3}, "give a range or a list of values"),
        ({"vmpo.epsilon_mean": {"low": 1.0, "high": 0.5}}, "vmpo.epsilon_mean: .*low"),
        ({"vmpo.epsilon_mean": {"low": 0.1, "high": 1.0, "log": True, "step": 0.1}}, "vmpo.epsilon_mean: .*step"),
        ({"vmpo.gradient_steps": {"low": 1, "high": 4, "step": 0}}, "vmpo.gradient_steps: .*step"),
        ({"vmpo.gradient_steps": {"low": 1, "high": 4, "step": "x"}}, "vmpo.gradient_steps: "),
        ({"vmpo.gradient_steps": range(1, 4)}, "vmpo.gradient_steps: .*cannot be stored with the study"),
        ({"vmpo.gradient_steps": [np.int64(3)]}, "vmpo.gradient_steps: .*cannot be stored with the study"),
        ({}, "nothing to search for"),
    ],
)
def test_a_wrong_space_is_refused_before_the_first_trial(tmp_path: Path, change: Any, message: str) -> None:
    with pytest.raises(comic.Error, match=message):
        sweep.search(tmp_path / "study", change, trials=1)
    assert not (tmp_path / "study").exists()


@pytest.mark.full
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trials = 2\n", "it has trials; a study has trials and search"),
        (FILE.replace("actors", "actor"), "it has actor, "),
        (FILE.replace("RandomSampler", "Random"), "sampler.class: 'Random'; choose one of .*TPESampler"),
        (FILE.replace("seed", "sede"), "sampler: .*sede"),
        (FILE.replace("[set]", '[set]\nclips = ["x"]'), "set: clips: it is no field"),
        (FILE.replace("[set]", '[set]\nspace = "x"'), "set: space: it is no field"),
        (FILE.replace("[set]", '[set]\ndirectory = "x"'), "set: directory: it is no field"),
        (FILE.replace("[set]", '[set]\npruner = "x"'), "set: pruner: it is no field"),
        (FILE.replace('{ class = "RandomSampler", seed = 1 }', '"RandomSampler"'), "sampler: 'RandomSampler'; it is a table"),
        (FILE.replace("seed = 1", 'seed = "x"'), "sampler.seed: 'x'; give a whole number"),
        (FILE.replace("trials = 2", 'trials = "2"'), "trials: '2'; give a whole number"),
        (FILE.replace("trials = 2", "trials = 2\nreport_every = 0"), "report_every: 0; give a whole number from 1"),
        (FILE.replace("trials = 2", "trials = 2\nminutes = 'x'"), "minutes: 'x'; give a number of minutes"),
        (FILE.replace("low = 0.1", "low = 2.0"), "vmpo.epsilon_mean: .*low"),
        ("[", "study.toml: "),
    ],
)
def test_a_wrong_file_is_refused_with_what_is_right(tmp_path: Path, text: str, message: str) -> None:
    assert (ended := run(tmp_path, text)).returncode == 1
    assert "Traceback" not in ended.stderr
    assert re.search(message, ended.stderr), ended.stderr


def command(directory: Path, text: str) -> list[str]:
    (directory / "study.toml").write_text(text)
    return [sys.executable, "-m", "comic.sweep", str(directory / "study.toml"), "--out", str(directory / "out")]


def run(directory: Path, text: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(directory, text), capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.full
def test_a_study_that_was_killed_resumes_its_trial_and_trains_no_finished_one_again(tmp_path: Path) -> None:
    first = tmp_path / "out" / "trial-0000"
    process = subprocess.Popen(command(tmp_path, FILE))
    deadline = time.monotonic() + 120
    while not (list(first.glob("checkpoints/checkpoint-*")) and lines(first)):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    process.wait()
    ended = run(tmp_path, FILE)
    assert ended.returncode == 0, ended.stderr
    assert "trial-0000: it was stopped half-way and is resumed" in ended.stderr
    assert {line["learner_epoch"] for line in lines(first)} == {1, 2}
    table = (tmp_path / "out" / "table.md").read_text()
    assert ended.stdout == table
    rows = [row.split(" | ") for row in table.splitlines()[2:]]
    assert sorted(row[0] for row in rows) == ["| trial-0000", "| trial-0001"]
    assert [row[1] for row in rows] == ["complete", "complete"] and float(rows[0][2]) >= float(rows[1][2])
    best = tmp_path / "out" / rows[0][0].removeprefix("| ")
    assert (tmp_path / "out" / "best.toml").read_text() == (best / "experiment.toml").read_text()
    # Both are finished: a third trial is one run.
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("trial-*/metrics.jsonl")}
    assert run(tmp_path, FILE.replace("trials = 2", "trials = 3")).returncode == 0
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("trial-*/metrics.jsonl")}
    assert len(after) == 3 and before.items() <= after.items()
    # The seed of the sampler does not begin again.
    chosen = {line.split(" | ")[-1] for line in (tmp_path / "out" / "table.md").read_text().splitlines()[2:]}
    assert len(chosen) == 3
    other = run(tmp_path, FILE.replace("low = 0.1", "low = 0.2"))
    assert other.returncode == 1 and "choose another directory" in other.stderr


def lines(run: Path) -> list[dict[str, Any]]:
    path = run / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


@pytest.mark.full
def test_a_trial_that_the_pruner_refuses_is_stopped_with_a_checkpoint(tmp_path: Path) -> None:
    import optuna

    fields = SMALL | {"learner": {"metrics_seconds": 0.2, "checkpoint_seconds": 1.0}}
    study = sweep.search(
        tmp_path,
        {"network.low_level": ["mlp"]},
        trials=1,
        preset="tracking-mlp",
        minutes=5,
        report_every=100,
        evaluate_every=0.05,
        pruner=optuna.pruners.ThresholdPruner(lower=2.0),
        actors=1,
        clips="builtin:walk",
        **fields,
    )
    [trial] = study.trials
    assert trial.state.name == "PRUNED" and trial.user_attrs["minutes"] < 5
    # The first value that was reported is on the curve of the evaluations.
    [(step, value)] = trial.intermediate_values.items()
    assert (step, pytest.approx(value)) in list(sweep.reports(*sweep.curve(tmp_path / "trial-0000"), 100))
    assert lines(tmp_path / "trial-0000")[-1]["updates"] == newest(tmp_path / "trial-0000")
    assert not subprocess.run(["pgrep", "--full", str(tmp_path)], capture_output=True, check=False).stdout
    assert "pruned" in (tmp_path / "table.md").read_text() and not (tmp_path / "best.toml").exists()


def newest(run: Path) -> int:
    """The updates of the newest checkpoint."""
    return max(int(path.name.removeprefix("checkpoint-")) for path in run.glob("checkpoints/checkpoint-*"))


@pytest.mark.full
def test_a_trial_that_fails_is_said_and_counts(tmp_path: Path, capsys: Any) -> None:
    study = sweep.search(tmp_path, {"vmpo.gradient_steps": [1]}, trials=1, clips="no_such.h5", minutes=0.1)
    assert [trial.state.name for trial in study.trials] == ["FAIL"]
    assert "no_such.h5" in study.trials[0].user_attrs["error"]
    assert "trial-0000: failed: " in capsys.readouterr().err
