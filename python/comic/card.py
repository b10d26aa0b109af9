"""Model cards: the README of a policy or a low level on a hub (Mitchell et al., Model Cards for Model Reporting, 2019).

A card is Markdown with a front matter that hubs read. It is made of the description in an exported file, and of an
evaluation. Both may come from anywhere: names in them are shown as code, and without directories.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from comic import _native
from comic import experiment as experiments
from comic.exported import file_name
from comic.runs import flatten

__all__ = ["CMU", "card"]

CMU = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF "
    'EIA-0196217. CMU\'s terms: "This data is free for use in research projects. You may include this data in '
    "commercially-sold products, but you may not resell this data directly, even in converted form. If you publish results "
    "obtained using this data, we would appreciate it if you would send the citation to your published paper to "
    "jkh+mocap@cs.cmu.edu, and also would add this text to your acknowledgments section: The data used in this project was "
    'obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217."'
)
"""Terms of the recordings of the CMU database, as in NOTICE."""

_TASKS = {
    "tracking": "follows motion capture",
    "go-to-target": "goes to targets",
    "gaps": "runs along a corridor with gaps",
    "walls": "runs along a corridor with walls",
    "get-up": "gets up and stands",
    "ball-catch": "catches balls",
}

_COLUMNS = {
    "episodes": ("episodes", "{:.0f}"),
    "normalised_reward": ("normalised reward", "{:.3f}"),
    "fraction_survived": ("survived", "{:.1%}"),
    "success_rate": ("success", "{:.1%}"),
    "return_mean": ("return", "{:.2f}"),
    "position_mm": ("position error, mm", "{:.0f}"),
}
"""Quantities of `comic-actor evaluate --json`: heading and format."""

_MEANINGS = {
    "normalised_reward": "*Normalised reward*: mean of return / (most that a step pays × steps left at its start).",
    "fraction_survived": "*Survived*: mean of steps / steps left at the episode's start.",
    "success_rate": "*Success*: share of the episodes that are a success; in tracking they lasted to the end of their clip.",
    "position_mm": "*Position error*: mean distance of the bodies from the reference.",
}

_CITATION = """\
@inproceedings{hasenclever2020comic,
  title     = {CoMic: Complementary Task Learning \\& Mimicry for Reusable Skills},
  author    = {Hasenclever, Leonard and Pardo, Fabio and Hadsell, Raia and Heess, Nicolas and Merel, Josh},
  booktitle = {Proceedings of the 37th International Conference on Machine Learning},
  year      = {2020}
}"""

_RELEASE = f"comic-rl {importlib.metadata.version('comic-rl')}"

# With more clips their rows are folded up.
_UNFOLDED_CLIPS = 24
# Sources of clips that are named. The experiment has all of them.
_NAMED_SOURCES = 24
# Letters of the longest name that is shown.
_LONGEST_NAME = 120


def card(
    description: Mapping[str, Any],
    repo_id: str,
    *,
    licence: str,
    terms: str | None = None,
    evaluation: Mapping[str, Any] | None = None,
    evaluated: str = "",
    film: str | None = None,
) -> str:
    """The README of a repository.

    Args:
        description: The description in an exported file, as :func:`comic.exported.describe` gives it.
        repo_id: The repository: ``NAME/REPOSITORY``.
        licence: Licence of the weights, a hub's name of it: ``apache-2.0``.
        terms: Terms of the motion capture; by default those that the file has, or CMU's for CMU's recordings.
        evaluation: What ``comic-actor evaluate --json`` printed; by default the one that the file has.
        evaluated: Which policy was evaluated, if it may be another than the file's.
        film: Name of a picture in the repository.

    Raises:
        comic.Error: The experiment or the evaluation cannot be read.
    """
    try:
        experiment = tomllib.loads(description["experiment"])
        own = description.get("card") or {}
        evaluation = evaluation or own.get("evaluation")
        title = repo_id.rpartition("/")[2]
        blocks = [
            _front_matter(title, _tasks(experiment), licence, evaluation),
            f"# {title}",
            _what(description["part"], experiment),
            f"![The policy acts in the simulator]({film})" if film else "",
            "## Use",
            *_use(description["part"], repo_id, experiment),
            "## Evaluation",
            *_evaluation(description["part"], evaluation, evaluated),
            *_assessment(own.get("assessment")),
            "## Training",
            _training(description, experiment),
            "## How it was made",
            *_made(description, experiment),
            "## Licence and terms",
            f"Weights: {_code(licence)}, the choice of who published them, or the default of `comic.hub`.",
            f"Motion capture: {_text(given) if (given := terms or own.get('terms')) else _terms(experiment)}",
            "It was made and measured in simulation only, for research. Nothing here was tried on a robot.",
            "## Citation",
            f"```bibtex\n{_CITATION}\n```",
        ]
    except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise _native.Error(
            f"{repo_id}: no card can be made: {type(error).__name__}: {error}; export the file again with this release, and "
            f"give an evaluation that `comic-actor evaluate --json` printed"
        ) from error
    return "\n\n".join(block for block in blocks if block) + "\n"


def _front_matter(title: str, tasks: Sequence[str], licence: str, evaluation: Mapping[str, Any] | None) -> str:
    """What a hub reads. JSON is YAML, too."""
    fields: dict[str, Any] = {
        "license": licence,
        "library_name": "comic-rl",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "humanoid", "mujoco", "motion-capture", "comic", *tasks],
    }
    if evaluation:
        overall = evaluation["overall"]
        metrics = [
            {"type": name, "name": heading, "value": round(float(overall[name]), 4)}
            for name, (heading, _) in _COLUMNS.items()
            if name != "episodes" and _is_number(overall.get(name))
        ]
        task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
        data = {"type": "comic", "name": f"CoMic: {', '.join(tasks)}"}
        fields["model-index"] = [{"name": title, "results": [{"task": task, "dataset": data, "metrics": metrics}]}]
    lines = [f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in fields.items()]
    return "\n".join(["---", *lines, "---"])


def _tasks(experiment: Mapping[str, Any]) -> list[str]:
    return [str(experiment["task"]), *(str(other["task"]) for other in experiment.get("joint", []))]


def _what(part: str, experiment: Mapping[str, Any]) -> str:
    body = "the simulated CMU humanoid (MuJoCo, 56 actuators)"
    tasks = [_TASKS[task] for task in _tasks(experiment)]
    does = " and ".join([", ".join(tasks[:-1]), tasks[-1]] if len(tasks) > 1 else tasks)
    if part == "low-level":
        size = experiment["network"]["latent"]["size"]
        return (
            f"A low level for {body}: it turns a latent of {size:d} numbers and proprioception into commands, so that a new "
            f"policy can reuse motor skills. The policy that it was taken from {does}. "
            f"Made with CoMic in Rust (`comic-rl`)."
        )
    if part.startswith("encoder:"):
        return f"The encoder {_code(part)} of a policy of {body} that {does}. Made with CoMic in Rust (`comic-rl`)."
    return f"A policy of {body} that {does}. Made with CoMic in Rust (`comic-rl`)."


def _use(part: str, repo_id: str, experiment: Mapping[str, Any]) -> Iterator[str]:
    yield "It needs the package `comic-rl[hub]`, and the programs `comic-actor` and `comic-learner` of CoMic in Rust."
    yield f'```python\nimport comic.hub\n\npath = comic.hub.pull("{repo_id}")      # of a file that it has checked\n```'
    file = f'FILE="$(python -m comic.hub pull {repo_id})"'
    if part == "low-level":
        lines = [
            'comic-learner low-level "$FILE"             # checks it, and prints its card',
            'comic-actor assess --low-level "$FILE"      # what it does with random latents',
            'comic-learner --preset transfer-corridor --set transfer.low_level="$FILE" --run runs/transfer',
        ]
    elif part.startswith("encoder:"):
        yield "A Rust program reads it with `comic_networks::export::Exported::open`."
        return
    else:
        builtin = all(source.startswith("builtin:") for source in _sources(experiment))
        clips, clip = ("", "") if builtin else (" --clips YOUR_CLIPS.h5", " --clip YOUR_CLIPS.h5")
        lines = [
            f'comic-actor evaluate --policy "$FILE" --deterministic{clips}',
            f'comic-actor render --task {_tasks(experiment)[0]} --policy "$FILE" --deterministic --out film.gif{clip}',
        ]
    yield "\n".join(["```sh", file, *lines, "```"])


def _evaluation(part: str, evaluation: Mapping[str, Any] | None, evaluated: str) -> Iterator[str]:
    if not evaluation:
        yield "It was not evaluated before it was published."
        return
    noise = "without noise" if evaluation.get("deterministic") else "with the noise of its distribution"
    whose = "The policy acted" if part.startswith("policy") else "The policy that it was taken from acted"
    yield f"{whose} {noise}{f', {evaluated}' if evaluated else ''}. Measured by `comic-actor evaluate`."
    clips = [_flat(row) for row in evaluation["clips"]]
    others = [_flat(row) for row in [*evaluation.get("tasks", []), evaluation["overall"]]]
    columns = [name for name in _COLUMNS if all(_is_number(row.get(name)) for row in [*clips, *others])]
    if len(clips) > _UNFOLDED_CLIPS:
        yield _rows("", columns, others)
        yield f"<details><summary>{len(clips)} clips</summary>"
        yield _rows("clip", columns, clips)
        yield "</details>"
    else:
        yield _rows("clip", columns, clips + (others if len(clips) > 1 else []))
    yield "\n".join(f"- {_MEANINGS[name]}" for name in columns if name in _MEANINGS)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    return {**row, **(row.get("tracking_error") or {})}


def _rows(first: str, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    body = [[_code(row["clip"]), *(_COLUMNS[name][1].format(row[name]) for name in columns)] for row in rows]
    return _table([first, *(_COLUMNS[name][0] for name in columns)], body)


def _assessment(assessment: Mapping[str, Any] | None) -> Iterator[str]:
    if not assessment:
        return
    yield "With random latents, from frames of the clips (`comic-actor assess`):"
    rows = [
        [
            _code(row["latents"]),
            f"{row['episodes']:d}",
            f"{row['seconds_upright']:.2f}",
            f"{row['median_seconds_upright']:.2f}",
            f"{row['metres']:.2f}",
        ]
        for row in assessment["rows"]
    ]
    yield _table(["latents", "episodes", "seconds upright", "median", "metres"], rows)
    if gate := assessment.get("gate"):
        verdict = "passes" if gate["passed"] else "does not pass"
        yield f"It {verdict} the gate that says whether a new policy can explore with random latents of its prior."


def _training(description: Mapping[str, Any], experiment: Mapping[str, Any]) -> str:
    source, sources = description["source"], [_code(file_name(name)) for name in _sources(experiment)]
    if len(sources) > _NAMED_SOURCES:
        sources = [*sources[:_NAMED_SOURCES], f"and {len(sources) - _NAMED_SOURCES} more (`experiment.toml` has all)"]
    network = experiment["network"]
    rows = [
        ["experiment", _code(experiment["name"])],
        ["task", ", ".join(map(_code, _tasks(experiment)))],
        ["algorithm", _code(experiment.get("algorithm", "vmpo"))],
        ["low level", f"{_code(network['low_level'])}, a latent of {network['latent']['size']:d} numbers"],
        ["clips", ", ".join(sources)],
        ["environment steps", f"{source['environment_steps']:,}"],
        ["updates", f"{source['updates']:,}"],
        ["seed", str(source["seed"])],
        ["run", f"{_code(source['run'])}, {_code(source['checkpoint'])}"],
        ["program", _code(source["program"])],
        ["file", f"safetensors, part {_code(description['part'])}, format {description['format']:d}"],
    ]
    if name := experiment.get("transfer", {}).get("low_level"):
        digest = _code(experiment["transfer"]["sha256"])
        rows.insert(4, ["frozen low level", f"{_code(file_name(name))}, SHA-256 {digest}"])
    return _table(rows[0], rows[1:])


def _made(description: Mapping[str, Any], experiment: Mapping[str, Any]) -> Iterator[str]:
    if command := (description.get("card") or {}).get("command"):
        yield "`experiment.toml` has every field. The command, as its author wrote it:"
        yield f"```text\n{_fenced(str(command).split('; '))}\n```"
    else:
        learner = "comic-learner --preset experiment.toml --run runs/again"
        actor = "comic-actor --learner http://127.0.0.1:7070"
        part = description["part"]
        export = f"comic-learner export --checkpoint runs/again --part {part} --out model.safetensors"
        yield "`experiment.toml` has every field. These commands repeat the training; start one actor or more:"
        yield f"```sh\n{learner} &\n{actor} &\nwait\n{export}\n```"
        if experiment.get("transfer", {}).get("low_level", "builtin") not in ("", "builtin"):
            yield "They need the file of the frozen low level, which is not in this repository."
    name = experiment["name"]
    if changes := _changes(experiment):
        yield f"Fields that differ from the preset {_code(name)} of {_code(_RELEASE)}, besides clips, seed and budget:"
        yield f"```toml\n{_fenced(changes)}\n```"


def _changes(experiment: Mapping[str, Any]) -> list[str]:
    """``FIELD = VALUE`` for each field that differs from the preset with the experiment's name."""
    if experiment["name"] not in experiments.presets():
        return []
    preset = dict(flatten("", experiments.resolve(experiment["name"]).fields))
    skipped = ("seed", "clips", "joint", "budget.", "transfer.sha256")
    return [
        f"{name} = {json.dumps(file_name(value) if name == 'transfer.low_level' else value, ensure_ascii=False)}"
        for name, value in flatten("", experiment)
        if not name.startswith(skipped) and preset.get(name) != value
    ]


def _sources(experiment: Mapping[str, Any]) -> list[str]:
    return [str(clip["source"]) for clip in experiment.get("clips", [])]


def _terms(experiment: Mapping[str, Any]) -> str:
    """CMU's, if all that was learned from is built in: the clips, and in transfer the low level."""
    low_level = experiment.get("transfer", {}).get("low_level", "")
    sources = _sources(experiment) + ([] if low_level in ("", "builtin") else [low_level])
    if sources and all(source.startswith("builtin:") for source in sources):
        return CMU
    files = list(dict.fromkeys(_code(file_name(source)) for source in sources))
    named = ", ".join(files[:_NAMED_SOURCES]) or "files that it does not name"
    return f"recordings of {named}. Who published the weights did not say under which terms they may be used."


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    # No other mark would end a cell, and a mark before it could be escaped itself.
    lines = [[cell.replace("|", "¦") for cell in line] for line in [heads, ["---"] * len(heads), *rows]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _code(value: object) -> str:
    """A name in one line of code, which it cannot end."""
    text = _line(value)
    if len(text) > _LONGEST_NAME:
        text = text[:_LONGEST_NAME] + "…"
    return "`" + text.replace("`", "'") + "`"


def _text(value: object) -> str:
    """A paragraph whose letters mean no HTML and no picture, and no link but an address that can be read."""
    return _line(value).translate({ord(mark): f"\\{mark}" for mark in "\\<>[]*_#`!"})


def _fenced(lines: Sequence[str]) -> str:
    """The lines of a block of code, which they cannot end."""
    return "\n".join(_line(line).replace("```", "'''") for line in lines)


def _line(value: object) -> str:
    """One line without control characters, which a terminal would obey."""
    return "".join(letter for letter in " ".join(str(value).split()) if letter.isprintable())
