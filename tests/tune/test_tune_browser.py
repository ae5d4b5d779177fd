"""The tuning page in a real Chromium: a slider moves scores and map; pin, restore, save."""

import math
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser import LivePage, Seen, chromium, missing
from live_program import LiveProgram

from taichi_mrf.config import schema as config

if TYPE_CHECKING:
    from playwright.sync_api import Locator

ROOM = "synthetic:room?frames=9&width=80&height=60"

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture(scope="module")
def page() -> Iterator[LivePage]:
    """One page for all tests, which follow each other as a person's doings do."""
    flags = ("--voxel-size", "0.1", "--stride", "1", "--runtime.arch", "cpu")
    with (
        LiveProgram(ROOM, *flags, command="tune") as program,
        chromium() as browser,
        LivePage(browser, program.address, height=1000) as opened,
    ):
        opened.until(lambda seen: seen.settled and seen.voxels, "a settled map")
        yield opened
        assert opened.problems == []
        assert program.end(signal.SIGINT)[0] == 130


def rests(page: LivePage, number: int) -> Seen:
    """Wait until a try has its scores and its map; returns what is then to be seen."""
    return page.until(
        lambda seen: seen.settled and shown_try(page) == number and "first look" not in page.text(),
        f"try {number} at rest",
    )


def shown_try(page: LivePage) -> int | None:
    found = re.search(r"Try (\d+)", page.text())
    return int(found[1]) if found else None


def score(page: LivePage, label: str) -> float:
    """A number of the score board."""
    cells = page.page.locator(f'xpath=//tr[td[1][normalize-space(.) = "{label}"]]/td[2]')
    return float(cells.first.inner_text().split()[0].replace(",", ""))


def plot(page: LivePage) -> str:
    """The noise plot as it is drawn."""
    canvas = page.page.locator(".uplot canvas").first
    return canvas.evaluate("canvas => canvas.toDataURL()")


def pictures(page: LivePage) -> "Locator":
    return page.page.locator("img")


def test_the_page_begins_with_the_scores_of_the_parameters_in_force(page: LivePage) -> None:
    assert shown_try(page) == 0
    assert 40 < score(page, "right, 1.5 voxels ↑") <= 100
    assert score(page, "keyframes") == 6
    assert "RMS depth error" not in page.text()  # three scores first, the others folded
    nearest_m = min(math.dist(page.position(), page.position(name)) for name in page.look().keyframes)
    assert nearest_m < 2.0  # inside the room, behind the first keyframe
    assert page.input("Surface density (per m)").count() == 1
    assert page.page.get_by_text("Hit if free").count() == 0
    page.screenshot("tune_parameters")


@pytest.mark.parametrize(("width", "height"), [(1920, 1080), (390, 844), (1280, 1000)])
def test_the_tabs_stand_in_one_row_and_nothing_is_cut_off(page: LivePage, width: int, height: int) -> None:
    page.page.set_viewport_size({"width": width, "height": height})
    page.until(lambda seen: page.input("Surface density (per m)").is_visible(), "the panel")
    page.pause(0.5)
    boxes = [tab.bounding_box() for tab in page.page.get_by_role("tab").all() if tab.is_visible()]
    assert len(boxes) == 7
    assert len({box["y"] for box in boxes if box}) == 1
    assert all(box and box["x"] >= 0 and box["x"] + box["width"] <= width for box in boxes)
    for name in ("Search", "Views", "Tries", "Noise", "Map", "Frames", "Parameters"):
        page.tab(name)
        page.pause(0.3)
        assert page.cut_off() == [], name
    page.screenshot(f"tune_{width}")


def test_a_slider_brings_a_new_score_and_another_map(page: LivePage) -> None:
    before, likelihood = page.look(), score(page, "fit, log-likelihood ↑")
    page.slide("Surface density (per m)", 5.0)
    rests(page, 1)
    assert score(page, "fit, log-likelihood ↑") != likelihood
    page.until(
        lambda seen: seen.settled and (seen.voxels, seen.colors) != (before.voxels, before.colors),
        "another map",
    )
    assert len(page.page.locator("svg circle").all()) >= 3
    assert re.search(r"(better|worse) [▲▼] [+-]\d", page.text())
    page.screenshot("tune_after_a_slider")


def test_a_method_brings_its_own_sliders(page: LivePage) -> None:
    page.page.get_by_label("Method", exact=True).first.click()
    page.page.get_by_role("option", name="log_odds", exact=True).click()
    rests(page, 2)
    page.until(lambda seen: page.input("Hit").is_visible(), "the sliders of log-odds")
    assert not page.page.get_by_text("Surface density (per m)").first.is_visible()
    page.screenshot("tune_log_odds")


def test_restore_brings_sliders_scores_and_map_back(page: LivePage) -> None:
    likelihood = {2: score(page, "fit, log-likelihood ↑")}
    page.tab("Tries")
    page.select("Selected try", re.compile(r"^1: "))
    page.press("Restore")
    rests(page, 1)
    assert score(page, "fit, log-likelihood ↑") != likelihood[2]
    page.tab("Parameters")
    box = page.input("Surface density (per m)").locator("xpath=..").get_by_role("textbox")
    page.until(lambda seen: box.input_value() == "5", "the slider where the try had it")


def test_the_curves_follow_the_sigma_slider_and_the_residuals_stay(page: LivePage) -> None:
    page.tab("Noise")
    page.page.locator(".uplot canvas").first.wait_for(state="visible")
    page.pause(0.5)
    before = plot(page)
    page.screenshot("tune_noise")
    page.slide("Sigma · 1 (m)", 0.03)
    page.until(lambda seen: plot(page) != before, "another curve")
    rests(page, 3)
    page.screenshot("tune_noise_moved")


def test_a_pinned_try_is_what_others_are_compared_with(page: LivePage) -> None:
    page.tab("Tries")
    page.select("Selected try", re.compile(r"^1: "))
    page.press("Pin")
    page.until(lambda seen: "against try 1" in page.text(), "the other reference")
    page.screenshot("tune_tries")
    page.tab("Views")
    page.until(lambda seen: "A (left): try 1" in page.text(), "the reference's picture")
    page.until(lambda seen: pictures(page).count() >= 2, "reference and this one; change and measured")
    widths = pictures(page).evaluate_all("all => all.map(picture => picture.naturalWidth)")
    assert widths.count(80 + 3 + 80) == 2  # A and B side by side
    page.select("Held-out view", "room-0007")
    page.pause(0.5)
    page.screenshot("tune_views")


def test_what_is_saved_is_accepted_and_has_its_scores(page: LivePage, tmp_path: Path) -> None:
    page.tab("Tries")
    page.select("Selected try", re.compile(r"^1: "))
    page.download("Save YAML").save_as(tmp_path / "try.yaml")
    saved = config.load(tmp_path / "try.yaml")
    assert saved.inference.surface_density == 5.0
    assert saved.voxel_size == 0.1
    assert "log-likelihood" in (tmp_path / "try.yaml").read_text()
    page.download("Save CSV").save_as(tmp_path / "tries.csv")
    lines = (tmp_path / "tries.csv").read_text().splitlines()
    assert len(lines) == 5
    assert "inference.surface_density" in lines[0]


def test_other_frames_begin_anew(page: LivePage) -> None:
    page.tab("Frames")
    page.slide("Count", 6)
    page.press("Use these frames")
    page.press("Discard them")
    page.until(lambda seen: "4 frames make the map" in page.text(), "the other frames")
    page.until(
        lambda seen: seen.settled and shown_try(page) == 0 and score(page, "keyframes") == 4, "their scores"
    )
    page.screenshot("tune_frames")


def test_a_search_for_the_chosen_objective_shows_its_verdict_and_offers_best_yaml(
    page: LivePage, tmp_path: Path
) -> None:
    pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")
    page.tab("Search")
    page.select("Objective", "right")
    page.slide("Tries", 5)
    page.press("Start a search")
    page.until(lambda seen: seen.settled and "that the search has not seen" in page.text(), "the verdict")
    page.screenshot("tune_search")
    page.download("Save best.yaml").save_as(tmp_path / "best.yaml")
    assert config.load(tmp_path / "best.yaml").voxel_size == 0.1
    assert "# Scores on 1 views that were never looked at before:" in (tmp_path / "best.yaml").read_text()
