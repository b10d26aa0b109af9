"""One environment: Gymnasium's rules, dm_control's numbers, and the errors of a wrong argument."""

from __future__ import annotations

import itertools
import json
import re
from typing import Any

import comic
import gymnasium
import numpy as np
import pytest
from conftest import ROOT
from gymnasium.utils.env_checker import check_env

WITHOUT_CAMERA = ["Tracking", "GoToTarget", "GetUp"]
GOLDEN = ROOT / "tests" / "fixtures" / "golden"


@pytest.mark.parametrize("name", WITHOUT_CAMERA)
def test_gymnasiums_checker_accepts_an_environment_that_is_made_without_arguments(name: str) -> None:
    with gymnasium.make(f"comic/{name}-v0", disable_env_checker=True) as environment:
        check_env(environment.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("task", ["tracking", "go-to-target", "get-up"])
def test_the_checker_of_stable_baselines3_accepts_it(task: str) -> None:
    from stable_baselines3.common.env_checker import check_env as check

    check(comic.Environment(task))


def test_every_task_is_registered() -> None:
    names = {identifier for identifier in gymnasium.registry if identifier.startswith("comic/")}
    assert names == {
        f"comic/{name}-v0" for name in ("Tracking", "GoToTarget", "Gaps", "Walls", "GetUp", "BallCatch")
    }


def play(environment: comic.Environment, steps: int, **reset: Any) -> list[Any]:
    """Observations, rewards and starts of an episode with fixed actions."""
    observation, info = environment.reset(**reset)
    seen = [(info["clip"], info["start"]), observation]
    random = np.random.default_rng(7)
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = environment.step(random.uniform(-1, 1, 56))
        seen += [reward, observation]
        if terminated or truncated:
            break
    return seen


def same(one: list[Any], other: list[Any]) -> bool:
    return len(one) == len(other) and all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("task", ["tracking", "go-to-target", "get-up"])
def test_a_seed_decides_this_episode_and_the_later_ones(task: str) -> None:
    one, other = comic.Environment(task), comic.Environment(task)
    # Another history must not matter.
    play(other, 3)
    for seed in (5, None, None):
        assert same(play(one, 4, seed=seed), play(other, 4, seed=seed))
    assert not same(play(one, 4, seed=6), play(other, 4, seed=5))


@pytest.mark.parametrize("rollout", ["tracking_uniform", "tracking_small_noise", "tracking_servo_to_the_end"])
def test_dm_controls_rollouts_are_reproduced(rollout: str) -> None:
    golden = np.load(GOLDEN / f"{rollout}.npz")
    layout = dict(json.loads(str(golden["obs_layout"])))
    clip, start = int(golden["clip"]), int(golden["start"])
    source = f"{GOLDEN / 'synthetic_v2020.h5'}#{golden['clip_id']}"
    # The clip's place in the recording's list is one of the observations.
    environment = comic.Environment(
        clips=[source] * (clip + 1),
        reference_steps=list(range(1, 1 + layout["walker/reference_appendages_pos"] // 15)),
        min_steps=1,
    )
    begins = dict(zip(layout, itertools.accumulate(layout.values(), initial=0), strict=False))
    columns = np.concatenate(
        [begins[f"walker/{name}"] + np.arange(layout[f"walker/{name}"]) for name in environment.observation_names]
    )

    def compare(row: int, observation: Any) -> None:
        np.testing.assert_allclose(observation, golden["obs"][row, columns], rtol=1e-6, atol=1e-6)
        for name, value in environment.state().items():
            np.testing.assert_array_equal(value, golden[name][row])

    observation, info = environment.reset(options={"clip": clip, "start": start})
    assert (info["clip"], info["start"]) == (str(golden["clip_id"]), start)
    compare(0, observation)
    for row, action in enumerate(golden["actions"], 1):
        observation, reward, terminated, truncated, info = environment.step(action)
        compare(row, observation)
        np.testing.assert_allclose(reward, golden["reward"][row], atol=1e-12)
        np.testing.assert_allclose(list(info["reward_terms"].values()), golden["reward_terms"][row], atol=1e-12)
        assert (terminated or truncated) == (golden["step_type"][row] == 2)
        assert terminated == (golden["discount"][row] == 0)
        if terminated or truncated:
            # Some recordings go on.
            break
    assert row > 3


def test_an_episode_begins_where_the_options_say() -> None:
    environment = comic.Environment(clips=["builtin:walk", "builtin:jump"])
    clip, first, end, _ = environment.starts[1]
    assert clip == "CMU_013_39"
    for start in (first, end - 1):
        _, info = environment.reset(options={"clip": clip, "start": start})
        assert (info["clip"], info["start"]) == (clip, start)
    with pytest.raises(comic.Error, match="10000"):
        environment.reset(options={"clip": clip, "start": 10_000})
    with pytest.raises(comic.Error, match="no clip 'no_such'; the clips are CMU_007_01, CMU_013_39"):
        environment.reset(options={"clip": "no_such"})
    with pytest.raises(comic.Error, match="start: -1; give a whole number from 0"):
        environment.reset(options={"start": -1})


def test_the_last_step_says_what_the_episode_achieved() -> None:
    environment = comic.Environment("go-to-target")
    environment.reset(seed=1)
    ended = False
    while not ended:
        *_, terminated, truncated, info = environment.step(np.zeros(56))
        ended = terminated or truncated
        assert ("success" in info) == ended
    assert info["terminated"] and not info["truncated"] and not info["diverged"] and info["success"] is False
    assert set(info["reward_terms"]) and 0 < info["head_height"] < 1
    with pytest.raises(comic.Error, match="the episode of environment 0 is over: reset it first"):
        environment.step(np.zeros(56))


def test_the_rewards_terms_are_summed() -> None:
    environment = comic.Environment()
    environment.reset(seed=2)
    _, reward, *_, info = environment.step(np.zeros(56))
    assert reward == pytest.approx(sum(info["reward_terms"].values()))


def test_a_step_that_is_no_number_diverges_and_the_next_episode_is_well() -> None:
    environment = comic.Environment()
    environment.reset(seed=1)
    observation, reward, terminated, _, info = environment.step(np.full(56, np.nan))
    assert info["diverged"] and terminated and reward == 0 and not observation.any()
    assert environment.reset()[0].any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"no_such": 1}, "no_such"),
        ({"termination_treshold": 0.3}, "termination_threshold"),
        ({"tracking": {"termination_treshold": 0.3}}, "termination_threshold"),
        ({"termination_threshold": "high"}, "termination_threshold"),
        ({"termination_threshold": object()}, "termination_threshold: no field has a value of type object"),
        ({"clips": "builtin:wlak"}, "walk"),
        ({"clips": "no_such.h5"}, "no_such.h5"),
        ({"preset": "no-such"}, "no-such"),
        ({"task": "no-such"}, "no-such"),
        ({"render_mode": "human"}, "rgb_array"),
        ({"render_mode": "rgb_array", "camera": "front"}, "side"),
        ({"render_mode": "rgb_array", "render_size": (4, 4)}, "from 16 to 2048"),
    ],
)
def test_a_wrong_argument_is_named_with_what_is_known(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(comic.Error, match=message):
        comic.Environment(**arguments)


def test_an_action_of_another_size_is_refused() -> None:
    environment = comic.Environment()
    environment.reset()
    for shape in [(55,), (1, 56), ()]:
        with pytest.raises(comic.Error, match=re.escape(f"action: its shape is {shape}; give (56,)")):
            environment.step(np.zeros(shape))


def test_a_field_is_a_keyword_by_its_end_or_by_its_section() -> None:
    short = comic.experiment.resolve(termination_threshold=0.5)
    long = comic.experiment.resolve(tracking={"termination_threshold": np.float64(0.5)})
    assert short == long and short.fields["tracking"]["termination_threshold"] == 0.5


def test_observation_names_are_dm_controls_and_fill_the_vector() -> None:
    names = comic.observation_names("tracking", clips="builtin:walk")
    assert list(names)[:2] == ["joints_pos", "joints_vel"] and "reference_rel_bodies_quats" in names
    environment = comic.Environment("tracking", clips="builtin:walk")
    assert environment.observation_names == names
    assert [part.start for part in names.values()][1:] == [part.stop for part in names.values()][:-1]
    assert environment.observation_space.shape == (list(names.values())[-1].stop,)
