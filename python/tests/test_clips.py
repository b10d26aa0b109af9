"""Clips and experiments."""

from __future__ import annotations

from pathlib import Path

import comic
import numpy as np
import pytest
from conftest import ROOT

CMU = ROOT / "clips" / "tests" / "data" / "cmu"


def test_builtin_clips_are_listed_and_read() -> None:
    assert "walk" in comic.clips.builtin()
    (listed,) = comic.clips.entries("builtin:walk")
    (clip,) = comic.clips.read("builtin:walk")
    assert listed["clip"] == clip.name == "CMU_007_01" and listed["frames"] == len(clip.joints) == 87
    assert clip.joints.shape == (87, 56) and clip.position.shape == (87, 3) and clip.quaternion.shape == (87, 4)
    assert clip.dt == pytest.approx(0.03)
    # A walk of a grown-up.
    speed = np.linalg.norm(clip.velocity[:, :2], axis=1).mean()
    assert 0.5 < speed < 2 and np.allclose(np.linalg.norm(clip.quaternion, axis=1), 1)


def test_servos_that_aim_at_the_next_frame_stay_near_the_clip_and_others_do_not() -> None:
    (clip,) = comic.clips.read("builtin:walk")
    actions = comic.clips.pose_to_action(clip.joints)
    assert actions.shape == (87, 56) and (np.abs(actions) <= 1).all()
    environment = comic.Environment(clips="builtin:walk")

    def steps(chosen: np.ndarray) -> int:
        environment.reset(options={"clip": clip.name, "start": 10})
        for count, action in enumerate(chosen, 1):
            *_, terminated, truncated, _ = environment.step(action)
            if terminated or truncated:
                break
        return count

    assert steps(actions[11:60]) > 2 * steps(np.zeros((49, 56)))
    with pytest.raises(comic.Error, match=r"give \[T, 56\]"):
        comic.clips.pose_to_action(clip.joints[:, 1:])


def test_files_are_joined_checked_and_not_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "two.h5"
    assert comic.clips.merge(["builtin:walk", "builtin:jump"], out) == 2
    assert [clip.name for clip in comic.clips.read(out)] == ["CMU_007_01", "CMU_013_39"]
    assert [clip.name for clip in comic.clips.read(f"{out}#CMU_013_39")] == ["CMU_013_39"]
    assert [(clip["clip"], clip["frames"]) for clip in comic.clips.check(out)][0] == ("CMU_007_01", 87)
    with pytest.raises(comic.Error, match="two.h5"):
        comic.clips.merge("builtin:walk", out)
    assert comic.clips.merge("builtin:walk", out, overwrite=True) == 1


def test_a_recording_of_the_database_is_imported(tmp_path: Path) -> None:
    asf, amc = next(CMU.glob("*.asf")), next(CMU.glob("*.amc"))
    options, remarks = comic.clips.import_cmu(asf, amc, tmp_path / "mine.h5", name="MINE")
    assert "--scale" in options and isinstance(remarks, list)
    (clip,) = comic.clips.read(tmp_path / "mine.h5")
    assert clip.name == "MINE" and len(clip.joints) > 10


@pytest.mark.parametrize(
    ("source", "message"), [("builtin:wlak", "walk"), ("absent.h5", "absent.h5"), (__file__, "test_clips.py")]
)
def test_a_source_that_cannot_be_read_is_named(source: str, message: str) -> None:
    with pytest.raises(comic.Error, match=message):
        comic.clips.read(source)


def test_every_preset_resolves() -> None:
    presets = comic.experiment.presets()
    assert {"quickstart", "tracking-mlp", "transfer-corridor"} <= set(presets)
    for preset in presets:
        assert comic.experiment.resolve(preset).fields["name"] == preset


def test_an_experiment_is_a_file_that_gives_itself(tmp_path: Path) -> None:
    asked = comic.experiment.resolve("quickstart", clips=["builtin:run"], seed=7, learning_rate=1e-3)
    assert asked.fields["seed"] == 7 and asked.fields["clips"][0]["source"] == "builtin:run"
    file = tmp_path / "mine.toml"
    file.write_text(asked.toml)
    assert comic.experiment.resolve(file) == asked
