"""Files of ``comic-learner export``: their description, read without the networks."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from comic import _native

__all__ = [
    "LONGEST",
    "describe",
    "experiment_without_directories",
    "file_name",
    "low_level",
    "parse",
    "without_directories",
]

LONGEST = 1 << 30
"""Bytes of the longest file that the programs read."""

# A header of 1000 clips and 300 tensors has 0.2 MB. Python needs many times as much memory for its values.
_LONGEST_HEADER = 4 << 20
_FORMATS = (1, 2)
_PART = re.compile(r"policy(:[a-z-]+)?|encoder:[a-z-]+|low-level")
_SOURCE = {"program": str, "run": str, "checkpoint": str, "updates": int, "environment_steps": int, "seed": int}
# Bytes of a number, by type.
_SIZES = {"F32": 4, "U8": 1}
# In the policy of a transfer: the tensor whose bytes are the file of the frozen low level.
_LOW_LEVEL_FILE = "low_level_file"


def describe(path: str | PathLike[str]) -> dict[str, Any]:
    """The description in a file: ``format``, ``part``, ``source``, ``experiment`` and others.

    This reads the header alone. It checks the lengths, that the tensors fill the file, and the fields above. The programs
    that use the file check the rest: the numbers, and that the networks are those of the experiment.

    Raises:
        comic.Error: The file cannot be read, is none of ``comic-learner export``, or has another format.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(0)
            return parse(file.read(8 + _LONGEST_HEADER), size)
    except OSError as error:
        raise _native.Error(f"{path}: it cannot be read: {error.strerror}") from error
    except _native.Error as error:
        raise _native.Error(f"{path}: {error}") from error


def parse(start: bytes, size: int) -> dict[str, Any]:
    """The description in a file of this size, of which this is the start. See :func:`describe`."""
    return _description(_header(start, size))


def without_directories(content: bytes) -> bytes:
    """The file with other names of clips and low levels in its experiment: those of the files, without directories.

    The length stays the same. The low level in the policy of a transfer is a file, too, and is treated likewise.

    Raises:
        comic.Error: It is no such file, or a name cannot be replaced.
    """
    header = _header(content, len(content))
    description = _description(header)
    text: str = description["experiment"]
    new = experiment_without_directories(text)
    length = int.from_bytes(content[:8], "little")
    if (inside := low_level(content)) is not None:
        if low_level(inside) is not None:
            raise _native.Error("the low level inside has a low level: it is no file of `comic-learner export`")
        first, end = (8 + length + offset for offset in header[_LOW_LEVEL_FILE]["data_offsets"])
        inside = without_directories(inside)
        new = new.replace(hashlib.sha256(content[first:end]).hexdigest(), hashlib.sha256(inside).hexdigest())
        content = content[:first] + inside + content[end:]
    if new != text:
        # The experiment is a text in the description, and the description is a text in the header.
        old_header = content[8 : 8 + length].decode()
        new_header = old_header.replace(_quoted(_quoted(text)[1:-1])[1:-1], _quoted(_quoted(new)[1:-1])[1:-1])
        content = content[:8] + new_header.encode().ljust(length) + content[8 + length :]
    return content


def experiment_without_directories(toml: str) -> str:
    """An experiment with other names of clips and low levels: those of the files, without directories.

    Raises:
        comic.Error: It is no experiment, or a name cannot be replaced.
    """
    for name in _names(toml):
        toml = toml.replace(_quoted(name), _quoted(file_name(name)))
    # TOML writes a name with quotation marks or a backslash in another way, which is not replaced.
    left = [name for name in _names(toml) if name != file_name(name)]
    if left:
        raise _native.Error(f"its experiment names the directory of {left[0]!r}, which cannot be removed: rename the file")
    return toml


def low_level(content: bytes) -> bytes | None:
    """The file of the frozen low level in the policy of a transfer; ``None`` in any other file."""
    place = _header(content, len(content)).get(_LOW_LEVEL_FILE)
    if place is None:
        return None
    start = 8 + int.from_bytes(content[:8], "little")
    first, end = place["data_offsets"]
    return content[start + first : start + end]


def file_name(source: str) -> str:
    """The path of a file of clips or of a low level without its directories: ``/home/me/walks.h5`` is ``walks.h5``."""
    return source.rstrip("/").rpartition("/")[2]


def _header(start: bytes, size: int) -> dict[str, Any]:
    """The tensors and the metadata of a safetensors document."""
    if size > LONGEST:
        raise _native.Error(f"it has {size} bytes, and at most {LONGEST} are read")
    length = int.from_bytes(start[:8], "little")
    if size < 8 or length > size - 8:
        raise _native.Error("it is no safetensors document, or it is cut off: get it again")
    if length > _LONGEST_HEADER:
        raise _native.Error(f"its header has {length} bytes, and at most {_LONGEST_HEADER} are read")
    header = _json(start[8 : 8 + length], "its header")
    # Every byte belongs to one tensor, as in the format's own readers.
    end = 0
    tensors = [tensor for name, tensor in header.items() if name != "__metadata__"]
    for first, last, count in sorted(map(_place, tensors)):
        if first != end or last - first != count:
            raise _native.Error("its tensors do not fill it one after the other: get it again, or export it again")
        end = last
    if end != size - 8 - length:
        raise _native.Error(f"its tensors have {end} bytes, and {size - 8 - length} are there: get it again")
    return header


def _place(tensor: Any) -> tuple[int, int, int]:
    """First byte, end, and the number of bytes that type and shape need."""
    try:
        count = _SIZES[tensor["dtype"]]
        first, last = tensor["data_offsets"]
        numbers = [first, last, *tensor["shape"]]
    except (KeyError, TypeError, ValueError):
        raise _native.Error("its header describes a tensor that `comic-learner export` does not write") from None
    # No real shape has so many axes, and a product of more of them could become a huge number.
    if len(numbers) > 10 or not all(type(number) is int and 0 <= number <= LONGEST for number in numbers):
        raise _native.Error("its header has a shape or a place that is no number of a file")
    for axis in numbers[2:]:
        count *= axis
    return first, last, count


def _description(header: Mapping[str, Any]) -> dict[str, Any]:
    metadata = header.get("__metadata__")
    text = metadata.get("comic") if isinstance(metadata, dict) else None
    if not isinstance(text, str):
        raise _native.Error("its metadata has no key `comic`: `comic-learner export --part policy --out FILE` writes it")
    description = _json(text, "its description")
    number = description.get("format")
    if type(number) is not int or number not in _FORMATS:
        raise _native.Error(
            f"format: {number!r:.40}, and this release reads {' and '.join(map(str, _FORMATS))}: export it again, or "
            f"use the release that wrote it"
        )
    part, source = description.get("part"), description.get("source")
    if not isinstance(part, str) or not _PART.fullmatch(part):
        raise _native.Error("part: it is none of policy, policy:TASK, encoder:TASK and low-level: export it again")
    if not isinstance(description.get("experiment"), str):
        raise _native.Error("experiment: it is no text: export it again")
    if not isinstance(source, dict) or any(type(source.get(name)) is not kind for name, kind in _SOURCE.items()):
        raise _native.Error(f"source: it has not the fields {', '.join(_SOURCE)}: export it again")
    return description


def _json(text: str | bytes, what: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    # Brackets in brackets exhaust the stack.
    except (ValueError, RecursionError) as error:
        raise _native.Error(f"{what} is no JSON: it is another file, or it is damaged: get it again") from error
    if not isinstance(value, dict):
        raise _native.Error(f"{what} is no JSON object: it is another file, or it is damaged: get it again")
    return value


def _names(toml: str) -> list[str]:
    """The names in an experiment that can be paths."""
    try:
        experiment = tomllib.loads(toml)
        sources = [clip["source"] for clip in experiment.get("clips", [])]
        names = [*sources, experiment.get("transfer", {}).get("low_level", "")]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise _native.Error("experiment: it cannot be read: export it again with this release") from error
    return [name for name in names if isinstance(name, str)]


def _quoted(text: str) -> str:
    """A string as the programs write it, in TOML and in JSON."""
    return json.dumps(text, ensure_ascii=False)
