"""The page of a run, RUN/index.html, in a browser."""

from __future__ import annotations

import base64
import json
import shutil
from pathlib import Path

import comic
import pytest
from comic import programs
from conftest import SMALL, Browser

FILM = base64.b64decode("R0lGODdhAQABAIAAAP///////ywAAAAAAQABAAACAkQBADs=")
"""A GIF of one pixel."""


@pytest.mark.full
def test_the_page_of_a_resumed_run_shows_its_curve_its_film_and_its_clip(
    run: Path, tmp_path: Path, browser: Browser
) -> None:
    resumed = shutil.copytree(run, tmp_path / "resumed", symlinks=True)
    # The run was too short for its evaluator.
    arguments = ["--checkpoint", str(resumed), "--deterministic", "--json", "--episodes", "1"]
    report = json.loads(programs.run("comic-actor", ["evaluate", *arguments]))
    newest = json.loads((resumed / "metrics.jsonl").read_text().splitlines()[-1])
    place = {name: newest[name] for name in ("learner_epoch", "updates", "environment_steps", "seconds")}
    (resumed / "evaluations.jsonl").write_text(json.dumps(place | {"evaluation": report}) + "\n")
    (resumed / "films").mkdir(exist_ok=True)
    (resumed / "films" / f"{newest['updates']:010}.gif").write_bytes(FILM)
    budget = {"updates": newest["updates"] + 40}
    list(
        comic.train(
            "tracking-mlp", run=resumed, resume=True, actors=1, evaluator=False, clips="builtin:walk", budget=budget, **SMALL
        )
    )

    page = browser.page
    page.goto((resumed / "index.html").as_uri())
    assert page.locator("#run").inner_text() == "resumed"
    assert page.locator("#state").inner_text() == "finished"
    for figure in ("#over-steps", "#over-time"):
        points = page.locator(f"{figure} polyline").get_attribute("points")
        assert points is not None and len(points.split()) >= 2
        assert page.locator(f"{figure} circle.evaluation").count() == 1
    assert report["clips"][0]["clip"] in page.locator("#table").inner_text()
    assert page.locator("#newest-film img").evaluate("image => image.decode().then(() => image.naturalWidth)") == 1
    page.locator("#over-steps").hover()
    assert "steps" in page.locator("#tip").inner_text()
    page.locator("#details summary").click()
    assert "[vmpo]" in page.locator("#experiment").inner_text()
