"""Another recording of a folder, chosen on the page in a real Chromium."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import chromium, live_page, missing
from inputs_frames import write_frames

from taichi_mrf.datasets import open_dataset
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system import runtime

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))

HERE, FAR = np.eye(4), np.eye(4)
FAR_M = FAR[0, 3] = 40.0
"""Distance between the two recordings' rooms."""

Z_TO_MINUS_Y = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


def write_recording(folder: Path, count: int, T_other_world: Pose) -> None:
    """Some frames of the built-in room, in another world."""
    runtime.init("cpu")
    dataset = open_dataset(f"synthetic:room?frames={count}&width=96&height=72")
    frames = [replace(frame, T_world_camera=T_other_world @ frame.T_world_camera) for frame in dataset]
    write_frames(folder / "frames.npz", frames)


def test_another_recording_is_mapped_in_the_same_page(tmp_path: Path) -> None:
    write_recording(tmp_path / "first", 4, HERE)
    write_recording(tmp_path / "second", 3, FAR)
    flags = ("--voxel-size", "0.08", "--runtime.arch", "cpu", "--evaluation.hold-out", "0")
    with chromium() as browser, live_page(browser, tmp_path, *flags) as page:
        before = page.until_settled()
        assert len(before.keyframes) == 4
        assert page.input("Recording").input_value() == "first"
        assert page.position()[0] < FAR_M / 2
        page.screenshot("recordings_first")
        page.select("Recording", "second")
        page.until(lambda seen: "Discard changes?" in page.text(), "the question")
        page.screenshot("recordings_question")
        page.press("Keep the map")
        page.until(lambda seen: "Discard changes?" not in page.text(), "no question")
        assert page.input("Recording").input_value() == "first"
        assert page.look().keyframes == before.keyframes
        page.select("Recording", "second")
        page.press("Discard them")
        page.until(lambda seen: len(seen.keyframes) == 3 and seen.settled, "the other recording")
        assert page.input("Recording").input_value() == "second"
        page.until(lambda seen: page.position()[0] > FAR_M / 2, "a view of the other recording")
        page.screenshot("recordings_second")
        page.tab("About")
        seen = page.until(lambda seen: "source" in seen.table, "the figures")
        assert seen.table["source"] == str(tmp_path / "second")
        assert page.problems == []


def test_a_level_cut_keeps_what_lies_below_it_in_a_world_whose_y_points_down(tmp_path: Path) -> None:
    size_m, height_m = 0.08, -0.3
    write_recording(tmp_path / "down", 3, Z_TO_MINUS_Y)
    flags = ("--voxel-size", f"{size_m}", "--runtime.arch", "cpu", "--evaluation.hold-out", "0")
    with chromium() as browser, live_page(browser, tmp_path / "down", *flags) as page:
        page.until_settled()
        rows = np.floor(page.saved_map(tmp_path).decided.voxels(0.5)[0][:, 1] / size_m)
        page.tab("Map")
        page.until(lambda seen: seen.settled and seen.voxels == len(rows), "what is occupied")
        page.tick("Free space")
        page.until(lambda seen: page.input("Cut axis").input_value() == "y", "a level cut")
        page.slide("Cut at (m)", height_m)
        below = int((rows >= np.floor(-height_m / size_m)).sum())
        assert 0 < below < len(rows)
        page.until(lambda seen: seen.agrees and seen.voxels == below, "the voxels below the cut")
        page.screenshot("level_cut_of_y_down")
        assert page.problems == []
