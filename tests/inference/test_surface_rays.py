"""The field of signed distances against float64 NumPy, ray by ray and voxel by voxel."""

import numpy as np
import pytest
from numpy.typing import NDArray
from one_pixel import random_pose
from oracles.forward import Noise
from oracles.traversal import segments

from taichi_mrf.inference import surface_field
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.voxels.layout import BRICK, offsets_in_brick

pytestmark = pytest.mark.usefixtures("backend")

CAMERA = PinholeCamera(5, 4, 8.0, 8.0, 2.0, 1.5)
VOXEL = 0.1
SIGMA, BIAS = (0.02, 0.05), (0.03,)


@pytest.fixture(autouse=True)
def _every_ray_marks_its_band(monkeypatch: pytest.MonkeyPatch) -> None:
    """There are too few rays for scouts."""
    monkeypatch.setattr(surface_field, "SCOUTS", 1)


def _map(**parameters: float) -> MRFMap:
    return MRFMap(VOXEL, PolynomialNoise(SIGMA, BIAS), max_depth=5.0, ray_density=0.0, **parameters)


def _field(m: MRFMap) -> dict[tuple[int, int, int], tuple[float, float, float]]:
    """Weight, distance and excess, both times weight, of each voxel that has any."""
    field = m.surface_field()
    found = {}
    for brick, *sums in zip(field.bricks, field.weight, field.distance, field.excess, strict=True):
        for number in np.flatnonzero(sums[0]):
            voxel = tuple((brick * BRICK + offsets_in_brick()[number]).tolist())
            found[voxel] = float(sums[0][number]), float(sums[1][number]), float(sums[2][number])
    return found


def test_the_field_equals_numpy() -> None:
    rng = np.random.default_rng(5)
    T = random_pose(rng)
    depth = rng.uniform(0.8, 1.6, CAMERA.shape).astype(np.float32)
    m = _map()
    m.add_keyframe(depth, T, CAMERA)
    expected: dict[tuple[int, int, int], NDArray[np.float64]] = {}
    sizes: dict[tuple[int, int, int], NDArray[np.float64]] = {}
    noise = Noise(SIGMA, BIAS)
    for v, u in np.ndindex(*CAMERA.shape):
        direction = T[:3, :3] @ CAMERA.rays()[v, u]
        metres = np.linalg.norm(direction)
        surface = float(noise.depth_of_deviation(float(depth[v, u]), 0.0))
        measured = float(depth[v, u])
        nearest, farthest = (float(noise.depth_of_deviation(measured, sigmas)) for sigmas in (3.0, -3.0))
        least = 2 * VOXEL / metres
        ends = min(nearest, surface - least), max(farthest, surface + least)
        cells, near, far = segments(T[:3, 3], direction, *ends, VOXEL)
        for cell, begin, end in zip(cells.tolist(), near, far, strict=True):
            at = ((np.array(cell) + 0.5) * VOXEL - T[:3, 3]) @ direction / metres**2
            sigma = float(noise.sigma_at(at)) * metres
            weight = (end - begin) * metres / VOXEL / (16 * (sigma / VOXEL) ** 2 + 1)
            distance = (measured - BIAS[0] - at) * metres / VOXEL
            terms = weight * np.array([1.0, distance, distance**2 - (sigma / VOXEL) ** 2 - 1 / 16])
            expected[tuple(cell)] = expected.get(tuple(cell), 0.0) + terms
            sizes[tuple(cell)] = sizes.get(tuple(cell), 0.0) + np.abs(terms)
    found = _field(m)
    for voxel, sums in expected.items():
        # P of each ray is between 0.99 and 1: nothing is known but a prior of two surfaces a metre.
        error = np.abs(found.get(voxel, (0.0, 0.0, 0.0)) - sums)
        assert (error <= 0.01 * sizes[voxel] + 2e-3).all(), (voxel, error, sizes[voxel])
    assert sum(sums[0] for sums in found.values()) == pytest.approx(
        sum(sums[0] for sums in expected.values()), rel=0.01
    )


def test_a_thing_that_others_looked_through_has_no_say() -> None:
    wall, thing = np.full(CAMERA.shape, 2.0, np.float32), np.full(CAMERA.shape, 2.0, np.float32)
    thing[:, :2] = 1.0
    m = MRFMap(VOXEL, PolynomialNoise((0.02,)), max_depth=5.0, ray_density=0.0)
    for depth in (wall, wall, wall, thing):
        m.add_keyframe(depth, np.eye(4), CAMERA)
    before = max(weight for (_, _, z), (weight, *_) in _field(m).items() if z == 9)
    m.infer()
    after = max([weight for (_, _, z), (weight, *_) in _field(m).items() if z == 9], default=0.0)
    assert before > 0.1
    assert after < 0.02 * before
    assert max(weight for (_, _, z), (weight, *_) in _field(m).items() if z == 19) > 1.0


def test_a_removed_keyframe_takes_its_share_along() -> None:
    rng = np.random.default_rng(6)
    views = [
        (rng.uniform(0.8, 1.6, CAMERA.shape).astype(np.float32), random_pose(rng, 0.2)) for _ in range(3)
    ]
    edited, others = _map(), _map()
    ids = [edited.add_keyframe(depth, T, CAMERA) for depth, T in views]
    for depth, T in views[1:]:
        others.add_keyframe(depth, T, CAMERA)
    edited.infer()
    edited.remove_keyframe(ids[0])
    edited.infer()
    others.infer()
    assert _field(edited) == _field(others)
