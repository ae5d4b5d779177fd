"""Scores of meshes whose distance to the truth is known."""

import numpy as np
import pytest

from taichi_mrf.evaluation.surface_scores import SurfaceTruth, surface_truth
from taichi_mrf.sensor.camera import PinholeCamera

pytest.importorskip("scipy")

CAMERA = PinholeCamera(60, 40, 60.0, 60.0, 29.5, 19.5)
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture(scope="module")
def truth() -> SurfaceTruth:
    """A wall 1 m in front of the camera, of which the map saw the left half."""
    depth = np.ones(CAMERA.shape, np.float32)
    left = np.zeros(CAMERA.shape, bool)
    left[:, :30] = True
    return surface_truth([depth], [np.eye(4)], CAMERA, [0], [left])


def _wall(z: float, right: float = 0.45) -> np.ndarray:
    return np.array([[-0.45, -0.3, z], [-0.45, 0.3, z], [right, 0.3, z], [right, -0.3, z]])


def test_a_mesh_beside_the_truth(truth: SurfaceTruth) -> None:
    scores = truth.scores(_wall(1.01), SQUARE, np.full(4, 0.007, np.float32))
    assert scores.accuracy_m == pytest.approx(0.01, abs=1e-3)
    assert scores.f_2cm > 0.98
    assert scores.normals_deg < 1.0
    assert (scores.within_1_std, scores.within_2_std) == (0.0, 1.0)
    assert truth.scores(_wall(1.03), SQUARE).f_2cm == 0.0


def test_what_the_map_did_not_see_need_not_be_found(truth: SurfaceTruth) -> None:
    assert truth.scores(_wall(1.0, right=0.0), SQUARE).found_2cm > 0.98
    half = truth.scores(_wall(1.0, right=-0.25), SQUARE)
    # The mesh ends at -0.25; a point of the truth counts 2 cm beyond, and 2 cm for the distance of samples.
    assert half.found_2cm == pytest.approx((0.475 - 0.21) / 0.475, abs=0.04)
    assert half.precision_2cm > 0.98
