"""What several tests share."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
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


class Browser:
    """A page in Chromium without a window. WebGL is in software."""

    def __init__(self, context: Any) -> None:
        self.page = context.new_page()
        self.troubles: list[str] = []
        """What the page logged, and the errors that it did not catch."""
        self.requests: list[str] = []
        """The addresses that it asked for."""
        self.page.on("console", lambda message: self.troubles.append(f"{message.type}: {message.text}"))
        self.page.on("pageerror", lambda error: self.troubles.append(f"not caught: {error}"))
        self.page.on("request", lambda request: self.requests.append(request.url))


@pytest.fixture
def browser() -> Iterator[Browser]:
    """A browser that loads files; a request of a page to any other place fails the test."""
    from playwright.sync_api import sync_playwright

    program = shutil.which("chromium")
    assert program, "there is no Chromium: install Debian's package chromium"
    software = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        # Chromium's own sandbox needs what root in a container does not have.
        chromium = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", *software])
        browser = Browser(chromium.new_context(viewport={"width": 1200, "height": 900}))
        yield browser
        chromium.close()
    assert browser.troubles == []
    assert [address for address in browser.requests if not address.startswith(("file://", "data:"))] == []
