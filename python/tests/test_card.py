"""Model cards, and what is published with them. Nothing here needs a hub."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import struct
from pathlib import Path
from typing import Any

import comic
import comic.hub
import pytest
from comic import exported
from exports import GIF, LOW_LEVEL, POLICY, changed, document, experiment_of, parts

REPOSITORY = "somebody/walker"
PRIVATE = "/data/people/somebody/"


def with_private_clips(content: bytes) -> bytes:
    text = experiment_of(content).replace('"builtin:CMU_007_01"', f'"{PRIVATE}wälks.h5#CMU_007_01"')
    return changed(content, experiment=text)


def as_run(directory: Path) -> Path:
    """A run's directory with an evaluation of two checkpoints and their films."""
    (directory / "checkpoints").mkdir(parents=True)
    (directory / "films").mkdir()
    lines = ["nonsense", '{"updates":3,"evaluation":null}']
    for updates, reward, deterministic in [(2, 0.25, True), (3, 0.375, True), (3, 0.875, False), (4, 0.75, True)]:
        row = {"clip": "CMU_007_01", "episodes": 2, "normalised_reward": reward, "fraction_survived": 1.0}
        evaluation = {"deterministic": deterministic, "clips": [row], "overall": row | {"clip": "overall"}}
        lines.append(json.dumps({"updates": updates, "evaluation": evaluation}))
        (directory / f"films/{updates:010}.gif").write_bytes(GIF + bytes([updates]))
    (directory / "evaluations.jsonl").write_text("\n".join(lines))
    return directory


def test_the_card_of_a_low_level_says_what_it_is_and_how_it_was_made() -> None:
    files = comic.hub.contents(LOW_LEVEL, REPOSITORY, licence="mit")
    assert set(files) == {"model.safetensors", "experiment.toml", "README.md"}
    assert files["model.safetensors"] == LOW_LEVEL.read_bytes()
    assert comic.experiment.Experiment(files["experiment.toml"].decode()).fields["name"] == "low-level"
    card = files["README.md"].decode()
    for line in [
        'license: "mit"',
        "# walker",
        "| `CMU_007_04` | 109 | 0.663 | 94.2% |",
        "| `overall` | 847 | 0.586 | 86.2% |",
        "| `μ(s)` | 64 | 2.32 | 2.29 | 2.50 |",
        "| environment steps | 2,503,864 |",
        "| file | safetensors, part `low-level`, format 2 |",
        'FILE="$(python -m comic.hub pull somebody/walker)"',
    ]:
        assert line in card.splitlines(), line
    for text in ["cargo xtask low-level does all of it", "you may not resell this data directly", "comic-learner 0.1.0"]:
        assert text in card


def test_the_front_matter_has_the_fields_that_a_hub_reads() -> None:
    card = comic.hub.contents(LOW_LEVEL, REPOSITORY)["README.md"].decode()
    start, front, _ = card.split("---\n", 2)
    fields = {name: json.loads(value) for name, value in (line.split(": ", 1) for line in front.splitlines())}
    assert start == "" and fields["license"] == "apache-2.0" and fields["library_name"] == "comic-rl"
    assert fields["pipeline_tag"] == "reinforcement-learning" and "tracking" in fields["tags"]
    metrics = fields["model-index"][0]["results"][0]["metrics"]
    assert {metric["type"]: metric["value"] for metric in metrics} == {
        "normalised_reward": 0.5862,
        "fraction_survived": 0.8615,
    }


def test_a_run_is_exported_and_its_card_has_its_evaluation(run: Path, tmp_path: Path) -> None:
    measured = tmp_path / "evaluation.json"
    arguments = ["evaluate", "--checkpoint", str(run), "--deterministic", "--episodes", "2", "--json"]
    measured.write_text(comic.programs.run("comic-actor", arguments))
    files = comic.hub.contents(run, REPOSITORY, evaluation=measured)
    card = files["README.md"].decode()
    assert "| updates | 20 |" in card and "| `CMU_007_01` | 2 | " in card and "position error, mm" in card
    assert "network.encoder = [32]" in card and "budget.updates" not in card
    # Its own command accepts the experiment, and the programs read the file.
    (tmp_path / "experiment.toml").write_bytes(files["experiment.toml"])
    comic.programs.run("comic-learner", ["--preset", str(tmp_path / "experiment.toml"), "--print"])
    (tmp_path / "model.safetensors").write_bytes(files["model.safetensors"])
    arguments = ["evaluate", "--policy", str(tmp_path / "model.safetensors"), "--deterministic", "--episodes", "1"]
    assert "CMU_007_01" in comic.programs.run("comic-actor", arguments)


@pytest.mark.parametrize(("updates", "reward", "film"), [(3, "0.375", 3), (5, "0.750", 4), (2, "0.250", 2)])
def test_evaluation_and_film_are_those_of_the_checkpoint_or_of_the_last_one_before_it(
    updates: int, reward: str, film: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = as_run(tmp_path / "run")
    source = parts(POLICY.read_bytes())[1]["source"] | {"updates": updates}

    def export(name: str, arguments: list[str]) -> str:
        Path(arguments[-1]).write_bytes(changed(POLICY.read_bytes(), source=source))
        return name

    monkeypatch.setattr(comic.programs, "run", export)
    files = comic.hub.contents(run, REPOSITORY)
    card = files["README.md"].decode()
    assert f"| `CMU_007_01` | 2 | {reward} | 100.0% |" in card and "0.875" not in card
    assert ("after 4 of 5 updates" in card) == (updates == 5)
    assert files["film.gif"] == GIF + bytes([film]) and "](film.gif)" in card


def test_the_evaluation_at_the_end_is_used_until_the_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = as_run(tmp_path / "run")
    checkpoint = run / "checkpoints" / parts(POLICY.read_bytes())[1]["source"]["checkpoint"]
    checkpoint.mkdir()
    row = {"clip": "CMU_007_01", "episodes": 44, "normalised_reward": 0.625}
    measured = {"deterministic": True, "clips": [row], "overall": row}
    (run / "evaluation.json").write_text(json.dumps({"untrained": {}, "trained": measured}))
    monkeypatch.setattr(comic.programs, "run", lambda _, arguments: shutil.copy(POLICY, arguments[-1]))
    assert "| `CMU_007_01` | 44 | 0.625 |" in comic.hub.contents(run, REPOSITORY)["README.md"].decode()
    os.utime(run / "evaluation.json", (0, 0))
    assert "| `CMU_007_01` | 2 | 0.375 |" in comic.hub.contents(run, REPOSITORY)["README.md"].decode()


def test_what_was_not_evaluated_says_so() -> None:
    card = comic.hub.contents(POLICY, REPOSITORY)["README.md"].decode()
    assert "It was not evaluated before it was published." in card and "model-index" not in card


def test_directories_are_removed_from_card_experiment_and_file(tmp_path: Path) -> None:
    file = tmp_path / "low_level.safetensors"
    file.write_bytes(with_private_clips(LOW_LEVEL.read_bytes()))
    files = comic.hub.contents(file, REPOSITORY, terms="cmu")
    for name, content in files.items():
        assert PRIVATE.encode() not in content and "wälks.h5".encode() in content, name
    # The native reader accepts it, and the numbers are the same.
    assert parts(files["model.safetensors"])[2] == parts(LOW_LEVEL.read_bytes())[2]
    file.write_bytes(files["model.safetensors"])
    assert "wälks.h5#CMU_007_01" in comic.programs.run("comic-learner", ["low-level", str(file)])


def test_a_directory_that_cannot_be_removed_is_refused(tmp_path: Path) -> None:
    # TOML writes a name with quotation marks in single ones.
    experiment = experiment_of(POLICY.read_bytes()).replace('"builtin:CMU_007_01"', "'/data/me/my \"walks\".h5'")
    assert "/data/me" in experiment
    file = tmp_path / "policy.safetensors"
    file.write_bytes(changed(POLICY.read_bytes(), experiment=experiment))
    with pytest.raises(comic.Error, match="names the directory of"):
        comic.hub.contents(file, REPOSITORY)


def test_another_part_than_that_of_the_file_is_refused() -> None:
    with pytest.raises(comic.Error, match="it holds the part policy, not low-level"):
        comic.hub.contents(POLICY, REPOSITORY, part="low-level")


def test_directories_are_removed_from_the_low_level_inside_a_policy() -> None:
    inside = with_private_clips(LOW_LEVEL.read_bytes())
    digest = hashlib.sha256(inside).hexdigest()
    header, description, data = parts(POLICY.read_bytes())
    header["low_level_file"] = {"dtype": "U8", "shape": [len(inside)], "data_offsets": [len(data), len(data) + len(inside)]}
    text = description["experiment"].replace('low_level = ""', f'low_level = "{PRIVATE}low.safetensors"')
    text = text.replace('sha256 = ""', f'sha256 = "{digest}"')
    content = exported.without_directories(changed(document(header, data + inside), experiment=text))
    assert PRIVATE.encode() not in content and 'low_level = "low.safetensors"' in experiment_of(content)
    inner = parts(content)[2][len(data) :]
    assert f'sha256 = "{hashlib.sha256(inner).hexdigest()}"' in experiment_of(content)
    assert "wälks.h5#CMU_007_01" in experiment_of(inner)


def test_a_home_directory_in_a_files_own_card_is_refused(tmp_path: Path) -> None:
    own = parts(LOW_LEVEL.read_bytes())[1]["card"] | {"command": f"comic-learner --clips {Path.home()}/walks.h5"}
    file = tmp_path / "low_level.safetensors"
    file.write_bytes(changed(LOW_LEVEL.read_bytes(), card=own))
    with pytest.raises(comic.Error, match="model.safetensors would name your home directory.*--made-by"):
        comic.hub.contents(file, REPOSITORY)


def test_names_in_a_file_cannot_change_the_card(tmp_path: Path) -> None:
    evil = "`|<script>\n# title\n![](http://example.org/x.png)\x1b \\<b\\> \\|"
    row = {"clip": evil, "episodes": 1, "normalised_reward": 0.5, "fraction_survived": float("nan")}
    measured = tmp_path / "evaluation.json"
    measured.write_text(json.dumps({"deterministic": True, "clips": [row], "overall": row}))
    source = parts(POLICY.read_bytes())[1]["source"] | {"run": evil}
    file = tmp_path / "policy.safetensors"
    file.write_bytes(changed(POLICY.read_bytes(), source=source))
    card = comic.hub.contents(file, REPOSITORY, evaluation=measured, terms=evil)["README.md"].decode()
    shown = "`'¦<script> # title ![](http://example.org/x.png) \\<b\\> \\¦`"
    assert f"| {shown} | 1 | 0.500 |" in card and f"| run | {shown}, " in card
    assert "\\<script\\> \\# title \\!\\[\\]" in card
    assert "\\\\\\<b\\\\\\>" in card, "a backslash is escaped, too"
    assert "\x1b" not in card
    for line in ["<script>", "# title"]:
        assert not any(found.startswith(line) for found in card.splitlines())


def test_weights_that_were_learned_from_other_recordings_are_not_said_to_be_under_cmus_terms(tmp_path: Path) -> None:
    text = experiment_of(POLICY.read_bytes())
    for low_level, terms in [("", "mocap.cs.cmu.edu"), ("builtin", "mocap.cs.cmu.edu"), ("mine.safetensors", "did not say")]:
        file = tmp_path / "policy.safetensors"
        experiment = text.replace('low_level = ""', f'low_level = "{low_level}"')
        file.write_bytes(changed(POLICY.read_bytes(), experiment=experiment))
        card = comic.hub.contents(file, REPOSITORY)["README.md"].decode()
        (said,) = [line for line in card.splitlines() if line.startswith("Motion capture:")]
        assert terms in said, low_level


def test_a_number_beyond_every_float_is_refused(tmp_path: Path) -> None:
    row = {"clip": "walk", "episodes": 10**400, "normalised_reward": 10**400}
    measured = tmp_path / "evaluation.json"
    measured.write_text(json.dumps({"deterministic": True, "clips": [row], "overall": row}))
    with pytest.raises(comic.Error, match="no card can be made"):
        comic.hub.contents(POLICY, REPOSITORY, evaluation=measured)


def changed_text(text: str) -> bytes:
    return document({"__metadata__": {"comic": text}})


def changed_source(**fields: Any) -> bytes:
    content = POLICY.read_bytes()
    return changed(content, source=parts(content)[1]["source"] | fields)


def test_a_file_that_is_no_export_is_refused_with_the_reason(tmp_path: Path) -> None:
    whole = POLICY.read_bytes()
    header, description, data = parts(whole)
    good = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
    metadata = header["__metadata__"]
    cases = {
        "no safetensors document": [b"", b"1234567", whole[:100], struct.pack("<Q", 1 << 62) + b"{}"],
        "at most 4194304 are read": [document(b" " * ((4 << 20) + 1))],
        "no JSON": [document(b"{"), document(b"\xff\xfe"), document(b"[" * 100_000), document(b"1" * 10_000)],
        "no JSON object": [document([]), changed_text("[]")],
        "no key `comic`": [document({}), document({"__metadata__": []}), document({"__metadata__": {"comic": 1}})],
        "do not fill it one after the other": [
            document({"a": good, "b": good}, bytes(8)),
            document({"a": good | {"data_offsets": [4, 8]}}, bytes(8)),
            document({"a": good | {"shape": [2]}}, bytes(4)),
        ],
        "get it again": [whole[:-1], whole + b"x"],
        "does not write": [
            document({"a": good | {"dtype": "F64"}}, bytes(8)),
            document({"a": good | {"data_offsets": [0]}}, bytes(4)),
            document({"a": []}),
        ],
        "no number of a file": [
            document({"a": good | {"shape": [-1]}}),
            document({"a": good | {"shape": ["1"]}}),
            document({"a": good | {"shape": [1.0]}}),
            document({"a": good | {"shape": [1] * 20}}),
        ],
        "format: 3, and this release reads 1 and 2": [changed(whole, format=3)],
        "format: ": [changed(whole, format=True), changed(whole, format=[[]]), document({"__metadata__": {"comic": "{}"}})],
        "part: ": [changed(whole, part="policy\n"), changed(whole, part=None)],
        "experiment: ": [changed(whole, experiment=None)],
        "source: ": [changed(whole, source=None), changed(whole, source={}), changed_source(updates="3")],
    }
    assert exported.describe(POLICY)["part"] == description["part"] and metadata and data
    for number, (reason, contents) in enumerate(cases.items()):
        for place, content in enumerate(contents):
            file = tmp_path / f"{number}-{place}.safetensors"
            file.write_bytes(content)
            with pytest.raises(comic.Error) as refused:
                exported.describe(file)
            assert str(refused.value).startswith(f"{file}: ") and reason in str(refused.value), refused.value
    with pytest.raises(comic.Error, match="absent: it cannot be read: No such file"):
        exported.describe(tmp_path / "absent")


def test_a_file_longer_than_the_programs_read_is_refused_before_it_is_read(tmp_path: Path) -> None:
    file = tmp_path / "long.safetensors"
    with file.open("wb") as sparse:
        sparse.truncate((1 << 30) + 1)
    with pytest.raises(comic.Error, match="1073741825 bytes, and at most 1073741824 are read"):
        exported.describe(file)


def test_what_cannot_be_on_a_card_is_refused(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong"
    wrong.write_text("[]")
    with pytest.raises(comic.Error, match="wrong: it is no evaluation: `comic-actor evaluate"):
        comic.hub.contents(POLICY, REPOSITORY, evaluation=wrong)
    with pytest.raises(comic.Error, match="wrong: it is no GIF: `comic-actor render"):
        comic.hub.contents(POLICY, REPOSITORY, film=wrong)
    wrong.write_text('{"clips": [], "overall": 1}')
    with pytest.raises(comic.Error, match="no card can be made"):
        comic.hub.contents(POLICY, REPOSITORY, evaluation=wrong)
    wrong.write_bytes(changed(POLICY.read_bytes(), experiment="name ="))
    with pytest.raises(comic.Error, match="wrong: experiment: it cannot be read"):
        comic.hub.contents(wrong, REPOSITORY)


def test_the_card_is_printed_without_a_hub(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    comic.hub.main(["card", str(LOW_LEVEL), REPOSITORY, "--licence", "mit"])
    assert capsys.readouterr().out == comic.hub.contents(LOW_LEVEL, REPOSITORY, licence="mit")["README.md"].decode()
    with pytest.raises(SystemExit, match="error: .*absent: it cannot be read"):
        comic.hub.main(["card", str(tmp_path / "absent"), REPOSITORY])
