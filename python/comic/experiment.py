"""Experiments: presets, and changes to their fields.

An experiment is one TOML document. Its fields, and the errors for a wrong one, are those of the programs; the book's page
"Experiments and sweeps" lists them. In Python a field is a keyword:

- by the end of its name where that is unique: ``termination_threshold=0.5`` for ``tracking.termination_threshold``;
- or by its section: ``tracking={"termination_threshold": 0.5}``.
"""

from __future__ import annotations

import json
import tempfile
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

from comic import _native

__all__ = ["Clips", "Experiment", "Preset", "presets", "resolve"]

Clips = str | PathLike[str] | Sequence[str | PathLike[str]]
"""One source of clips, or several: ``builtin:NAME``, ``FILE.h5``, ``FILE.h5#SUBSET`` or ``FILE.h5#CLIP,CLIP``."""


@dataclass(frozen=True)
class Experiment:
    """A resolved experiment."""

    toml: str
    """The document, every field of it. The programs take a file with it as ``--preset FILE``."""

    @property
    def fields(self) -> dict[str, Any]:
        """The fields, section by section."""
        return tomllib.loads(self.toml)


def presets() -> list[str]:
    """Names of the built-in experiments."""
    return _native.presets()


Preset = str | PathLike[str] | Experiment
"""A preset's name, the path of an experiment's file, or an experiment."""


def resolve(preset: Preset | None = None, *, clips: Clips | None = None, **fields: Any) -> Experiment:
    """The experiment of a preset or a file, with changed fields.

    Args:
        preset: A preset's name, the path of an experiment's file, or an experiment; by default ``tracking-mlp``, the
            paper's values.
        clips: Clips instead of the experiment's.
        **fields: Fields with their values.

    Raises:
        comic.Error: There is no such preset, file or field, or a value is wrong. The message says what is known.
    """
    changes, others = overrides(fields), sources(clips)
    if isinstance(preset, Experiment):
        with tempfile.NamedTemporaryFile("w", suffix=".toml") as file:
            file.write(preset.toml)
            file.flush()
            return Experiment(_native.resolve(file.name, changes, others))
    return Experiment(_native.resolve("tracking-mlp" if preset is None else str(preset), changes, others))


def sources(clips: Clips | None) -> list[str]:
    """A list of sources; empty for ``None``."""
    match clips:
        case None:
            return []
        case str() | PathLike():
            return [str(clips)]
        case _:
            return [str(source) for source in clips]


def overrides(fields: Mapping[str, Any]) -> list[str]:
    """``FIELD=VALUE`` for each field, as ``--set`` takes it."""
    return [
        f"{name}={_toml(name, value)}"
        for keyword, outer in fields.items()
        for name, value in _leaves(_native.find_field(keyword), outer)
    ]


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(f"{name}.{key}", inner)
    else:
        yield name, value


def _toml(name: str, value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case int():
            return repr(int(value))
        case float():
            # One of numpy's is a float with another text.
            return repr(float(value))
        case str() | PathLike():
            return json.dumps(str(value))
        case Mapping():
            return "{" + ", ".join(f"{key} = {_toml(name, inner)}" for key, inner in value.items()) + "}"
        case list() | tuple():
            return "[" + ", ".join(_toml(name, inner) for inner in value) + "]"
    # A number or an array of numpy's.
    if hasattr(value, "tolist"):
        return _toml(name, value.tolist())
    raise _native.Error(f"{name}: no field has a value of type {type(value).__name__}: {value!r}")
