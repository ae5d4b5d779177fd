"""Handling the map on the live page in a real Chromium: replay, keyframes, and files to take away.

What an edit must lead to is computed here from the saved map: the same edit, and full inference.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import trimesh
import zstandard
from browser import Browser, LivePage, Seen, missing
from live_program import LiveProgram

from taichi_mrf import MRFMap

ROOM = "synthetic:room?frames=6&width=96&height=72"
KEYFRAME, NAME = 2, "room-0002"
"""The one that is edited: its number on the page, which a saved map may not know, and its name."""

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the run."""
    return tmp_path_factory.mktemp("out")


@pytest.fixture(scope="module")
def program(out: Path, browser: Browser) -> Iterator[LiveProgram]:
    """The room at a fiftieth of its pace, which leaves 40 s to open a page and press a button; Chromium is
    there before it begins."""
    options = ("--voxel-size", "0.08", "--runtime.arch", "cpu", "--speed", "0.02", "--out", out)
    with LiveProgram(ROOM, *options) as running:
        yield running


@pytest.fixture(scope="module")
def opened_page(program: LiveProgram, browser: Browser) -> Iterator[LivePage]:
    with LivePage(browser, program.address) as opened:
        yield opened


@pytest.fixture
def page(opened_page: LivePage, request: pytest.FixtureRequest) -> Iterator[LivePage]:
    """One page for all tests; none may leave an error behind."""
    yield opened_page
    opened_page.screenshot(request.node.name)
    assert opened_page.problems == []


@pytest.fixture
def edited(page: LivePage, tmp_path: Path) -> MRFMap:
    """The map that the page shows, as a copy to edit; the page's tab of keyframes is in front."""
    page.until_settled()
    copy = page.saved_map(tmp_path)
    count = len(copy.decided.voxels(0.5)[0])  # votes of rays are counted when there is nothing else to do
    page.until(lambda seen: seen.settled and seen.voxels == count, "what is occupied")
    page.tab("Keyframes")
    if not page.input("Keyframe").input_value().startswith(f"{KEYFRAME}:"):
        page.select("Keyframe", f"{KEYFRAME}: {NAME} (on)")
        page.until(lambda seen: page.input("Keyframe").input_value().startswith(f"{KEYFRAME}:"), "the choice")
    return copy


def number_of(m: MRFMap) -> int:
    """The number that a map gives the keyframe that is edited."""
    return next(id for id, keyframe in m.keyframes.items() if keyframe.name == NAME)


def settled_count(m: MRFMap) -> int:
    """Voxels of at least one half after full inference."""
    m.infer()
    return len(m.decided.voxels(0.5)[0])


def until_count(page: LivePage, count: int, what: str) -> None:
    """Wait until the page shows exactly so many voxels and is at rest."""
    page.until(lambda seen: seen.settled and seen.voxels == count, f"{count} voxels {what}")


def at_rest(page: LivePage) -> Seen:
    """Screenshot of the page once it no longer changes: small changes of colour come late."""
    seen = page.until(lambda seen: seen.settled, "a settled map")
    while True:
        page.pause(1.0)
        before, seen = seen, page.until(lambda seen: seen.settled, "a settled map")
        if (seen.voxels, seen.colors) == (before.voxels, before.colors):
            return seen


def until_same(page: LivePage, before: Seen, what: str) -> Seen:
    """Wait until the page shows what it once did, to the last colour, and is at rest."""
    return page.until(
        lambda seen: seen.settled and (seen.voxels, seen.colors) == (before.voxels, before.colors), what
    )


def test_pause_step_speed_and_go(page: LivePage) -> None:
    page.press("Pause")
    paused = page.until(lambda seen: "paused" in seen.activity and seen.agrees, "a pause")
    page.select("Speed", "4x")
    page.pause(1.0)  # all frames at this pace
    still = page.look()
    assert still.keyframes == paused.keyframes
    for step in (1, 2):
        page.press("Step")
        count = len(paused.keyframes) + step
        page.until(lambda seen, count=count: len(seen.keyframes) == count and seen.agrees, "one more")
        page.until(lambda seen: "paused" in seen.activity, "a pause")
        assert len(page.look().keyframes) == count < 5
    page.press("Play")
    assert len(page.until_settled().keyframes) == 5


def test_a_keyframe_is_taken_out_and_comes_back(page: LivePage, edited: MRFMap) -> None:
    before = at_rest(page)
    edited.remove_keyframe(number_of(edited))
    without = settled_count(edited)
    assert 0 < without < before.voxels
    page.press("On/off")
    until_count(page, without, "without it")
    page.screenshot("keyframe_off")
    assert "(off)" in page.input("Keyframe").input_value()
    page.page.keyboard.press("Control+z")
    until_same(page, before, "the same map with it again")
    assert "(on)" in page.input("Keyframe").input_value()
    page.press("Redo")
    until_count(page, without, "without it again")
    page.press("On/off")
    until_same(page, before, "the same map with it at last")
    assert not page.page.get_by_role("button", name="Redo", exact=True).is_visible()


def test_several_keyframes_are_switched_off_and_taken_back_at_once(page: LivePage, edited: MRFMap) -> None:
    before = at_rest(page)
    page.press("All off")
    page.until(lambda seen: seen.settled and seen.voxels == 0, "a map of no keyframe")
    page.press("Undo")
    until_same(page, before, "the same map with all of them again")
    page.fill("From, to", 0, 1)
    page.press("All off")
    page.until(lambda seen: seen.settled and 0 < seen.voxels < before.voxels, "the map without them")
    page.screenshot("several_off")
    page.press("Undo")
    until_same(page, before, "the same map with them again")


def test_a_keyframe_is_switched_off_where_it_says_that_a_voxel_is_occupied(
    page: LivePage, edited: MRFMap
) -> None:
    before = at_rest(page)
    nearest = sorted(page.places("/voxels/", "points"), key=lambda place: place[2])
    page.click(*page.free_places(nearest[:20])[0][:2])
    page.until(lambda seen: re.search("alone each would say|it says:", page.text()), "what keyframes say")
    button = page.page.get_by_role("button", name=re.compile(" · switch off$")).first
    name = re.search(r"room-\d+", button.inner_text()).group()
    button.click()
    edited.remove_keyframe(next(id for id, keyframe in edited.keyframes.items() if keyframe.name == name))
    until_count(page, settled_count(edited), f"without {name}")
    assert page.page.get_by_role("button", name=re.compile(f"^{name}: .* · switch off$")).count() == 0
    page.press("Undo")
    until_same(page, before, "the same map with it again")
    page.press("Close")


def test_a_keyframe_is_moved_by_its_position_and_put_back(
    page: LivePage, edited: MRFMap, tmp_path: Path
) -> None:
    """Its gizmo goes along."""
    before, box, node = at_rest(page), page.input("Position (m)"), f"/keyframes/{KEYFRAME}"
    start = np.array(page.position(node))

    def until_at(x: float, what: str) -> None:
        def both_there(seen: Seen) -> bool:
            keyframe, gizmo = page.position(node), page.position("/gizmo")
            return abs(keyframe[0] - x) < 1e-6 and np.allclose(gizmo, keyframe, atol=1e-6)

        page.until(both_there, f"keyframe and gizmo {what}")

    page.press("Move")
    page.until(lambda seen: "/gizmo" in seen.nodes, "the gizmo")
    x = round(float(box.input_value()) + 0.3, 2)
    page.fill("Position (m)", x)  # at once: between keys, a slow machine takes what is typed so far
    until_at(x, "typed")
    page.until(lambda seen: seen.settled and seen.voxels != before.voxels, "another map")
    moved = page.saved_map(tmp_path)
    T = moved.keyframes[number_of(moved)].T_world_camera
    np.testing.assert_allclose(T[:3, 3], [x, start[1], start[2]], atol=1e-4)
    edited.move_keyframe(number_of(edited), T)
    page.tab("Keyframes")
    until_count(page, settled_count(edited), "with it there")
    page.screenshot("keyframe_moved")
    page.press("Put back")
    until_at(start[0], "put back")
    page.press("Undo")
    until_at(x, "there again")
    page.page.keyboard.press("Control+Shift+Z")
    until_at(start[0], "put back again")
    until_same(page, before, "the same map with it where it was")
    np.testing.assert_allclose(page.position(node), start, atol=1e-6)
    page.press("Move")
    page.until(lambda seen: "/gizmo" not in seen.nodes, "no gizmo")


def test_a_keyframe_is_dragged_by_its_gizmo(page: LivePage, edited: MRFMap) -> None:
    before, start = page.look(), page.position(f"/keyframes/{KEYFRAME}")

    def moved_m() -> float:
        return float(np.linalg.norm(np.subtract(page.position(f"/keyframes/{KEYFRAME}"), start)))

    page.press("Move")
    page.until(lambda seen: "/gizmo" in seen.nodes, "the gizmo")
    for axis in ARROWS:  # one of them may point at the eye, or lie behind another part of the gizmo
        page.pause(1.0)
        page.screenshot("gizmo")
        tail, tip = (np.array(page.places("/gizmo", "origin", point)[0][:2]) for point in ((0, 0, 0), axis))
        drag(page, tip, tip + 60 * (tip - tail) / np.linalg.norm(tip - tail))
        page.pause(1.0)
        if moved_m() > 0.1:
            break
    page.until(lambda seen: moved_m() > 0.1, "a keyframe somewhere else")
    page.until(lambda seen: seen.settled and seen.voxels != before.voxels, "another map")
    page.screenshot("gizmo_dragged")
    page.press("Move")
    page.until(lambda seen: "/gizmo" not in seen.nodes, "no gizmo")
    page.press("Put back")
    until_count(page, before.voxels, "with it where it was")


ARROWS = [(0.4, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.4)]
"""Points on the gizmo's arrows, which are half a metre long."""


def drag(page: LivePage, start: np.ndarray, end: np.ndarray) -> None:
    """Drag with the left button, slowly enough for a page that is drawn by software."""
    mouse = page.page.mouse
    mouse.move(*start)
    page.pause(0.5)  # until the arrow under the mouse is lit
    mouse.down()
    for share in np.linspace(0, 1, 8):
        mouse.move(*(start + share * (end - start)))
        page.pause(0.1)
    mouse.up()


def test_the_saved_map_is_the_one_that_is_shown(page: LivePage, tmp_path: Path, out: Path) -> None:
    shown = at_rest(page)
    page.tab("Save")
    assert "The map has changes that are not saved" in page.text()
    assert len(page.saved_map(tmp_path).decided.voxels(0.5)[0]) == shown.voxels
    assert (out / "map.npz").read_bytes() == (tmp_path / "saved.npz").read_bytes()
    page.until(lambda seen: "not saved" not in page.text(), "nothing unsaved")


def test_the_voxels_open_as_ply(page: LivePage, tmp_path: Path) -> None:
    page.tab("Save")
    page.download("Voxels (.ply)").save_as(tmp_path / "voxels.ply")
    cloud = trimesh.load(tmp_path / "voxels.ply")
    page.until(lambda seen: seen.voxels == len(cloud.vertices), "the voxels of the file")


def test_the_picture_shows_the_map(page: LivePage, tmp_path: Path) -> None:
    page.tab("Save")
    page.download("Picture (.png)").save_as(tmp_path / "view.png")
    picture = cv2.imread(str(tmp_path / "view.png"))
    assert picture.shape[0] > 300
    assert picture.shape[1] > 300
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_the_standalone_page_shows_the_map(page: LivePage, browser: Browser, tmp_path: Path) -> None:
    page.tab("Save")
    page.download("Page (.html)").save_as(tmp_path / "map.html")
    with LivePage(browser, (tmp_path / "map.html").as_uri()) as standalone:
        shown = page.look()
        standalone.until(lambda seen: seen.voxels == shown.voxels, "the map without a server")
        standalone.pause(1.0)
        standalone.screenshot("standalone")
        assert standalone.problems == []


def test_a_recording_holds_what_happened(page: LivePage, tmp_path: Path) -> None:
    page.tab("Save")
    page.press("Recording (.viser)")
    page.pause(1.0)
    page.tab("Map")
    before = page.look()
    page.slide("Threshold", 0.8)
    page.until(lambda seen: seen.agrees and seen.voxels < before.voxels, "fewer voxels")
    page.slide("Threshold", 0.5)
    page.until(lambda seen: seen.agrees and seen.voxels == before.voxels, "all voxels")
    page.tab("Save")
    page.download("Stop and save: Recording (.viser)").save_as(tmp_path / "map.viser")
    content = zstandard.ZstdDecompressor().decompress((tmp_path / "map.viser").read_bytes()[8:])
    (length,) = struct.unpack("<Q", content[:8])
    recording = msgspec.msgpack.decode(content[8 : 8 + length])
    times = [
        time for time, message in recording["messages"] if message["type"] == "PointCloudMessage" and time > 0
    ]
    assert len(times) >= 2
    assert 1.0 <= min(times) <= max(times) <= recording["durationSeconds"]


def test_reset_begins_anew_and_ends_the_same(page: LivePage) -> None:
    page.tab("Map")
    page.select("Draw as", "voxels")  # a surface has no voxels to count
    before = at_rest(page)
    page.select("Speed", "0.25x")  # or a machine that draws slowly sees only the end
    page.press("Reset")
    page.press("Keep the map")
    page.pause(1.0)
    assert page.look().keyframes == before.keyframes
    page.press("Reset")
    page.press("Delete the map and start again")
    page.until(lambda seen: len(seen.keyframes) < 3 and seen.voxels < before.voxels, "a new beginning")
    page.select("Speed", "2x")
    after = until_same(page, before, "the same map")
    assert len(after.keyframes) == 5


def test_a_frozen_keyframe_stays_in_the_map(page: LivePage, tmp_path: Path) -> None:
    before = page.until_settled()
    m = page.saved_map(tmp_path)
    page.tab("Keyframes")
    page.press("Freeze")
    page.press("Freeze it")
    page.until(lambda seen: "(frozen)" in page.input("Keyframe").input_value(), "a frozen keyframe")
    page.until(lambda seen: "frozen: it cannot be changed" in page.text(), "the reason")
    for button in ("On/off", "Freeze", "Move", "Put back"):
        assert page.page.get_by_role("button", name=button, exact=True).count() == 0
    assert page.input("Position (m)").is_disabled()
    m.infer()
    m.freeze_keyframe(min(m.keyframes))
    until_count(page, settled_count(m), "with one frozen")
    assert page.look().voxels > 0.9 * before.voxels
    for name in ("On/off", "Freeze", "Move", "Put back"):
        assert not page.page.get_by_role("button", name=name, exact=True).is_visible()
    assert page.input("Position (m)").is_disabled()
    assert "it cannot be changed" in page.text()
