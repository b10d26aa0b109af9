"""Files of ``comic-learner export``, and wrong ones, for several tests."""

from __future__ import annotations

import json
import struct
from typing import Any

from conftest import ROOT

LOW_LEVEL = ROOT / "networks/data/low_level.safetensors"
POLICY = ROOT / "tests/fixtures/exported/format_1_policy.safetensors"
GIF = b"GIF89a" + bytes(20)


def document(header: Any, data: bytes = b"") -> bytes:
    """A safetensors document."""
    text = header if isinstance(header, bytes) else json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    return struct.pack("<Q", len(text)) + text + data


def parts(content: bytes) -> tuple[dict[str, Any], dict[str, Any], bytes]:
    """Header, description and tensors of a document."""
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    return header, json.loads(header["__metadata__"]["comic"]), content[8 + length :]


def changed(content: bytes, **fields: Any) -> bytes:
    """The document with other fields in its description."""
    header, description, data = parts(content)
    text = json.dumps(description | fields, ensure_ascii=False, separators=(",", ":"))
    return document(header | {"__metadata__": {"comic": text}}, data)


def experiment_of(content: bytes) -> str:
    return str(parts(content)[1]["experiment"])
