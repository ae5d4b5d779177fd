"""The live program as a process with a real Chromium at its page: its ends, restarts, and broken frames."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from browser import LivePage, chromium, missing
from live_program import LiveProgram, wait_for
from slider_latency import slider_answers

from taichi_mrf import MRFMap
from taichi_mrf.system import runtime

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOM = "synthetic:room?frames=6&width=96&height=72"
COARSE = ("--voxel-size", "0.08", "--runtime.arch", "cpu")
FILES = {"map.npz", "voxels.ply", "config.yaml", "report.json"}
PICTURES = {"surface.png", "top_view.png", "depth.png"}
"""What a run that ends by itself leaves in addition."""

NO_SERVER = ("WebSocket connection to", "Failed to open WebSocket", "Failed to load resource: net::ERR")
"""Beginnings of what a browser reports while there is no server, as it must."""

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map that a run has left, which ended by itself."""
    out = tmp_path_factory.mktemp("saved")
    with LiveProgram(ROOM, *COARSE, "--out", out, "--exit-when-done") as program:
        assert program.wait() == 0
        program.wait_until_nothing_is_left()
    assert {path.name for path in out.iterdir()} == FILES | PICTURES
    return out / "map.npz"


@pytest.fixture(scope="module")
def voxels(saved: Path) -> int:
    """How many voxels of the saved map are occupied."""
    runtime.init("cpu")
    return len(MRFMap.load(saved).decided.voxels(0.5)[0])


@pytest.fixture(scope="module")
def old_program(saved: Path) -> Iterator[LiveProgram]:
    """The saved map, shown for the whole time of these tests, because a viewer must have lived for a while to
    be started again. Its port is none of those that the system gives away, or another program could be given
    it while nobody listens."""
    with LiveProgram(saved, port=20000 + os.getpid() % 10000) as program:
        program.started = time.monotonic()
        yield program


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_a_signal_ends_it_and_keeps_what_is_mapped(
    number: signal.Signals, old_program: LiveProgram, browser: "Browser", tmp_path: Path
) -> None:
    options = (*COARSE, "--speed", "0.01", "--out", tmp_path)  # so slow that it is never over
    with LiveProgram(ROOM, *options, port=old_program.port) as program:
        assert program.port != old_program.port
        assert f"Port {old_program.port} is busy, so the page took {program.port}." in program.said
        with LivePage(browser, program.address) as page:
            page.until(lambda seen: seen.agrees and seen.voxels, "a voxel")
            status, seconds = program.end(number)
        print(f"{number.name} took {seconds:.2f} s")
        assert status == 128 + number
        program.wait_until_nothing_is_left()
    assert {path.name for path in tmp_path.iterdir()} == FILES
    runtime.init("cpu")
    m = MRFMap.load(tmp_path / "map.npz")
    assert 1 <= len(m.keyframes) < 5
    assert len(m.voxels(0.5)[0]) > 0


def recording_with_a_broken_frame(folder: Path) -> None:
    """Four frames in the 7-Scenes layout, of a wall 1.5 m away; the second holds no image."""
    for index in range(4):
        stem, T_world_camera = folder / f"frame-{index:06d}", np.eye(4)
        T_world_camera[0, 3] = 0.5 * index
        cv2.imwrite(f"{stem}.depth.png", np.full((480, 640), 1500, np.uint16))
        np.savetxt(f"{stem}.pose.txt", T_world_camera)
    (folder / "frame-000001.depth.png").write_bytes(b"no image")


def test_a_broken_frame_is_told_of_and_mapping_goes_on(browser: "Browser", tmp_path: Path) -> None:
    recording_with_a_broken_frame(tmp_path)
    with (
        LiveProgram(tmp_path, "--voxel-size", "0.1", "--runtime.arch", "cpu") as program,
        LivePage(browser, program.address) as page,
    ):
        assert len(page.until_settled().keyframes) == 3
        page.tab("About")
        page.until(lambda seen: "frame-000001" in page.text(), "the list of problems")
        page.screenshot("broken_frame_listed")
        page.tab("Map")
        page.press("Reset")
        page.press("Delete the map and start again")
        notice = page.page.locator(".mantine-Notification-root", has_text="frame-000001")
        notice.first.wait_for(state="visible")
        page.screenshot("broken_frame_notice")
        page.until(lambda seen: seen.settled and len(seen.keyframes) == 3, "the map again")
        assert page.problems == []


def test_a_slider_is_answered_while_the_map_is_inferred(browser: "Browser") -> None:
    options = ("--voxel-size", "0.02", "--runtime.arch", "cpu", "--speed", "0.01")
    with (
        LiveProgram("synthetic:room?frames=8", *options) as program,
        LivePage(browser, program.address, width=800, height=600) as page,
    ):
        page.select("Speed", "as fast as possible")
        page.until(lambda seen: seen.activity.startswith("sweeping") and seen.agrees, "inference")
        answers = slider_answers(page, 4)
        page.screenshot("inferring")
        print([f"{each.seconds:.3f} s" for each in answers])
        assert any(each.while_inferring for each in answers)
        assert page.problems == []


def test_a_viewer_that_dies_is_started_again(
    old_program: LiveProgram, browser: "Browser", voxels: int
) -> None:
    with LivePage(browser, old_program.address) as page:
        assert page.until_settled().voxels == voxels
        slider = slider_id(page)
        wait_for(
            lambda: time.monotonic() > old_program.started + 31, "a viewer that is old enough", page.pause
        )
        viewers = [pid for pid, command in old_program.group().items() if "spawn_main" in command]
        assert len(viewers) == 1
        os.kill(viewers[0], signal.SIGKILL)
        wait_for(lambda: viewers[0] not in old_program.group(), "its end")
        until_reconnected(page, slider, voxels)
        assert all(problem.startswith(NO_SERVER) for problem in page.problems), page.problems


def test_a_server_that_is_killed_and_restarted_is_found_again(
    old_program: LiveProgram, saved: Path, browser: "Browser", voxels: int
) -> None:
    with LivePage(browser, old_program.address) as page:
        assert page.until_settled().voxels == voxels
        slider = slider_id(page)
        os.kill(old_program.pid, signal.SIGKILL)
        assert old_program.wait() == -signal.SIGKILL
        old_program.wait_until_nothing_is_left()
        page.pause(1.0)
        page.screenshot("server_killed")
        with LiveProgram(saved, port=old_program.port) as program:
            assert program.port == old_program.port
            until_reconnected(page, slider, voxels)
            page.screenshot("server_restarted")
        assert all(problem.startswith(NO_SERVER) for problem in page.problems), page.problems


def slider_id(page: LivePage) -> str | None:
    """Of the slider of the threshold; another viewer gives it another one."""
    return page.input("Threshold").get_attribute("id")


def until_reconnected(page: LivePage, slider_before: str | None, voxels: int) -> None:
    """Wait until the page shows the whole map of another viewer, and see that its slider is answered."""
    page.until(lambda seen: slider_id(page) != slider_before, "another viewer")
    assert page.until_settled().voxels == voxels
    page.nudge("Threshold", "ArrowRight")
    page.until(lambda seen: seen.agrees and seen.voxels < voxels, "fewer voxels")
    page.nudge("Threshold", "ArrowLeft")
    page.until(lambda seen: seen.agrees and seen.voxels == voxels, "all voxels")
