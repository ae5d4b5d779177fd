"""The live page of a world that changes, in a real Chromium: a person who walks, and the slider of time."""

import re
from collections.abc import Iterator

import pytest
from browser import LivePage, Seen, chromium, live_page, missing

from taichi_mrf import MRFMap
from taichi_mrf.methods.mrf.reading import MapReading
from taichi_mrf.viewer.scene.coloring import DYNAMIC_COLOR

WALKER = "synthetic:room?moving=walker&width=80&height=60"
FRAMES, BEFORE_S = 13, 14
"""The person comes in at 16 s; every second frame is taken, one in two seconds."""

RED = """color => Object.entries(window.__viserMutable.nodeRefFromName).reduce((count, [name, node]) => {
  if (!node || !name.startsWith('/voxels/')) return count;
  node.traverse(object => {
    const c = object.isPoints ? object.geometry.attributes.color : {count: 0};
    for (let i = 0; i < c.count; i++)
      count += [c.getX(i), c.getY(i), c.getZ(i)].every((value, k) => Math.round(255 * value) === color[k]);
  });
  return count;
}, 0)"""

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture(scope="module")
def page() -> Iterator[LivePage]:
    """The room while a person walks in it; no more frames come."""
    flags = ("--voxel-size", "0.1", "--runtime.arch", "cpu", "--every", "2", "--limit", str(FRAMES))
    with chromium() as browser, live_page(browser, WALKER, *flags) as opened:
        opened.until_settled()
        yield opened
        assert opened.problems == []


@pytest.fixture(scope="module")
def saved(page: LivePage, tmp_path_factory: pytest.TempPathFactory) -> MRFMap:
    """The map as the page's button saves it."""
    return page.saved_map(tmp_path_factory.mktemp("saved"))


def voxels_of(m: MRFMap | MapReading) -> int:
    return len(m.decided.voxels(0.5)[0])


def red(page: LivePage) -> int:
    return int(page.page.evaluate(RED, list(DYNAMIC_COLOR)))


def said_dynamic(page: LivePage) -> int:
    found = re.search(r"([\d,]+) that move", page.text())
    return int(found[1].replace(",", "")) if found else 0


def test_what_moves_is_red_and_what_changed_has_boxes(page: LivePage, saved: MRFMap) -> None:
    dynamic = voxels_of(saved.dynamic)
    assert dynamic > 50
    page.tab("Map")
    page.until(lambda seen: "/changes" in seen.nodes, "boxes around what appeared and left")
    page.until(lambda seen: seen.agrees and red(page) == said_dynamic(page) == dynamic, "red voxels")
    page.screenshot("walker_dynamic")
    page.tick("Changes", on=False)
    page.until(lambda seen: seen.agrees and "/changes" not in seen.nodes, "no boxes")
    page.until(lambda seen: seen.agrees and red(page) == said_dynamic(page) == 0, "nothing red")
    page.tick("Changes")
    page.until(lambda seen: seen.agrees and red(page) == dynamic and "/changes" in seen.nodes, "all again")


def test_the_list_names_what_appeared(page: LivePage) -> None:
    line = r"\d+\.0 s: something of \d\.\d x \d\.\d x \d\.\d m (appeared|left) at \(.+, .+, .+\)"
    page.until(lambda seen: re.search(line, page.text()), "a line about the person")


def test_ticks_are_thin_lines_that_leave_the_thumb_to_be_seen(page: LivePage) -> None:
    ticks = page.input("Time (s)").locator(".mantine-Slider-mark")
    widths = ticks.evaluate_all("all => all.map(tick => tick.getBoundingClientRect().width)")
    assert len(widths) > 4
    assert max(widths) <= 1.5


def test_the_slider_shows_the_past_and_returns_to_now(page: LivePage, saved: MRFMap) -> None:
    now, then = voxels_of(saved), voxels_of(saved.at(BEFORE_S))
    assert now != then

    def showing(voxels: int) -> Seen:
        return page.until(lambda seen: seen.agrees and seen.voxels == voxels, f"{voxels} voxels")

    showing(now)
    page.slide("Time (s)", BEFORE_S)
    showing(then)
    page.screenshot("walker_before")
    page.slide("Time (s)", saved.now_s)
    showing(now)
    page.slide("Time (s)", BEFORE_S)
    showing(then)
    page.tab("Keyframes")
    page.select("Keyframe", "0: room-0000 (on)")
    page.press("On/off")
    page.until(lambda seen: seen.settled and seen.voxels not in (now, then), "the map after an edit")
    value = page.input("Time (s)").locator("xpath=..").get_by_role("textbox").input_value()
    assert float(value) == saved.now_s
