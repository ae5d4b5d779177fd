"""Scans in motion: which pose each pixel has, whatever order a driver writes rows and times in, and the scans
of a survey in a LAS file."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from console import taichi_mrf
from datasets_recordings import write_rows, write_stamped
from moving_lidar import NOISE, level_pose, lidar, motion
from numpy.typing import NDArray
from point_clouds import LasFile, las_head, write_ply
from refusals import refused

from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.lidar.scans import Motion, Scan
from taichi_mrf.datasets.synthetic.analytic_render import ray_depths
from taichi_mrf.datasets.synthetic.room_furniture import room_scene
from taichi_mrf.datasets.timed_poses import interpolate
from taichi_mrf.errors import DatasetError
from taichi_mrf.geometry.poses import Pose, look_at
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.ray_table import RayTable
from taichi_mrf.sensor.simulate import simulate_model

ROWS, COLUMNS, TURN_S, STAMP = 4, 48, 0.1, 7.0
STILL = lidar(ROWS, COLUMNS)
RANGES = np.random.default_rng(0).uniform(2.0, 6.0, STILL.shape).astype(np.float32)
SHIFTS = np.array([0, 5, -3, 2])
"""Columns by which the rows are shifted, so that a column is an azimuth."""


def at(stamp: float) -> Pose:
    """It drives along a line at 10 m/s."""
    T = np.eye(4)
    T[1, 3] = 10.0 * stamp
    return T


MOTION = Motion(STAMP, at(STAMP), at)


def shifted_times() -> NDArray[np.float64]:
    """Seconds (H, W) after the stamp: each row goes through the turn, and begins anew where it is shifted."""
    measured = (np.arange(COLUMNS)[None, :] - SHIFTS[:, None]) % COLUMNS
    return TURN_S * measured / COLUMNS


def points_by_time(seconds: NDArray, kept: NDArray) -> NDArray[np.float64]:
    """Points (N, 3) where the driving sensor has measured them."""
    points = STILL.rays() * RANGES[..., None]
    points[..., 1] += 10.0 * seconds
    return points[kept]


def ordered(points: NDArray) -> NDArray:
    return points[np.lexsort(points.T)]


def check(scan: Scan | None, seconds: NDArray, kept: NDArray, atol: float = 2e-3) -> Scan:
    """Points are where they were measured, up to the steps in which poses are taken."""
    found = points_at(scan.camera, scan.range_m)[scan.range_m > 0]
    expected = points_by_time(seconds, kept)
    assert len(found) == len(expected)
    apart = np.linalg.norm(found[:, None] - expected[None], axis=-1).min(axis=1)
    assert apart.max() < atol
    return scan


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("lost_share", [0.0, 0.3])
def test_rows_run_on_in_time(lost_share: float, backwards: bool) -> None:
    seconds = -shifted_times() if backwards else shifted_times()
    lost = np.random.default_rng(1).random(STILL.shape) < lost_share
    ranges = np.where(lost, np.float32(0.0), RANGES)
    told = np.where(lost, 99.0, seconds)  # what drivers write for points that they do not have
    scan = check(MOTION.of_image(Scan(STILL, ranges, lost), told, ~lost), seconds, ~lost)
    assert scan.camera.has_pattern
    assert scan.camera.shape[1] <= COLUMNS + SHIFTS.max() - SHIFTS.min()
    starts = np.broadcast_to(scan.camera.origins_m, (*scan.camera.shape, 3))  # type: ignore[arg-type]
    step_m = 10.0 * TURN_S / COLUMNS
    assert np.abs(np.diff(starts, axis=1)).max() < 2.1 * step_m, "no seam inside of a row"
    assert scan.no_return.sum() == lost.sum()
    assert not (scan.no_return & (scan.range_m > 0)).any()
    across = np.arccos(np.clip((scan.camera.rays()[:, 1:] * scan.camera.rays()[:, :-1]).sum(-1), -1, 1))
    assert across.max() < 1.1 * 2 * np.pi / COLUMNS


def test_columns_without_a_stamp_take_their_place() -> None:
    """Packets that were lost: their stamps are 0, and nothing is known of their pixels."""
    known = np.ones(STILL.shape, bool)
    known[:, 10:20] = False
    seconds = np.tile(TURN_S * np.arange(COLUMNS) / COLUMNS, (ROWS, 1))
    scan = Scan(STILL, np.where(known, RANGES, np.float32(0.0)), np.zeros(STILL.shape, bool))
    found = check(MOTION.of_image(scan, np.where(known, seconds, -1e9), known), seconds, known)
    assert found.camera.shape == STILL.shape
    np.testing.assert_allclose(found.camera.rays(), STILL.rays(), atol=1e-6)
    starts = points_at(found.camera, np.zeros(STILL.shape))
    np.testing.assert_allclose(starts[..., 1], 10.0 * seconds, atol=2e-3)


def test_times_of_packets_are_enough() -> None:
    seconds = TURN_S * (np.arange(COLUMNS) // 4 * 4) / COLUMNS
    seconds = np.tile(seconds, (ROWS, 1))
    every = np.ones(STILL.shape, bool)
    found = check(MOTION.of_image(Scan(STILL, RANGES, None), seconds, every), seconds, every)
    assert found.camera.shape == STILL.shape
    assert found.no_return is None


def test_columns_in_no_order_of_time_become_free_rays() -> None:
    seconds = np.random.default_rng(2).uniform(0.0, TURN_S, STILL.shape)
    seconds[:, ::2] += 3 * TURN_S
    every = np.ones(STILL.shape, bool)
    found = check(MOTION.of_image(Scan(STILL, RANGES, None), seconds, every), seconds, every, 2e-2)
    assert not found.camera.has_pattern
    seconds[:, 1] = 1e9  # a clock that jumps
    assert not MOTION.of_image(Scan(STILL, RANGES, None), seconds, every).camera.has_pattern  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "motion",
    [Motion(STAMP, np.eye(4), lambda stamp: np.eye(4)), Motion(STAMP, np.eye(4), lambda stamp: None)],
)
def test_a_sensor_that_stands_still_or_whose_poses_are_unknown_keeps_its_camera(motion: Motion) -> None:
    every, seconds = np.ones(STILL.shape, bool), shifted_times()
    assert motion.of_image(Scan(STILL, RANGES, None), seconds, every) is None
    assert motion.poses(seconds) is None
    assert MOTION.of_image(Scan(STILL, RANGES, None), 0 * seconds, every) is None
    assert MOTION.of_image(Scan(STILL, RANGES, None), seconds, ~every) is None


def test_free_rays_have_poses_of_their_own() -> None:
    seconds = np.linspace(-0.02, 0.07, 200)
    poses = MOTION.poses(seconds)
    np.testing.assert_allclose(poses[:, 1, 3], 10.0 * seconds, atol=1e-3)
    table, range_m = RayTable.of_points(np.ones((200, 3)), poses)
    np.testing.assert_allclose(
        ordered(points_at(table, range_m)[0]), ordered(poses[:, :3, 3] + 1.0), atol=1e-5
    )


COUNT, START = 60, 1000.0
ENDS = START - 0.05, START + 0.4
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
        ends = np.array([FIRST, LAST])
        ends[:, :3, 3] += offset_m
        write_stamped(tmp_path / poses, ENDS, ends)
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
        (np.linspace(0, 1e300, COUNT), "", "which are not times"),
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
    write_stamped(tmp_path / "walk.txt", ENDS, [FIRST, LAST])
    dataset = open_dataset(tmp_path / f"walk{suffix}", max_time_gap=1.0)
    first = POINTS[TIMES < START + 0.1]
    np.testing.assert_allclose(world_points(dataset, 0), first[np.lexsort(first.T)], atol=1e-3)


@pytest.mark.usefixtures("one_backend")
@pytest.mark.parametrize("moves", [True, False])
def test_scans_that_nobody_has_deskewed_are_named_where_noise_is_blamed(tmp_path: Path, moves: bool) -> None:
    """A lidar goes through the room by 0.1 m and 0.4 rad from scan to scan, also during them or from stop to
    stop; a driver without motion takes each column's ray for one from the middle of the scan."""
    still, count = lidar(24, 240), 20
    step = motion(2, 0.1, 0.4)
    T, poses = level_pose(0.2), []
    for scan in range(count):
        measures = RayTable.moving(still, motion(still.width, 0.1, 0.4)) if moves else still
        range_m = simulate_model(ray_depths(room_scene(), measures, T), measures, NOISE, seed=scan)
        write_ply(tmp_path / f"{scan:03d}.ply", (still.rays() * range_m[..., None])[range_m > 0])
        poses.append(T)
        T = T @ np.linalg.inv(step[0]) @ step[1]
    write_rows(tmp_path / "poses.txt", poses)
    dataset = open_dataset(tmp_path)
    assert dataset.stated.swept_m == pytest.approx(4.1, abs=0.05)
    done = taichi_mrf("map", tmp_path, "--out", tmp_path / "out", "--voxel-size", "0.05", "--noise", "given")
    assert done.returncode in (0, 4), done.stderr
    assert ("Or scans were not deskewed: the lidar moves by 4.1 m" in done.stdout) == moves
