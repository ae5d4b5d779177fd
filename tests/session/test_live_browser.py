"""The live page in a real Chromium: what it shows, counted in the browser, and what its widgets do."""

import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from browser import Browser, LivePage, Seen, live_page, missing
from live_program import LiveProgram

from taichi_mrf import OCCUPIED, MRFMap
from taichi_mrf.datasets import open_dataset
from taichi_mrf.viewer.messages import LOG_ODDS_STEP

ROOM = "synthetic:room?frames=6&width=96&height=72"

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture(scope="module")
def program(browser: Browser) -> Iterator[LiveProgram]:
    """The room at a twentieth of its pace: one frame in four seconds, which a busy machine can draw. It
    begins when Chromium is there to see it."""
    options = ("--voxel-size", "0.08", "--runtime.arch", "cpu", "--speed", "0.05")
    with LiveProgram(ROOM, *options) as running:
        yield running


@pytest.fixture(scope="module")
def late_page(program: LiveProgram, browser: Browser) -> Iterator[LivePage]:
    """A page that was loaded when the map was complete. Whoever asks for it first sees the map grow."""
    with LivePage(browser, program.address) as opened:
        opened.until_settled()
        opened.page.reload()
        opened.until_settled()
        yield opened


@pytest.fixture(scope="module")
def saved(late_page: LivePage, tmp_path_factory: pytest.TempPathFactory) -> MRFMap:
    """The map as the page's button saves it."""
    m = late_page.saved_map(tmp_path_factory.mktemp("saved"))
    late_page.tab("Map")
    return m


@pytest.fixture
def page(late_page: LivePage, request: pytest.FixtureRequest) -> Iterator[LivePage]:
    """The same, with all widgets as they were at first; no test may leave an error behind."""
    late_page.tab("Map")
    yield late_page
    late_page.screenshot(request.node.name)
    assert late_page.problems == []


def voxels_of(m: MRFMap, probability: float) -> int:
    """How many voxels of a map are at least so probable."""
    return len(m.decided.voxels(probability)[0])


def test_voxels_appear_as_keyframes_arrive(program: LiveProgram, browser: Browser) -> None:
    equal_counts, keyframes = set(), set()
    with LivePage(browser, program.address) as page:

        def grown(seen: Seen) -> bool:
            if seen.agrees and seen.voxels:
                equal_counts.add(seen.voxels)
            keyframes.add(len(seen.keyframes))
            return seen.settled or min(len(equal_counts), len(keyframes)) >= 3

        page.until(grown, "a map that grows")
        page.select("Speed", "as fast as possible")
        final = page.until(lambda seen: seen.settled, "a complete map")
        page.screenshot("complete_early_page")
        assert page.problems == []
    assert len(equal_counts) >= 3, "the scene was equal to the page's count only now and then"
    assert len(keyframes) >= 3
    assert max(keyframes) <= len(final.keyframes) == 5  # one frame in six is kept out


def test_a_late_joiner_sees_the_whole_map(page: LivePage, saved: MRFMap) -> None:
    seen = page.look()
    assert seen.voxels == seen.said == voxels_of(saved, 0.5) > 1000
    assert len(seen.keyframes) == len(saved.keyframes)
    assert {"/path", "/camera"} <= set(seen.nodes)


def test_the_first_view_has_all_keyframes_in_it(page: LivePage) -> None:
    box = page.page.viewport_size
    for x, y, _ in page.places("/keyframes/", "picture"):
        assert 0 < x < box["width"]
        assert 0 < y < box["height"]


def test_the_threshold_moves_the_count(page: LivePage, saved: MRFMap) -> None:
    before = page.look()
    for threshold in (0.8, 0.2):
        page.slide("Threshold", threshold)
        others = (0, before.voxels)
        seen = page.until(lambda s, others=others: s.agrees and s.voxels not in others, "another count")
        odds = threshold / (1 - threshold) * np.exp([-LOG_ODDS_STEP, LOG_ODDS_STEP])
        most, fewest = (voxels_of(saved, p) for p in odds / (1 + odds))
        assert fewest <= seen.voxels <= most
        before = seen
    page.page.get_by_text("Threshold", exact=True).hover()
    page.until(lambda seen: "Show voxels whose probability" in page.text(), "the label's tooltip")
    page.nudge("Threshold", "ArrowRight")
    page.until(lambda seen: seen.agrees and seen.voxels < before.voxels, "fewer voxels")
    page.slide("Threshold", 0.5)
    page.until(lambda seen: seen.agrees and seen.voxels == voxels_of(saved, 0.5), "the first count")


def test_a_typed_threshold_takes_no_detour(page: LivePage) -> None:
    """The 0 of 0.8 is outside the slider's range; clamped, it would show almost every voxel."""
    before, counts = page.look(), set()
    box = page.input("Threshold").locator("xpath=..").get_by_role("textbox")
    box.press("Control+A")
    for key in "0.8":
        box.press(key)
        page.pause(0.3)
        counts.add(page.look().voxels)
    seen = page.until(lambda seen: seen.agrees and seen.voxels < before.voxels, "fewer voxels")
    assert box.input_value() == "0.8"
    assert max(counts | {seen.voxels}) == before.voxels
    page.slide("Threshold", 0.5)
    page.until(lambda seen: seen.agrees and seen.voxels == before.voxels, "the first count")


def test_the_colour_menu_changes_the_colours(page: LivePage) -> None:
    first = page.look()
    known = {first.colors}
    for mode, legend in [
        ("marginal probability", "chance that a voxel is occupied"),
        ("uncertainty", "bits"),
        ("keyframes that see it", "see the voxel"),
    ]:
        page.select("Color by", mode)
        seen = page.until(lambda seen: seen.colors not in known and seen.agrees, f"colours by {mode}")
        page.until(lambda seen, legend=legend: legend in page.text(), f"the scale of {mode}")
        page.screenshot(f"colours_{mode.replace(' ', '_')}")
        known.add(seen.colors)
        assert seen.voxels == first.voxels
    page.select("Color by", "height")
    page.until(lambda seen: seen.colors == first.colors, "the first colours")


def test_the_cut_hides_voxels_and_shows_a_picture(page: LivePage) -> None:
    before = page.look()
    assert "/cut" not in before.nodes
    page.select("Cut axis", "z")
    half = page.until(lambda seen: seen.agrees and 0 < seen.voxels < before.voxels, "fewer voxels")
    assert "/cut" not in page.look().nodes
    page.tick("Free space")
    page.until(lambda seen: len(page.places("/cut", "picture")) == 1, "the picture of the cut")
    page.screenshot("cut_z")
    page.slide("Cut at (m)", -0.7)
    lower = page.until(lambda seen: seen.agrees and 0 < seen.voxels < half.voxels, "fewer still")
    page.select("Cut axis", "x")
    page.until(lambda seen: seen.agrees and seen.voxels not in (0, lower.voxels), "another cut")
    page.screenshot("cut_x")
    seen = page.look()
    page.tick("Flip cut")
    page.until(lambda other: other.agrees and other.voxels + seen.voxels > before.voxels, "the other side")
    page.screenshot("cut_flipped")
    page.tick("Flip cut", on=False)
    page.select("Cut axis", "none")
    after = page.until(lambda seen: seen.agrees and seen.voxels == before.voxels, "all voxels")
    assert "/cut" not in after.nodes


def test_the_surface_takes_the_place_of_voxels(page: LivePage, saved: MRFMap) -> None:
    page.select("Draw as", "surface")
    expected = len(saved.surface().triangles)
    seen = page.until(lambda seen: seen.agrees and seen.triangles == expected, "the surface")
    assert seen.voxels == 0
    page.pause(1.0)
    page.screenshot("live_surface")
    corner = sorted(page.places("/surface/", "vertices"), key=lambda place: place[2])
    x, y, _ = page.free_places(corner[:20])[0]
    page.click(x, y)
    page.until(lambda seen: "/ray" in seen.nodes, "the ray in the scene")
    assert not page.input("Threshold").is_visible()  # it does nothing for a surface
    page.select("Draw as", "voxels")
    page.until(lambda seen: seen.agrees and seen.voxels == voxels_of(saved, 0.5), "voxels again")


def test_free_space_and_measured_points(page: LivePage, saved: MRFMap) -> None:
    before = page.look()
    page.tick("Free space")
    page.until(lambda seen: seen.agrees and 0 < seen.voxels < before.voxels, "fewer voxels")
    page.until(lambda seen: len(page.places("/cut", "picture")) == 1, "the picture of the cut")
    page.until(lambda seen: "unknown (not drawn)" in page.text(), "the key to its colours")
    assert page.input("Cut axis").input_value() == "z"
    page.screenshot("free_space")
    page.tick("Free space", on=False)
    page.until(lambda seen: seen.agrees and seen.voxels == before.voxels, "the whole map")
    page.tab("Keyframes")
    page.select("Keyframe", re.compile("^2: "))
    page.tab("Map")
    page.tick("Points")
    depth_m = saved.keyframes[2].depth_m
    said = f"{(depth_m > 0).sum():,} measured points"
    page.until(lambda seen: said in page.text() and "/measured" in seen.nodes, "its points")
    assert len(page.places("/measured", "points")) == (depth_m > 0).sum()
    assert page.look().voxels == before.voxels
    page.screenshot("measured_points")
    page.tick("Points", on=False)
    page.until(lambda seen: "/measured" not in seen.nodes, "no points")


def test_each_layer_goes_and_comes_by_itself(page: LivePage) -> None:
    before = page.look()
    for label, gone in (
        ("Map", lambda name: name.startswith("/voxels")),
        ("Path", lambda name: name in ("/path", "/camera")),
        ("Keyframes", lambda name: name.startswith("/keyframes")),
    ):
        page.tick(label, on=False)
        left = [name for name in before.nodes if not gone(name)]
        seen = page.until(lambda seen, left=left: seen.agrees and sorted(seen.nodes) == left, f"no {label}")
        assert len(seen.nodes) < len(before.nodes)
        page.tick(label)
        page.until(lambda seen: seen.agrees and seen.nodes == before.nodes, label)
    page.tick("Pictures", on=False)
    page.until(lambda seen: not page.places("/keyframes/", "picture"), "no pictures")
    page.tick("Pictures")
    page.until(lambda seen: page.places("/keyframes/", "picture"), "the pictures")


def test_the_outlines_of_bricks_come_and_go(page: LivePage) -> None:
    page.tick("Bricks")
    page.until(lambda seen: "/bricks" in seen.nodes, "the outlines")
    page.screenshot("bricks")
    page.tick("Bricks", on=False)
    page.until(lambda seen: "/bricks" not in seen.nodes, "no outlines")


def test_dark_and_light(page: LivePage) -> None:
    for dark in (True, False):
        page.page.emulate_media(color_scheme="dark" if dark else "light")
        scheme = "dark" if dark else "light"
        page.page.wait_for_selector(f'html[data-mantine-color-scheme="{scheme}"]', state="attached")
        corner = cv2.imread(str(page.screenshot(scheme)))[-40:, :40]
        assert 60 < corner.mean() < 160  # neither white nor black things merge with the background
    page.press("Dark or light")  # a user's choice, which the browser keeps
    page.page.wait_for_selector('html[data-mantine-color-scheme="dark"]', state="attached")
    page.page.reload()
    page.page.wait_for_selector('html[data-mantine-color-scheme="dark"]', state="attached")
    page.until_settled()
    page.press("Dark or light")
    page.page.wait_for_selector('html[data-mantine-color-scheme="light"]', state="attached")


def wait_for_the_plot(page: LivePage) -> str:
    """Wait until the plot of a ray has something in it; returns what is written beside it."""
    page.tab("Ray")
    page.page.locator(".uplot canvas").first.wait_for(state="visible")
    page.page.wait_for_function(
        """() => { const canvas = document.querySelector('.uplot canvas');
        const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
        const colors = new Set();
        for (let i = 0; i < data.length; i += 4)
            if (data[i + 3] > 250) colors.add(data[i] * 65536 + data[i + 1] * 256 + data[i + 2]);
        return colors.size >= 3; }"""
    )
    return page.text()


def place_of(text: str) -> tuple[float, ...]:
    """Coordinates of the voxel that the page answers about."""
    numbers = re.search(r"x, y, z \(m\)\s+(\S+), (\S+), (\S+)", text)
    assert numbers is not None
    return tuple(map(float, numbers.groups()))


def test_a_click_on_a_voxel_is_answered_beside_it_and_in_the_plot(page: LivePage, saved: MRFMap) -> None:
    nearest = sorted(page.places("/voxels/", "points"), key=lambda place: place[2])
    x, y, _ = page.free_places(nearest[:20])[0]
    page.click(x, y)
    page.until(lambda seen: "/ray" in seen.nodes, "the ray in the scene")
    answer = (
        page.until(
            lambda seen: re.search("alone each would say|it says:", page.text()), "the answer beside it"
        )
        and page.text()
    )
    first = place_of(answer)
    assert saved.decided.state([first]) == [OCCUPIED]
    said = float(re.search(r"probability\s+(\S+)", answer).group(1))
    assert abs(said - saved.decided.occupancy([first])[0]) < 0.002
    votes = page.page.get_by_role(
        "button", name=re.compile(r"^room-000\d: (occupied|free), \d+% · switch off$")
    )
    assert votes.count() >= 1
    other = max(page.free_places(nearest[20:400:20]), key=lambda place: np.hypot(place[0] - x, place[1] - y))
    page.click(*other[:2])
    page.until(lambda seen: "/distance" in seen.nodes and place_of(page.text()) != first, "the other voxel")
    apart_m = float(re.search(r"from the last click\s+(\S+) m", page.text()).group(1))
    assert abs(apart_m - np.linalg.norm(np.subtract(place_of(page.text()), first))) < 0.02  # both are rounded
    page.screenshot("voxel_answer")
    page.press("Close")
    page.until(
        lambda seen: "/distance" not in seen.nodes and "from the last click" not in page.text(), "no answer"
    )
    page.page.keyboard.down("Shift")
    page.page.mouse.move(x - 40, y - 40)
    page.page.mouse.down()
    page.page.mouse.move(x + 40, y + 40, steps=4)
    page.page.mouse.up()
    page.page.keyboard.up("Shift")
    page.until(lambda seen: votes.count() >= 1, "what keyframes say of the voxels in the rectangle")
    sizes_m = re.search(r"size x, y, z \(m\)\s+(\S+) x (\S+) x (\S+)", page.text()).groups()
    assert 0.1 < max(map(float, sizes_m)) < 4.0
    page.screenshot("rectangle")
    page.press("Close")
    text = wait_for_the_plot(page)
    assert re.search(r"Likeliest surface at \d+\.\d+ m \(p = [01]\.\d\d\)", text), text


@pytest.mark.usefixtures("saved")  # which starts Taichi, with which the room is rendered
def test_the_ray_of_a_pixel_is_that_of_its_measurement(page: LivePage) -> None:
    frame = open_dataset(ROOM).read(3)
    depth_m, camera = frame.depth_m, frame.camera
    v, u = np.argwhere(depth_m > 0)[1234].tolist()
    expected_m = depth_m[v, u] * np.hypot(
        1, np.hypot((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    )
    page.tab("Keyframes")
    page.select("Keyframe", f"3: {frame.name} (on)")
    page.tab("Ray")
    page.fill("Pixel (u, v)", u, v)
    page.press("Show the ray")
    page.until(lambda seen: f"{frame.name}, pixel ({u}, {v})" in page.text(), "that pixel's ray")
    assert f"measured {expected_m:.3f} m" in wait_for_the_plot(page)


def test_a_click_on_a_keyframes_picture_chooses_it(page: LivePage) -> None:
    page.tab("Keyframes")
    places = {id: page.places(f"/keyframes/{id}", "picture")[0] for id in range(5)}
    id = min(places, key=lambda id: places[id][2])
    page.click(*places[id][:2])
    page.until(lambda seen: page.input("Keyframe").input_value() == f"{id}: room-{id:04d} (on)", "the choice")
    page.tab("Ray")
    page.until(lambda seen: f"room-{id:04d}, pixel (" in page.text(), "the ray of the pixel")
    u, v = map(float, re.search(r"pixel \((\S+), (\S+)\)", page.text()).groups())
    boxes = page.input("Pixel (u, v)").locator("xpath=../../..").get_by_role("textbox")
    page.until(lambda seen: [float(boxes.nth(i).input_value()) for i in (0, 1)] == [u, v], "its pixel")
    assert abs(u - 47.5) < 24
    assert abs(v - 35.5) < 18


def test_three_images_beside_the_map(page: LivePage) -> None:
    page.tab("Images")
    page.tick("Show images")
    labels = ("measured depth", "depth rendered from the map", "accuracy")
    shown = "[...document.querySelectorAll('img')].filter(i => i.offsetParent)"  # in the tab that is in front
    sizes = f"() => {shown}.map(i => [i.naturalWidth, i.naturalHeight])"
    page.until(lambda seen: page.page.evaluate(sizes).count([96, 72]) == 3, "three images")
    page.until(lambda seen: re.search(r"\d+% right", page.text()), "their score")
    text = page.text()
    for label in labels:
        assert label in text
    page.screenshot("images")
    page.select("Images of", "chosen keyframe")
    name = page_chosen(page)
    page.tab("Images")
    page.until(lambda seen: name in page.text(), "the chosen keyframe's images")
    page.select("Images of", "current camera")
    page.tick("Show images", on=False)


def page_chosen(page: LivePage) -> str:
    """The name of the keyframe that is chosen."""
    page.tab("Keyframes")
    return page.input("Keyframe").input_value().split()[1]


def test_the_baseline_is_shown_beside_the_map(page: LivePage) -> None:
    page.page.mouse.move(400, 600)
    page.page.mouse.wheel(0, -300)  # a viewpoint of the user's own
    page.pause(1.0)
    before, eye = page.look(), page.position()
    page.tick("Baseline")
    seen = page.until(lambda seen: seen.settled and seen.baseline > 1000, "the other map")
    assert seen.voxels == before.voxels
    page.screenshot("baseline")
    page.tick("Baseline", on=False)
    page.until(lambda seen: seen.agrees and seen.said_baseline == 0, "the map alone")
    np.testing.assert_allclose(page.position(), eye, atol=1e-6)


def test_a_map_with_colours_has_a_baseline_without(browser: Browser) -> None:
    with live_page(
        browser, ROOM, "--color", "--limit", "3", "--voxel-size", "8cm", "--runtime.arch", "cpu"
    ) as page:
        page.until_settled()
        page.tick("Baseline")
        page.until(lambda seen: seen.settled and seen.baseline > 1000, "the other map")
        page.screenshot("baseline_of_colours")
        assert page.problems == []


def test_a_link_begins_with_the_view_that_it_was_made_of(
    page: LivePage, program: LiveProgram, browser: Browser
) -> None:
    first = page.position()
    page.page.mouse.move(400, 600)
    page.page.mouse.wheel(0, -300)
    page.until(lambda seen: np.linalg.norm(np.subtract(page.position(), first)) > 0.1, "another view")
    lens = "() => ['fov', 'near', 'far'].map(name => window.__viserMutable.camera[name])"
    wide = page.page.evaluate(lens)
    page.press("Top")
    page.until(lambda seen: page.page.evaluate(lens)[0] < wide[0], "a longer lens")
    page.pause(1.0)
    eye, long = page.position(), page.page.evaluate(lens)
    page.tab("Save")
    page.press("Link to this view")
    page.until(lambda seen: "now leads to this view" in page.text(), "the notification")
    link = page.page.url
    with LivePage(browser, program.address) as other:
        other.page.goto("about:blank")
        other.page.goto(link)
        other.until_settled()
        other.pause(1.0)
        np.testing.assert_allclose(other.position(), eye, atol=1e-3)
        np.testing.assert_allclose(other.page.evaluate(lens), long, rtol=0.01)
        assert other.problems == []
    page.page.evaluate(
        "history.replaceState(null, '', location.pathname + location.search)"
    )  # for later tests
    page.tab("Map")
    page.press("Home")


def test_two_viewers_in_a_wide_and_a_narrow_window(
    page: LivePage, program: LiveProgram, browser: Browser
) -> None:
    before = page.look()
    with LivePage(browser, program.address, width=400, height=700) as narrow:
        assert not narrow.input("Draw as").is_visible()  # the panel is folded at first
        narrow.until(lambda seen: seen.voxels == before.voxels, "the voxels")
        places = np.array(narrow.places("/voxels/", "points"))[:, :2]
        assert ((places > 0) & (places < (400, 700))).all()
        narrow.page.get_by_text("taichi_mrf: ").click()
        assert narrow.until_settled().voxels == before.voxels
        narrow.screenshot("narrow")
        assert narrow.page.evaluate("() => document.documentElement.scrollWidth") <= 400
        for label in ("Threshold", "Draw as", "Size"):
            widget = narrow.input(label)
            widget.scroll_into_view_if_needed()
            box = widget.bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= 400
        narrow.slide("Threshold", 0.9)
        seen = narrow.until(lambda seen: seen.agrees and seen.voxels < before.voxels, "fewer voxels")
        page.until(lambda other: other.agrees and other.voxels == seen.voxels, "the same for both")
        page.slide("Threshold", 0.5)
        narrow.until(lambda other: other.agrees and other.voxels == before.voxels, "the same for both")
        assert narrow.problems == []


CHOSEN_TAB = """() => {
  const tab = [...document.querySelectorAll("[role=tab][aria-selected=true]")].find(tab => tab.offsetParent);
  let behind = tab;
  while (getComputedStyle(behind).backgroundColor === "rgba(0, 0, 0, 0)") behind = behind.parentElement;
  const colors = [getComputedStyle(tab).color, getComputedStyle(behind).backgroundColor];
  return colors.map(color => color.match(/[0-9.]+/g).slice(0, 3).map(Number));
}"""
"""The colours of the chosen tab's name and of what is behind it."""


def contrast(colors: list[list[int]]) -> float:
    """Ratio of the luminances of two colours, as the Web Content Accessibility Guidelines have it."""
    share = np.array(colors) / 255
    linear = np.where(share > 0.04045, ((share + 0.055) / 1.055) ** 2.4, share / 12.92)
    dark, light = sorted(linear @ (0.2126, 0.7152, 0.0722) + 0.05)
    return float(light / dark)


@pytest.mark.parametrize(
    ("width", "height", "scheme"),
    [(1280, 800, "dark"), (1920, 1080, "light"), (390, 844, "light"), (390, 844, "dark")],
)
def test_nothing_is_cut_off(
    program: LiveProgram, browser: Browser, width: int, height: int, scheme: Literal["dark", "light"]
) -> None:
    with LivePage(browser, program.address, width, height) as page:
        page.page.emulate_media(color_scheme=scheme)
        if not page.input("Draw as").is_visible():
            page.page.get_by_text("taichi_mrf: ").click()
        page.until_settled()
        for tab in ("Map", "Keyframes", "Ray", "Images", "Save", "About"):
            page.tab(tab)
            page.pause(0.3)
            assert page.cut_off() == [], tab
            assert contrast(page.page.evaluate(CHOSEN_TAB)) > 4.5, tab
        page.screenshot(f"{width}_{scheme}")
        assert page.problems == []
        page.page.evaluate("() => { document.querySelector('[role=tab]').style.marginLeft = '-3000px'; }")
        assert "Map" in page.cut_off()


SLOW_TO_DRAW = """const draw = requestAnimationFrame;
window.requestAnimationFrame = then => setTimeout(() => draw(then), 500);"""


@pytest.mark.parametrize(("scheme", "script"), [("light", ""), ("dark", SLOW_TO_DRAW)])
def test_on_a_phone_an_answer_is_read_below_the_middle_and_closed(
    program: LiveProgram, browser: "Browser", scheme: Literal["dark", "light"], script: str
) -> None:
    with LivePage(browser, program.address, 390, 844, script) as page:
        page.page.emulate_media(color_scheme=scheme)
        page.until(lambda seen: seen.settled and (seen.voxels or seen.triangles), "the map")
        close = page.page.get_by_role("button", name="Close", exact=True)
        cell = page.page.get_by_role("cell", name="probability", exact=True)

        def answered(seen: Seen) -> bool:
            """Clicks again if the page's first view came late and took away what was clicked on."""
            if not cell.count():
                places = [*page.places("/voxels/", "points"), *page.places("/surface/", "vertices")]
                nearest = min(page.free_places(places[::20]), key=lambda place: place[2])
                page.click(*nearest[:2])
                page.pause(2.0)
            return bool(cell.count())

        page.until(answered, "an answer to a click")
        lines = [cell, page.page.get_by_text(re.compile("alone each would say|it says:")), close]

        def can_be_read(seen: Seen) -> bool:
            boxes = [line.bounding_box() for line in lines if line.count()]
            return len(boxes) == 3 and all(b and 422 < b["y"] < b["y"] + b["height"] <= 844 for b in boxes)

        page.until(can_be_read, "the answer in the lower half of the window")
        page.screenshot(f"phone_answer_{scheme}")
        close.click()
        page.until(lambda seen: not page.input("Draw as").is_visible(), "the folded panel")
        assert page.problems == []


def test_the_ground_and_the_axes_come_and_go(page: LivePage, saved: MRFMap) -> None:
    levels_m, voxels = np.unique(saved.decided.voxels(0.5)[0][:, 2], return_counts=True)
    floor_m = levels_m[np.argmax(voxels)]
    assert abs(page.position("/ground")[2] - floor_m) < 1.01 * saved.voxel_size
    assert "ground: 1 m squares" in page.text()
    for label, node in (("Ground", "/ground"), ("Axes", "/WorldAxes")):
        page.tick(label, on=False)
        page.until(lambda seen, node=node: node not in seen.nodes, f"no {node}")
    assert "1 m squares" not in page.text()  # a tooltip may tell of squares
    for label, node in (("Ground", "/ground"), ("Axes", "/WorldAxes")):
        page.tick(label)
        page.until(lambda seen, node=node: node in seen.nodes, node)


def test_buttons_and_keys_show_the_whole_map_from_a_side(page: LivePage, saved: MRFMap) -> None:
    places = page.places
    edge = page.input("Follow").bounding_box()["x"] - 120  # where the panel begins
    centres = saved.decided.voxels(0.5)[0]
    low_m, high_m = centres.min(axis=0), centres.max(axis=0)

    def fitted(axis: int, sign: int) -> bool:
        """The eye looks at this side of the room; all is in the window, and nothing behind the panel."""
        eye = np.array(page.position())
        outside_m = np.maximum(low_m - eye, eye - high_m)
        seen = np.array(places("/voxels/", "points"))
        inside = (seen[:, :2] > 0).all() and (seen[:, 0] < edge).all() and (seen[:, 1] < 800).all()
        return bool(inside and np.argmax(outside_m) == axis and np.sign(eye[axis]) == sign)

    for press, axis, sign in (
        (lambda: page.press("Top"), 2, 1),
        (lambda: page.press("Front"), 1, -1),
        (lambda: page.press("Side"), 0, 1),
        (lambda: page.page.keyboard.press("1"), 2, 1),
        (lambda: page.page.keyboard.press("2"), 1, -1),
        (lambda: page.page.keyboard.press("3"), 0, 1),
    ):
        press()
        page.until(lambda seen, axis=axis, sign=sign: fitted(axis, sign), f"axis {axis} from {sign}")
    page.page.mouse.move(400, 600)
    page.page.mouse.wheel(0, -600)
    page.until(lambda seen: not fitted(0, 1), "a nearer view")
    page.page.keyboard.press("0")
    page.until(lambda seen: fitted(0, 1), "all of it again")


def reset(page: LivePage) -> None:
    """Press Reset, and confirm it."""
    page.press("Reset")
    page.press("Delete the map and start again")


def test_the_view_follows_the_camera(page: LivePage) -> None:
    away = np.linalg.norm(np.subtract(page.position(), page.position("/camera")))
    page.page.keyboard.press("f")
    page.until(lambda seen: page.input("Follow").is_checked(), "the box beside it")
    page.select("Speed", "0.25x")  # or a machine that draws slowly sees only the end
    reset(page)
    places = set()

    def followed(seen: Seen) -> bool:
        if "/camera" not in seen.nodes:
            return False
        camera, eye = page.position("/camera"), page.position()
        if np.linalg.norm(np.subtract(camera, eye)) < 0.5 * away:
            places.add(camera)
        return len(places) >= 2

    page.until(followed, "an eye that moves with the camera")
    page.select("Speed", "2x")
    page.screenshot("followed")
    page.until_settled()
    behind = page.position()
    page.page.reload()
    page.until(lambda seen: seen.settled and np.allclose(page.position(), behind, atol=0.01), "the same view")
    page.tick("Follow", on=False)


def test_a_signal_ends_it_while_a_page_watches_and_keeps_what_is_mapped(
    browser: Browser, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    options = ("--voxel-size", "0.08", "--runtime.arch", "cpu", "--out", out)
    with LiveProgram(ROOM, *options, "--speed", "0.01") as program:  # one frame in twenty seconds
        with LivePage(browser, program.address) as page:
            page.until(lambda seen: seen.agrees and seen.voxels, "voxels")
            assert 1 <= len(page.look().keyframes) < 5
            status, _ = program.end(signal.SIGINT)
        assert status == 128 + signal.SIGINT
        program.wait_until_nothing_is_left()
    assert {path.name for path in out.iterdir()} == {"map.npz", "voxels.ply", "config.yaml", "report.json"}
    m = MRFMap.load(out / "map.npz")
    assert 1 <= len(m.keyframes) < 5
    assert len(m.voxels(0.5)[0]) > 0
