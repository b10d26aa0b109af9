"""The page that `comic-actor render` and `evaluate` write, in a real browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Browser

from comic import programs

pytestmark = pytest.mark.full

MEGABYTE = 1_000_000


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of a walk, followed by the servos alone."""
    out = tmp_path_factory.mktemp("pages") / "walk.html"
    asked = ["--task", "tracking", "--ghost=beside", "--episodes", "3", "--out", str(out)]
    programs.run("comic-actor", ["render", *asked])
    return out


def step(browser: Browser) -> int:
    """The control step that the page shows."""
    return int(browser.page.locator("#time").inner_text().split()[1])


def seek(browser: Browser, to: int) -> None:
    """Stops the page at a step."""
    if browser.page.locator("#play").inner_text() == "Pause":
        browser.page.locator("#play").click()
    browser.page.locator("#slider").evaluate(
        "(slider, to) => { slider.value = to; slider.dispatchEvent(new Event('input')); }", to
    )


def picture(browser: Browser) -> bytes:
    """What the humanoid's part of the page looks like."""
    return browser.page.locator("main").screenshot()


def test_it_plays_by_itself_and_shows_another_picture_at_another_time(browser: Browser, walk: Path) -> None:
    browser.page.goto(walk.as_uri())
    browser.page.wait_for_function("document.getElementById('slider').value > 3")
    seek(browser, 2)
    first = picture(browser)
    assert step(browser) == 2
    assert picture(browser) == first
    seek(browser, 20)
    assert step(browser) == 20
    assert picture(browser) != first


def test_its_episodes_its_reference_and_its_camera_can_be_chosen(browser: Browser, walk: Path) -> None:
    browser.page.goto(walk.as_uri())
    names = browser.page.locator("#episode option").all_inner_texts()
    assert len(set(names)) == 3
    assert all(name.startswith("CMU_007_01 from ") for name in names)
    seek(browser, 5)
    beside = picture(browser)
    browser.page.locator("#ghost").select_option("off")
    alone = picture(browser)
    assert alone != beside
    browser.page.mouse.move(600, 400)
    browser.page.mouse.down()
    browser.page.mouse.move(700, 380)
    browser.page.mouse.up()
    assert picture(browser) != alone
    first = browser.page.locator("#note").inner_text()
    browser.page.locator("#episode").select_option(label=names[2])
    browser.page.wait_for_function("first => document.getElementById('note').textContent !== first", arg=first)
    assert browser.page.url.endswith("#3")
    seek(browser, 5)
    third = picture(browser)
    browser.page.reload()
    seek(browser, 5)
    browser.page.locator("#ghost").select_option("off")
    assert picture(browser) != alone, "another start"
    assert third != alone


def test_it_shows_the_reward_of_the_step_and_each_of_its_terms(browser: Browser, walk: Path) -> None:
    browser.page.goto(walk.as_uri())
    seek(browser, 5)
    labels = [text.split()[0] for text in browser.page.locator("#strips span:not(.value)").all_inner_texts()[2:]]
    values = [float(value) for value in browser.page.locator("#strips .value").all_inner_texts()]
    assert labels[0] == "reward"
    assert len(labels) == len(values) == 6
    assert values[0] == pytest.approx(sum(values[1:]), abs=0.004)
    assert 0 < values[0] < 1.45


def test_a_clip_takes_less_than_two_megabytes(walk: Path) -> None:
    assert walk.stat().st_size < 2 * MEGABYTE


def test_a_negative_reward_is_shown(browser: Browser, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    programs.run("comic-actor", ["render", "--task", "ball-catch", "--out", str(out)])
    browser.page.goto(out.as_uri())
    label = browser.page.locator("#strips span", has_text="failure")
    assert label.inner_text().split() == ["failure", "-1", "to", "0"]
    seek(browser, int(browser.page.locator("#slider").get_attribute("max") or 0))
    assert "-1.000" in browser.page.locator("#strips .value").all_inner_texts()


@pytest.mark.parametrize("task", ["go-to-target", "gaps", "walls", "get-up", "ball-catch"])
def test_every_task_has_a_page(browser: Browser, tmp_path: Path, task: str) -> None:
    out = tmp_path / "page.html"
    programs.run("comic-actor", ["render", "--task", task, "--seconds", "0.6", "--out", str(out)])
    browser.page.goto(out.as_uri())
    seek(browser, 0)
    first = picture(browser)
    seek(browser, 15)
    assert picture(browser) != first
    assert out.stat().st_size < 2 * MEGABYTE


def test_an_evaluation_writes_its_worst_its_median_and_its_best_start(browser: Browser, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    programs.run("comic-actor", ["evaluate", "--preset", "quickstart", "--servo", "--html", str(out)])
    browser.page.goto(out.as_uri())
    names = browser.page.locator("#episode option").all_inner_texts()
    assert [name.split()[0] for name in names] == ["worst", "median", "best"]
    for name in names:
        browser.page.locator("#episode").select_option(label=name)
        said = name.split("(")[1].split(")")[0]
        browser.page.wait_for_function(
            "said => document.getElementById('note').textContent.endsWith('normalised reward ' + said)", arg=said
        )
    rewards = [float(name.split("(")[1].split(")")[0]) for name in names]
    assert rewards == sorted(rewards)
