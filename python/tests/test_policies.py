"""Policies and runs. The programs make a short run first."""

from __future__ import annotations

import subprocess
from pathlib import Path

import comic
import numpy as np
import pytest
from conftest import SMALL


def test_a_batch_gives_the_actions_of_its_rows(run: Path) -> None:
    policy = comic.load(run)
    environments = comic.make_vec(num_envs=4, preset=policy.experiment)
    observations, _ = environments.reset(seed=1)
    rows = [comic.load(run) for _ in range(4)]
    for step in range(5):
        actions = policy(observations)
        assert actions.shape == (4, 56) and actions.dtype == np.float32 and (np.abs(actions) <= 1).all()
        alone = [each(observation) for each, observation in zip(rows, observations, strict=True)]
        np.testing.assert_allclose(actions, alone, atol=1e-5, err_msg=f"step {step}")
        observations = environments.step(actions)[0]


@pytest.mark.parametrize("low_level", ["lstm", "mixture", "product"])
def test_so_does_every_low_level(low_level: str, tmp_path: Path) -> None:
    network = {
        "low_level": low_level,
        "lstm": {"units": [16]},
        "primitives": {"torso": [16], "hidden": 16, "gate": [16]},
    }
    fields = SMALL | {"network": SMALL["network"] | network}
    list(comic.train("tracking-mlp", run=tmp_path / "run", actors=1, clips="builtin:walk", budget={"updates": 2}, **fields))
    test_a_batch_gives_the_actions_of_its_rows(tmp_path / "run")


def test_a_new_episode_begins_without_memory(run: Path) -> None:
    policy, fresh = comic.load(run), comic.load(run)
    observations = comic.make_vec(num_envs=2, clips="builtin:walk").reset(seed=1)[0]
    first = policy(observations)
    continued = policy(observations, [False, True])
    np.testing.assert_array_equal(continued[1], first[1])
    assert not np.array_equal(continued[0], first[0])
    np.testing.assert_array_equal(fresh(observations), first)
    policy.reset()
    np.testing.assert_array_equal(policy(observations), first)


def test_a_policy_says_what_it_is(run: Path) -> None:
    policy = comic.load(run)
    assert policy.task == "tracking" and policy.description["source"]["updates"] == 20
    with pytest.raises(comic.Error, match="5 entries; the policy's task tracking has"):
        policy(np.zeros((1, 5)))
    policy(np.zeros((2, comic.Environment(clips="builtin:walk").observation_space.shape[0])))
    with pytest.raises(comic.Error, match="there were 2 before; call policy.reset"):
        policy(np.zeros((3, comic.Environment(clips="builtin:walk").observation_space.shape[0])))


def test_what_is_no_policy_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(comic.Error, match="no such file or directory"):
        comic.load(tmp_path / "absent.pt")
    wrong = tmp_path / "wrong.pt"
    wrong.write_text("no archive")
    with pytest.raises(comic.Error, match="wrong.pt: it is no policy that `comic-learner export"):
        comic.load(wrong)
    with pytest.raises(comic.Error, match="checkpoint"):
        comic.load(tmp_path)
    monkeypatch.setenv("COMIC_BIN", str(tmp_path))
    with pytest.raises(comic.Error, match="no program comic-learner: COMIC_BIN is .* set COMIC_BIN to"):
        comic.load(tmp_path)


def test_a_run_is_read_as_columns(run: Path) -> None:
    read = comic.runs.read(run)
    assert read.metrics["updates"][-1] == 20 and read.metrics["environment_steps"].dtype == np.int64
    assert read.metrics["losses.latent_kl"].dtype == np.float64
    frame = read.metrics.to_pandas()
    assert list(frame.columns) == list(read.metrics) and frame["updates"].iloc[-1] == 20
    with pytest.raises(comic.Error, match="no file metrics.jsonl"):
        comic.runs.read(run / "checkpoints")


def test_evaluations_have_a_row_for_each_clip(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"updates":1,"reward":null}\n{"updates":2,"reward":0.5}\n{"upd')
    (tmp_path / "evaluations.jsonl").write_text(
        '{"updates":2,"environment_steps":9,"seconds":1.5,"evaluation":{"clips":[{"clip":"a","normalised_reward":0.2}],'
        '"overall":{"clip":"overall","normalised_reward":0.3}}}\n'
    )
    read = comic.runs.read(tmp_path)
    np.testing.assert_array_equal(read.metrics["reward"], [np.nan, 0.5])
    assert read.evaluations["clip"].tolist() == ["a", "overall"]
    assert read.evaluations["normalised_reward"].tolist() == [0.2, 0.3]
    assert read.evaluations["updates"].tolist() == [2, 2]
    with pytest.raises(KeyError, match="no column 'reward' in .*2 rows: .*normalised_reward"):
        read.evaluations["reward"]
    (tmp_path / "metrics.jsonl").write_text("{}\nnonsense\n")
    with pytest.raises(comic.Error, match="metrics.jsonl:2"):
        comic.runs.read(tmp_path)


def test_training_ends_with_its_iterator_and_goes_on_later(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    lines = comic.train(run=directory, actors=1, clips="builtin:walk", budget={"updates": 100000}, **SMALL)
    first = next(lines)
    assert (directory / "evaluator.log").exists()
    lines.close()
    assert not subprocess.run(["pgrep", "--full", str(directory)], capture_output=True, check=False).stdout
    with pytest.raises(comic.Error, match="it has a run already"):
        comic.train(run=directory)
    more = comic.train(
        run=directory, actors=1, clips="builtin:walk", resume=True, budget={"updates": 100000}, **SMALL
    )
    assert next(more)["updates"] > first["updates"]
    more.close()


def test_training_refuses_what_is_wrong_before_it_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(comic.Error, match="no_such"):
        comic.train(no_such=1)
    with pytest.raises(comic.Error, match="actors: 0; give a whole number from 1 to 1024"):
        comic.train(actors=0)
    with pytest.raises(comic.Error, match="no checkpoints"):
        comic.train(run=tmp_path, resume=True)
    monkeypatch.setenv("COMIC_BIN", str(tmp_path))
    with pytest.raises(comic.Error, match="no program comic-learner"):
        comic.train(run=tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_learner_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(comic.Error, match="(?s)before it served; the end of .*no_such.h5"):
        list(comic.train(run=tmp_path / "run", clips=str(tmp_path / "no_such.h5")))


