"""The live page in Firefox: its first view, and the points of a drawing that is chosen there."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from firefox import Firefox, missing
from live_program import LiveProgram, wait_for
from numpy.typing import NDArray

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))

ROOM = "synthetic:room?frames=6&width=96&height=72"


def in_color(firefox: Firefox, name: str) -> NDArray[np.uint8]:
    """A picture of the page once the map is in it: the ground is grey and the map is not."""
    pictures: list[NDArray[np.uint8]] = []

    def colored() -> bool:
        pictures[:] = [cv2.imread(str(firefox.screenshot(name)))]
        scene = pictures[0][:, : pictures[0].shape[1] * 2 // 3].astype(int)
        return bool((scene.max(axis=2) - scene.min(axis=2) > 60).mean() > 0.05)

    wait_for(colored, f"colours in {name}.png")
    return pictures[0]


def test_firefox_shows_the_first_view_and_points(tmp_path: Path) -> None:
    profile = tmp_path / "profile"
    profile.mkdir()
    flags = ("--voxel-size", "0.08", "--runtime.arch", "cpu", "--out", tmp_path / "out")
    with LiveProgram(ROOM, *flags) as program, Firefox(program.address, profile) as firefox:

        def until(kind: str) -> None:
            """Wait for a map at rest, of whose kind the scene has as many as the page says."""

            def met() -> bool:
                seen = firefox.look()
                said = str(seen.get("counts", "")).startswith(f"{seen.get(kind, 0):,} {kind} ")
                return said and seen[kind] > 1000 and "up to date" in seen["activity"]

            wait_for(met, lambda: f"{kind} in Firefox; last seen: {firefox.look()}")

        until("triangles")
        first = in_color(firefox, "firefox_first_view")
        firefox.select("Draw as", "voxels")
        firefox.select("Color by", "marginal probability")
        until("voxels")
        voxels = in_color(firefox, "firefox_voxels")
        assert firefox.problems == []
    assert (cv2.absdiff(first, voxels).max(axis=2) > 60).mean() > 0.05
