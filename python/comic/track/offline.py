"""Reads what Weights & Biases has stored offline.

Its service writes in its own time, and loses what it has not written when this process is killed. So the files alone say
what is stored. They have LevelDB's log format, with a header of seven bytes.
"""

from __future__ import annotations

import importlib
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

__all__ = ["history", "points", "records"]

_HEADER = 7
_BLOCK = 32 * 1024
# Checksum, length, and which part of a record follows.
_PART = struct.Struct("<IHB")
_WHOLE, _LAST = 1, 4


def points(directory: Path, identity: str) -> int:
    """How many points the offline runs of this identity have. ``directory`` has a folder for each start."""
    steps = (row["_step"] for row in history(directory, identity))
    return 1 + max(steps, default=-1)


def history(directory: Path, identity: str) -> Iterator[dict[str, Any]]:
    """The rows of a run's history in the order in which they were logged."""
    for record in records(directory, identity):
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            yield {"/".join(item.nested_key) or item.key: json.loads(item.value_json) for item in items}


def records(directory: Path, identity: str) -> Iterator[Any]:
    """What is stored of a run, as the records of Weights & Biases' own format."""
    protocol = importlib.import_module("wandb.proto.wandb_internal_pb2")
    for path in sorted(directory.glob(f"offline-run-*-{identity}/run-{identity}.wandb")):
        yield from map(protocol.Record.FromString, _records(path.read_bytes()))


def _records(log: bytes) -> Iterator[bytes]:
    """The whole records. A kill may have cut off the last one."""
    at, record = _HEADER, b""
    while at + _PART.size <= len(log):
        left = _BLOCK - at % _BLOCK
        if left < _PART.size:
            at += left
            continue
        _, length, part = _PART.unpack_from(log, at)
        at += _PART.size + length
        if at > len(log):
            return
        record += log[at - length : at]
        if part in (_WHOLE, _LAST):
            yield record
            record = b""
