"""A stranger's recording names its frames as it likes: every text of both pages stays text, in Chromium."""

import html
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser
from browser import Browser, LivePage, missing
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.viewer import messages as m
from taichi_mrf.viewer.live.page import Page
from taichi_mrf.viewer.scene.base_page import NewPage
from taichi_mrf.viewer.scene.widgets import LONGEST, in_html, in_markdown
from taichi_mrf.viewer.transport.downloads import standalone_page
from taichi_mrf.viewer.transport.server import start_server
from taichi_mrf.viewer.tune import messages as t
from taichi_mrf.viewer.tune.messages import Scores
from taichi_mrf.viewer.tune.page import TunePage

HOSTILE = (
    "<iframe srcdoc=\"<script>parent.ran='srcdoc'</script>\"></iframe>"
    "<img src=x onerror=\"window.ran='onerror'\"><svg onload=\"window.ran='onload'\"></svg>"
    "<a href=\"javascript:window.ran='href'\">link</a>[link](javascript:alert(1)) ![](x) `{1}` </pre></td>"
    "\n```\n<script>window.ran='script'</script>\n\n# heading\n"
)
"""Works as a file's name, but for the slashes."""

SHOWN = "<iframe srcdoc="
"""Part of it that must be seen as text wherever it is shown."""

FOREIGN = """() => ({
  ran: window.ran ?? null,
  elements: [...document.querySelectorAll('iframe, [onerror], [onload], [srcdoc], img[src="x"], h1, code, a')]
    .map(each => each.outerHTML.slice(0, 200)),
})"""

needs_chromium = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@given(st.text())
def test_html_reads_as_the_text(text: str) -> None:
    escaped = in_html(text)
    assert not set(escaped) & set("<>\"'")
    assert len(html.unescape(escaped)) == len(text)


@given(st.text())
def test_markdown_has_no_markup_but_the_entities_of_its_characters(text: str) -> None:
    escaped = in_markdown(text)
    assert "\n" not in escaped
    assert not set(escaped) & set("<>[]()*_`~$|!\\\"'{}=+-:/@.")
    assert len(html.unescape(escaped)) <= LONGEST


def test_text_that_turns_around_is_not_shown_so() -> None:
    assert "\u202e" not in in_markdown("safe\u202egnp.exe")
    assert "\x1b" not in in_html("\x1b[2J")


CAMERA = PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5)
PICTURE = np.zeros((4, 4, 3), np.uint8)
ONE = np.ones(1, np.float32)
LIVE_UPDATES: tuple[m.Update, ...] = (
    m.Hello(
        HOSTILE,
        HOSTILE,
        HOSTILE,
        HOSTILE,
        0.1,
        -2.0,
        0.1,
        f"voxel_size: 0.1\n{HOSTILE}",
        recordings=(HOSTILE, "b"),
    ),
    m.KeyframeInfo(0, HOSTILE, np.eye(4), CAMERA, 1, "on", PICTURE, np.zeros((0, 3), np.int32), np.eye(4)),
    m.CurrentCamera(HOSTILE, np.eye(4), CAMERA),
    m.Status(HOSTILE, 0.5, 1, 2, 1, 0, 1.0, 1, 1, 1.0, False, False, False),
    m.Notice(HOSTILE, "error"),
    m.Notice(HOSTILE, "warning"),
    m.RayAnswer(HOSTILE, (0, 0, 0), (1, 0, 0), ONE, ONE, ONE, ONE, ONE, 1.0, 0.0, 0.01, 0, (1, 1)),
    m.Images(HOSTILE, PICTURE, PICTURE, PICTURE, HOSTILE),
)
SCORES = Scores(0.5, 0.5, 0.5, 0.1, 0.1, 0.1, 1.0, 0.1, float("nan"), 1.0, 10, 2)
CONFIG = Config(sensor=SensorConfig(sigma_table=HOSTILE))
TUNE_UPDATES: tuple[m.Update, ...] = (
    t.Tuning(HOSTILE, HOSTILE, HOSTILE, CONFIG, t.FrameChoice(), 3, (HOSTILE,), (HOSTILE,), (HOSTILE,)),
    LIVE_UPDATES[0],
    LIVE_UPDATES[1],
    t.Activity(HOSTILE, 0.5, busy=True),
    t.Tried(0, Config(), SCORES, "start"),
    t.Tried(1, CONFIG, SCORES, "hand"),
    t.Pinned(0),
    t.Chosen(1, CONFIG),
    t.Residuals(1, ONE, ONE, np.ones(1), np.ones(1), np.ones(1)),
    t.Verdict(1, {HOSTILE: SCORES, "found": SCORES}),
    t.HeldOutView(HOSTILE, PICTURE, HOSTILE, HOSTILE, PICTURE, HOSTILE),
    m.Notice(HOSTILE, "error"),
)


@contextmanager
def served(
    new_page: NewPage,
    updates: tuple[m.Update, ...],
) -> Iterator[tuple[viser.ViserServer, Callable[[], None]]]:
    """A page that runs, its server, and what sends it the updates."""
    server = start_server("127.0.0.1", 0, "Hostile")
    page = new_page(server, lambda request: None)
    thread = threading.Thread(target=page.run, daemon=True)
    thread.start()

    def send() -> None:
        for update in updates:
            page.inbox.put(update)

    try:
        yield server, send
    finally:
        page.inbox.put(None)
        thread.join()
        server.stop()


@needs_chromium
@pytest.mark.parametrize(
    ("new_page", "updates", "counts"),
    [
        (
            Page,
            LIVE_UPDATES,
            {"Map": 1, "Keyframes": 1, "Ray": 2, "Images": 3, "Save": 1, "About": 8},
        ),
        (
            TunePage,
            TUNE_UPDATES,
            {"Parameters": 1, "Noise": 2, "Views": 4, "Tries": 2, "Map": 1, "Frames": 5},
        ),
    ],
    ids=["live", "tune"],
)
def test_hostile_names_are_shown_as_text(
    browser: Browser,
    new_page: Any,
    updates: tuple[m.Update, ...],
    counts: dict[str, int],
) -> None:
    """``counts`` are how often each tab, with what is above the tabs, shows a hostile text."""
    with (
        served(new_page, updates) as (server, send),
        LivePage(browser, f"http://127.0.0.1:{server.get_port()}", height=1000) as page,
    ):
        at_first = page.page.evaluate(FOREIGN)["elements"]
        send()
        page.until(lambda seen: SHOWN in page.text(), "the hostile text")
        for tab, count in counts.items():
            page.tab(tab)
            page.until(
                lambda seen, count=count: page.text().count(SHOWN) >= count,
                f"the texts of the tab {tab}",
            )
            found = page.page.evaluate(FOREIGN)
            assert found["ran"] is None
            assert set(found["elements"]) <= set(at_first)
        page.screenshot(f"hostile_{new_page.__name__}")
        assert page.problems == []


@needs_chromium
def test_the_policy_stops_scripts_that_reach_the_page(browser: Browser) -> None:
    """Were a text not escaped, the browser would still run nothing of it."""
    server = start_server("127.0.0.1", 0, "Unescaped")
    try:
        with LivePage(browser, f"http://127.0.0.1:{server.get_port()}") as page:
            server.gui.add_html(HOSTILE + "<b id=there>raw</b>")
            server.gui.add_markdown(HOSTILE.partition("[link]")[0].replace("onerror", "data-x"))
            page.page.wait_for_selector("#there")
            page.page.wait_for_selector("iframe", state="attached")
            page.page.get_by_text("link", exact=True).first.click()
            page.pause(0.5)
            assert page.page.evaluate(FOREIGN)["ran"] is None
            blocked = "\n".join(page.problems)
            assert "Content Security Policy" in blocked
    finally:
        server.stop()


@needs_chromium
def test_the_saved_page_runs_no_script_of_a_scene(browser: Browser, tmp_path: Path) -> None:
    """A label that is raw HTML stands for any text that somebody forgot to escape."""
    server = start_server("127.0.0.1", 0, "Saved")
    try:
        server.scene.add_point_cloud("/voxels/0", np.zeros((3, 3), np.float32), np.zeros(3, np.uint8))
        html = standalone_page(server.get_scene_serializer())
    finally:
        server.stop()
    foreign = HOSTILE.partition("<a href")[0] + "<script>window.ran='script'</script><b id=there></b>"
    (tmp_path / "map.html").write_text(html.replace("<body>", f"<body>{foreign}"), encoding="utf-8")
    with LivePage(browser, (tmp_path / "map.html").as_uri()) as page:
        page.until(lambda seen: seen.voxels == 3, "the points")
        page.page.wait_for_selector("#there", state="attached")
        page.pause(0.5)
        assert page.page.evaluate(FOREIGN)["ran"] is None
        assert "Content Security Policy" in "\n".join(page.problems)
