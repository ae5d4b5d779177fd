"""Scans in motion: which pose each pixel has, whatever order a driver writes rows and times in."""

import numpy as np
import pytest
from moving_lidar import lidar
from numpy.typing import NDArray

from taichi_mrf.datasets.lidar.scans import Motion, Scan
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.origins import points_at
from taichi_mrf.sensor.ray_table import RayTable

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
