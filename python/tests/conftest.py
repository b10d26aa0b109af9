"""What several tests share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]

# The programs that `cargo xtask test` has built.
os.environ.setdefault("COMIC_BIN", str(ROOT / "target" / "release"))

SMALL: dict[str, Any] = {
    "network": {"encoder": [32], "value": [32], "mlp": {"hidden": [32]}},
    "unroll": {"length": 4, "batch": 8},
    "vmpo": {"gradient_steps": 1, "minibatch_unrolls": 8},
    "actor": {"threads": 1, "environments": 2},
}
"""An experiment that trains at once."""


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of a short run that has ended."""
    import comic

    directory = tmp_path_factory.mktemp("runs") / "small"
    lines = list(
        comic.train("tracking-mlp", run=directory, actors=1, clips="builtin:walk", budget={"updates": 20}, **SMALL)
    )
    assert lines[-1]["updates"] == 20
    return directory
