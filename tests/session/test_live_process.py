"""The live program with a real Chromium at its page: a broken frame, and a slider while it infers."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import Browser, live_page, missing
from slider_latency import slider_answers

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


def recording_with_a_broken_frame(folder: Path) -> None:
    """Four frames in the 7-Scenes layout, of a wall 1.5 m away; the second holds no image."""
    for index in range(4):
        stem, T_world_camera = folder / f"frame-{index:06d}", np.eye(4)
        T_world_camera[0, 3] = 0.5 * index
        cv2.imwrite(f"{stem}.depth.png", np.full((480, 640), 1500, np.uint16))
        np.savetxt(f"{stem}.pose.txt", T_world_camera)
    (folder / "frame-000001.depth.png").write_bytes(b"no image")


def test_a_broken_frame_is_told_of_and_mapping_goes_on(browser: Browser, tmp_path: Path) -> None:
    recording_with_a_broken_frame(tmp_path)
    with live_page(browser, tmp_path, "--voxel-size", "0.1", "--runtime.arch", "cpu") as page:
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


def test_a_slider_is_answered_while_the_map_is_inferred(browser: Browser) -> None:
    options = ("--voxel-size", "0.02", "--runtime.arch", "cpu", "--speed", "0.01")
    with live_page(browser, "synthetic:room?frames=8", *options, width=800, height=600) as page:
        page.select("Speed", "as fast as possible")
        page.until(lambda seen: seen.activity.startswith("sweeping") and seen.agrees, "inference")
        answers = slider_answers(page, 4)
        page.screenshot("inferring")
        print([f"{each.seconds:.3f} s" for each in answers])
        assert any(each.while_inferring for each in answers)
        assert page.problems == []
