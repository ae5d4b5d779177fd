"""A LAS file of a survey with the path of the lidar: its scans, their poses, and what cannot be used."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from datasets_recordings import stamped_line
from point_clouds import LasFile, las_head
from refusals import refused

from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.timed_poses import interpolate
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import look_at
from taichi_mrf.sensor.origins import points_at

COUNT, START = 60, 1000.0
FIRST, LAST = look_at([0.0, 0, 1], [5.0, 0, 1]), look_at([2.0, 1, 1], [5.0, 3, 2])
TIMES = START + np.linspace(0.0, 0.29, COUNT)
"""Three scans of a tenth of a second, 20 points or so in each, in the order of time."""

POINTS = np.random.default_rng(3).uniform(-6, 6, (COUNT, 3))
SHUFFLED = np.random.default_rng(4).permutation(COUNT)


@pytest.fixture
def survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Writes a survey and its poses; returns its path."""

    def write(
        points_m: np.ndarray = POINTS[SHUFFLED],
        times: np.ndarray | None = TIMES[SHUFFLED],
        offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        poses: str = "walk.txt",
    ) -> Path:
        file = LasFile(points_m + offset_m, times)
        monkeypatch.setitem(sys.modules, "laspy", SimpleNamespace(open=lambda stream, closefd: file))
        (tmp_path / "walk.las").write_bytes(las_head(len(points_m)))
        lines = []
        for stamp, pose in ((START - 0.05, FIRST), (START + 0.4, LAST)):
            T = pose.copy()
            T[:3, 3] += offset_m
            lines.append(stamped_line(stamp, T))
        (tmp_path / poses).write_text("\n".join(lines))
        return tmp_path / "walk.las"

    return write


def world_points(dataset: Dataset, index: int) -> np.ndarray:
    """The points of a scan in the world, sorted."""
    frame = dataset.read(index)
    points, T = frame.points_m.reshape(-1, 3), frame.T_world_camera
    world = points @ T[:3, :3].T + T[:3, 3]
    return world[np.lexsort(world.T)]


@pytest.mark.parametrize("offset_m", [(0.0, 0.0, 0.0), (500_000.25, 5_400_000.5, 300.0)])
def test_points_become_scans_from_where_they_were_measured(
    survey: Any, offset_m: tuple[float, float, float]
) -> None:
    dataset = open_dataset(survey(offset_m=offset_m), max_time_gap=1.0)
    assert (dataset.frame_names, dataset.dropped) == (["000000", "000001", "000002"], 0)
    origin = dataset.origin_m
    np.testing.assert_array_equal(origin, np.rint(np.array(offset_m) / 1000) * 1000)
    for i in range(3):
        members = np.flatnonzero(((TIMES - START) / 0.1).astype(int) == i)
        stamp = (TIMES[members[0]] + TIMES[members[-1]]) / 2
        expected = interpolate(FIRST, LAST, (stamp - START + 0.05) / 0.45)
        expected[:3, 3] += offset_m - origin
        frame = dataset.read(i)
        assert frame.stamp == pytest.approx(stamp)
        np.testing.assert_allclose(frame.T_world_camera, expected, atol=1e-6)
        world = POINTS[members] + offset_m - origin
        np.testing.assert_allclose(world_points(dataset, i), world[np.lexsort(world.T)], atol=1e-5)
        starts = points_at(frame.camera, 0 * frame.depth_m)[0] @ expected[:3, :3].T + expected[:3, 3]
        share = (TIMES[members] - START + 0.05) / 0.45
        path = (1 - share)[:, None] * FIRST[:3, 3] + share[:, None] * LAST[:3, 3] + offset_m - origin
        np.testing.assert_allclose(starts[np.argsort(starts[:, 0])], path, atol=1e-5)
    moved = [note for note in dataset.notes if "origin of the world" in note]
    assert bool(moved) == bool(offset_m[0])


def test_the_length_of_a_scan_and_the_poses_can_be_named(survey: Any) -> None:
    path = survey(poses="path.tum")
    dataset = open_dataset(f"{path}?poses={path.parent / 'path.tum'}&seconds=1", max_time_gap=1.0)
    assert len(dataset) == 1
    assert dataset.read(0).depth_m.size == COUNT
    refused(path, "walk.las: contains lidar point clouds without poses", "?poses=FILE")


def test_poses_that_are_far_apart_are_enough_near_the_middle_between_them(survey: Any) -> None:
    """Those of points farther from them than the gap are the scan's."""
    path = survey(POINTS, np.where(np.arange(COUNT) < 30, START + 0.1749, START + 0.1751))
    frame = open_dataset(path, max_time_gap=0.226).read(0)
    assert frame.camera == open_dataset(path, max_time_gap=0.3).read(0).camera
    world = world_points(open_dataset(path, max_time_gap=0.226), 0)
    np.testing.assert_allclose(world, POINTS[np.lexsort(POINTS.T)], atol=1e-5)


def test_scans_without_a_pose_are_dropped(survey: Any) -> None:
    times = TIMES.copy()
    times[-3:] += 5
    dataset = open_dataset(survey(POINTS, times), max_time_gap=1.0)
    assert (len(dataset), dataset.dropped) == (3, 1)


@pytest.mark.parametrize(
    ("times", "query", "problem"),
    [
        (None, "", r"its points have no gps_time \(point format 0\)"),
        (
            TIMES + 100,
            "",
            r"none of 3 scans \(1100\.049 to 1100\.246 s\) has poses .*walk\.txt, 999\.950 to",
        ),
        (np.full(COUNT, np.nan), "", "goes from nan to nan s"),
        (np.linspace(0, 1e300, COUNT), "", "which is no time"),
        (TIMES, "?seconds=0", "seconds must be positive, not 0"),
        (TIMES, "?second=1", "unknown parameter 'second'"),
    ],
)
def test_what_cannot_be_used_is_named(survey: Any, times: Any, query: str, problem: str) -> None:
    path = survey(POINTS, times)
    with pytest.raises(DatasetError, match=problem) as caught:
        open_dataset(f"{path}{query}")
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_survey_as_laspy_writes_it(tmp_path: Path, suffix: str) -> None:
    laspy = pytest.importorskip("laspy", reason="LAS files need laspy")
    file = laspy.create(point_format=1, file_version="1.2")
    file.header.scales = [0.001] * 3
    file.x, file.y, file.z = POINTS[SHUFFLED].T
    file.gps_time = TIMES[SHUFFLED]
    file.write(tmp_path / f"walk{suffix}")
    lines = [stamped_line(START - 0.05, FIRST), stamped_line(START + 0.4, LAST)]
    (tmp_path / "walk.txt").write_text("\n".join(lines))
    dataset = open_dataset(tmp_path / f"walk{suffix}", max_time_gap=1.0)
    first = POINTS[TIMES < START + 0.1]
    np.testing.assert_allclose(world_points(dataset, 0), first[np.lexsort(first.T)], atol=1e-3)
