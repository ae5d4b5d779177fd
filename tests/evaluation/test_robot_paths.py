"""Paths of a robot that trusts a map, against maps that are right, blind, or cautious."""

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid
from taichi_mrf.evaluation.robot_paths import LENGTH_M, PLAY_M, RADIUS_M, Drives, Paths
from taichi_mrf.queries.points import FREE, OCCUPIED, UNKNOWN

BALL = Scene((Solid("sphere", (0.5, 0.0, 0.0), (0.1, 0.1, 0.1)),), (0.0, 0.0, 0.0))
AHEAD = np.array([[1.0, 0.0, 0.0]])


class _Map:
    """A map whose voxels are occupied where the scene says so, else ``elsewhere``."""

    def __init__(self, scene: Scene, elsewhere: int = FREE, voxel_size: float = 0.02) -> None:
        self.scene, self.elsewhere, self.voxel_size = scene, elsewhere, voxel_size

    def state(self, points: ArrayLike) -> NDArray[np.int8]:
        return np.where(self.scene.signed_distance(points) <= 0, OCCUPIED, self.elsewhere).astype(np.int8)


def path(y: float = 0.0, z: float = 0.0) -> Paths:
    return Paths(np.array([[0.0, y, z]]), AHEAD)


def test_random_paths_are_level_and_stay_in_the_box() -> None:
    lower, upper = np.array([-1.0, -2.0, 0.5]), np.array([1.5, 0.0, 0.8])
    paths = Paths.random(200, lower, upper, (1, 2))
    ends = paths.starts + LENGTH_M * paths.directions
    assert len(paths) == 200
    for points in (paths.starts, ends):
        assert ((points >= lower) & (points <= upper)).all()
    np.testing.assert_allclose(np.linalg.norm(paths.directions, axis=1), 1)
    assert not paths.directions[:, 2].any()
    again, other = Paths.random(200, lower, upper, (1, 2)), Paths.random(200, lower, upper, (1, 3))
    np.testing.assert_array_equal(paths.starts, again.starts)
    assert (paths.starts != other.starts).any()


@pytest.mark.parametrize(("y", "z"), [(0.0, 0.0), (0.25, 0.0), (0.0, -0.4), (0.3, 0.3)])
def test_the_clearance_is_that_of_the_middle_line(y: float, z: float) -> None:
    assert path(y, z).clearance(BALL)[0] == pytest.approx(np.hypot(y, z) - 0.1, abs=1e-9)


@pytest.mark.parametrize(
    ("y", "trusted"), [(0.0, False), (0.27, False), (-0.27, False), (0.33, True), (-0.33, True)]
)
@pytest.mark.parametrize("along", [AHEAD, np.array([[0.6, 0.8, 0.0]])])
def test_a_path_is_taken_if_all_that_the_ball_passes_is_free(
    y: float, trusted: bool, along: NDArray[np.float64]
) -> None:
    beside = np.array([-along[0, 1], along[0, 0], 0.0])
    start = np.array([0.5, 0.0, 0.0]) - 0.5 * along - y * beside
    assert Paths(start, along).trusted(_Map(BALL))[0] == trusted  # type: ignore[arg-type]
    assert not Paths(start, along).trusted(_Map(BALL, UNKNOWN))[0]  # type: ignore[arg-type]


@pytest.mark.parametrize("beyond", [-0.27, 1.27])
def test_the_ball_has_ends(beyond: float) -> None:
    there = Scene((Solid("sphere", (beyond, 0.0, 0.0), (0.1, 0.1, 0.1)),), (0.0, 0.0, 0.0))
    assert not path().trusted(_Map(there))[0]  # type: ignore[arg-type]
    assert path(z=0.3).trusted(_Map(there))[0]  # type: ignore[arg-type]


def test_what_is_counted() -> None:
    drives = Drives()
    near, far = RADIUS_M - PLAY_M - 0.01, RADIUS_M + PLAY_M + 0.01
    clearance = np.array([near, near, RADIUS_M, RADIUS_M, far, far, far])
    drives.add(np.array([True, False, True, False, True, False, False]), clearance)
    assert drives == Drives(taken=3, hit=1, free=3, refused=2)
