"""The search over all headings and many places: its counts, which way is up, and places alike."""

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_mrf.alignment.se3 import moved
from taichi_mrf.alignment.seen_through import Sightlines
from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.alignment.wide_search import CoarseGrid, peaks, scores, upright
from taichi_mrf.config.schema import PoseConfig
from taichi_mrf.datasets.synthetic.analytic_render import ray_depths
from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid
from taichi_mrf.datasets.synthetic.room_furniture import room_scene
from taichi_mrf.errors import LostFrameError
from taichi_mrf.geometry.poses import Pose, tangent_norms
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.mapping.tracking import Tracker
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera, sees_around
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.sensor.spherical import SphericalCamera

pytestmark = pytest.mark.usefixtures("one_backend")

CELL_M = 0.5
LIDAR = SphericalCamera(np.radians(np.linspace(45.0, -45.0, 90)), np.radians(np.arange(0.0, 360.0, 1.0)))
SIGMA_M, REACH_M = 0.01, 25.0


def corridor() -> Scene:
    """3 m wide and 2.4 m high, along x, with its ends out of reach."""
    sides = [((0, y, 0), (90, 0.1, 1.5)) for y in (-1.6, 1.6)]
    levels = [((0, 0, z), (90, 1.7, 0.1)) for z in (-1.3, 1.3)]
    return Scene(tuple(Solid("box", center, half) for center, half in sides + levels), (0.0, 0.0, 1.0))


def scan(scene: Scene, T: Pose, name: str = "scan", seed: int = 0) -> Frame:
    range_m = ray_depths(scene, LIDAR, T)
    noise = np.random.default_rng(seed).normal(0, SIGMA_M, range_m.shape)
    seen = (range_m > 0) & (range_m < REACH_M)
    depth_m = np.where(seen, range_m + noise, 0).astype(np.float32)
    return Frame(depth_m, np.eye(4), LIDAR, 0.0, name)


def followed(scene: Scene, *poses: Pose) -> Pose:
    """Pose of the last scan, as seen from the first; the others become keyframes."""
    m = MRFMap(0.1, PolynomialNoise((SIGMA_M,)), max_depth=REACH_M)
    tracker = Tracker(m, PoseConfig())
    for number, T in enumerate(poses):
        frame, _ = tracker.follow(scan(scene, T, f"scan {number}", number))
        if number < len(poses) - 1:
            tracker.took(m.add_keyframe(frame.depth_m, frame.T_world_camera, LIDAR))
    return frame.T_world_camera


def place(x: float, y: float, yaw: float, tilt: float = 0.0) -> Pose:
    T = np.eye(4)
    T[:3, 3] = x, y, 0.1
    return moved(moved(T, (0, 0, 0, 0, 0, yaw)), (0, 0, 0, tilt, 0, 0))


def test_counts_follow_the_definition() -> None:
    random = np.random.default_rng(0)
    surface, points = random.uniform(-4, 4, (300, 3)), random.uniform(-3, 3, (2, 40, 3))
    normals = random.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cells = np.floor(points / CELL_M).astype(np.int64)
    sides = random.integers(0, 10, (2, 40))
    steps = np.array([[0, 0, 0], [2, -1, 0], [-2, 2, 0]])
    lowest = cells.min(axis=(0, 1)) - (2, 2, 0)
    shape = cells.max(axis=(0, 1)) + (2, 2, 0) + 1 - lowest
    found = scores(CoarseGrid.of(surface, normals, lowest, shape, CELL_M), cells, sides, steps)
    expected = np.zeros((2, 3), int)
    # Eight headings, up and down; a normal belongs to the nearest, and to those within 40 degrees.
    axes = [(np.cos(a), np.sin(a), 0) for a in np.radians(np.arange(0, 360, 45))] + [(0, 0, 1), (0, 0, -1)]
    alike = normals @ np.array(axes).T
    of_surface = (alike > np.cos(np.radians(40))) | (alike == alike.max(axis=1, keepdims=True))
    at = np.floor(surface / CELL_M).astype(int)
    inside = ((at >= lowest) & (at < lowest + shape)).all(axis=1)
    for heading, step, i in np.ndindex(2, 3, 40):
        away = np.abs(at - (cells[heading, i] + steps[step])).max(axis=1)
        matches = of_surface[:, sides[heading, i]] & inside
        expected[heading, step] += int((matches & (away == 0)).any()) + int((matches & (away <= 1)).any())
    np.testing.assert_array_equal(found, expected)
    assert found.min() > 0


def test_peaks_are_apart() -> None:
    headings, places = (
        np.radians(np.arange(0, 360, 10.0)),
        np.stack([np.arange(-4, 4.5, 0.5), np.zeros(17)], 1),
    )
    counts = np.zeros((36, 17), np.int32)
    counts[0, 8], counts[35, 8], counts[1, 9], counts[18, 8], counts[0, 12] = 90, 89, 88, 70, 60
    assert peaks(counts, headings, places, 1.0, 8) == [(0, 8), (18, 8), (0, 12)]


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_floors_and_ceilings_tell_which_way_is_up(tilt: float) -> None:
    random = np.random.default_rng(1)
    T = moved(np.eye(4), (0, 0, 0, tilt, 0, 0.3))
    flat = np.concatenate([np.tile([0, 0, 1.0], (60, 1)), np.tile([0, 0, -1.0], (40, 1))])
    walls = np.stack([np.cos(np.arange(200)), np.sin(np.arange(200)), np.zeros(200)], 1)
    normals = np.concatenate([flat, walls]) @ T[:3, :3] + random.normal(0, 0.03, (300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    up = upright(normals, np.array([0, 0, 1.0]))
    assert np.degrees(np.arccos(up @ T[2, :3])) < 1.0
    np.testing.assert_array_equal(upright(walls, np.array([0, 0, 2.0])), [0, 0, 1.0])


def test_who_sees_around() -> None:
    half = SphericalCamera([0.0], np.radians(np.arange(-90.0, 90.0)))
    most = SphericalCamera([0.3, -0.3], np.radians(np.arange(-135.0, 135.0)))
    assert [sees_around(camera) for camera in (LIDAR, most, half)] == [True, True, False]
    assert not sees_around(PinholeCamera(16, 12, 6.0, 6.0, 7.5, 5.5))


@pytest.mark.parametrize(("yaw", "tilt"), [(np.pi / 2, 0.0), (2.5, 0.3)])
def test_a_scan_after_a_jump_is_found(yaw: float, tilt: float) -> None:
    first, second = place(-0.9, -0.4, 0.0), place(0.5, -0.9, yaw, tilt)
    found = followed(room_scene(), first, second)
    turned, shifted = tangent_norms(np.linalg.inv(first) @ second, found)
    assert shifted < 0.03
    assert turned < 0.01


def test_a_corridor_that_is_the_same_everywhere_is_no_place() -> None:
    with pytest.raises(
        LostFrameError, match=r"scan 1: tracking lost: .* (two places equally well|six directions)"
    ):
        followed(corridor(), place(0, 0.3, 0), place(1.5, -0.4, 1.5))


def test_a_scan_that_looks_through_the_map_gives_a_wrong_pose_away() -> None:
    frame = scan(corridor(), place(0, 0, 0))
    sight = Sightlines.of(DepthImage.upload(frame.depth_m, LIDAR, PolynomialNoise((SIGMA_M,))))

    def planes(points: NDArray[np.float64]) -> Planes:
        return Planes(np.zeros(points.shape, np.int32), np.ones(len(points)), points, points)

    # What would stand across the corridor, where rays pass to its sides and floor; and a side of it.
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-0.8, 0.85, 0.1), np.arange(-0.5, 0.55, 0.1)))
    across = planes(np.stack([np.full(y.shape, 2.0), y, z], axis=1))
    assert sight.seen_through(across, place(0, 0, 0)) == 1.0
    sides = np.stack([np.linspace(-3, 3, 61), np.full(61, 1.5), np.zeros(61)], axis=1)
    side = planes(sides)
    assert sight.seen_through(side, place(0, 0, 0)) == 0
    assert sight.seen_through(side, place(0, 0.8, 0)) == 1.0
