"""The list of rays: blocks that agree, the rest pixel by pixel, and nothing twice."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.keyframe import DepthImage, RayList, checked_depth
from taichi_mrf.inference.ray_list import (
    AGREE_SIGMAS,
    AGREE_VOXELS,
    BITS,
    LEVELS,
    TILE,
    RayBundler,
    stride_metres,
)
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise

pytestmark = pytest.mark.usefixtures("backend")

VOXEL = 0.1
SIGMA_M = 0.02
NOISE = PolynomialNoise((SIGMA_M,))


def camera_of(width: int, height: int) -> PinholeCamera:
    return PinholeCamera(width, height, 60.0, 50.0, width / 2, height / 2)


def listed(depth: NDArray[np.float32], **parameters: object) -> RayList:
    image = DepthImage.upload(
        checked_depth(depth, camera_of(*depth.shape[::-1]), 0.1), camera_of(*depth.shape[::-1]), NOISE
    )
    return RayBundler(VOXEL, InferenceConfig(**parameters)).rays_of(image)  # type: ignore[arg-type]


Block = tuple[int, int, int, int]
"""First column and row, columns, rows."""


def blocks_of(rays: RayList, width: int) -> list[tuple[Block, float]]:
    """The block and the depth of each ray."""
    numbers = rays.blocks.to_numpy()[: rays.number]
    pixels, levels = numbers >> BITS, numbers & ((1 << BITS) - 1)
    columns = (pixels % width, pixels // width, 2 ** ((levels + 1) // 2), 2 ** (levels // 2))
    depths = rays.depth.to_numpy()[: rays.number].tolist()
    return list(zip(zip(*(c.tolist() for c in columns), strict=True), depths, strict=True))


def oracle(depth: NDArray[np.float32], density: float) -> dict[Block, float]:
    """Blocks from single pixels up, as long as two of a size lie together, are few enough and agree."""
    height, width = depth.shape
    stride = stride_metres(camera_of(width, height), VOXEL, density)
    found = {(u, v, 1, 1): float(depth[v, u]) for v, u in zip(*np.nonzero(depth), strict=True)}
    wide, high = 1, 1
    for _ in range(LEVELS):
        half_wide, half_high = wide, high
        wide, high = (2 * wide, high) if wide == high else (wide, 2 * high)
        for v in range(0, height - high + 1, high):
            for u in range(0, width - wide + 1, wide):
                parts = [
                    (u, v, half_wide, half_high),
                    (u + wide - half_wide, v + high - half_high, half_wide, half_high),
                ]
                patch = depth[v : v + high, u : u + wide]
                agrees = np.ptp(patch) <= max(AGREE_VOXELS * VOXEL, AGREE_SIGMAS * SIGMA_M)
                fits = wide * high * patch.min() ** 2 <= stride**2
                if all(part in found for part in parts) and fits and agrees:
                    found[u, v, wide, high] = float(np.mean([found.pop(part) for part in parts]))
    return found


@settings(max_examples=40)
@given(
    width=st.integers(1, 75), height=st.integers(1, 70), wanted=st.sampled_from([1.0, 4.0, 9.0]),
    steepness=st.floats(0, 0.05), seed=st.integers(0, 2**20),
)  # fmt: skip
def test_bundles_are_those_of_the_oracle(
    width: int, height: int, wanted: float, steepness: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    depth = 0.4 + steepness * (u + v) + random.uniform(-0.02, 0.02, (height, width))
    depth[(u - width / 2) ** 2 + (v - height / 2) ** 2 < (height / 4) ** 2] += 1.0  # a rim
    depth[random.random((height, width)) < 0.02] = 0
    depth = depth.astype(np.float32)
    rays = listed(depth, ray_density=wanted / 10)
    expected = oracle(depth, wanted / 10)
    found = dict(blocks_of(rays, width))
    # float32 may round a spread or a quotient that lies at its bound to the other side.
    assert len(found.keys() ^ expected.keys()) <= 0.02 * len(expected)
    for block in found.keys() & expected.keys():
        assert found[block] == pytest.approx(expected[block], rel=1e-6)
    covered = np.zeros(depth.shape, int)
    for u0, v0, wide, high in found:
        covered[v0 : v0 + high, u0 : u0 + wide] += 1
    np.testing.assert_array_equal(covered, depth > 0)
    assert rays.widest == max((wide for _, _, wide, _ in found), default=1)


@pytest.mark.parametrize("parameters", [{"ray_density": 0.0}, {"ray_density": 1e9}])
def test_every_pixel_with_a_measurement_has_a_ray(parameters: dict[str, float]) -> None:
    depth = np.random.default_rng(2).uniform(0.2, 3.0, (48, 70)).astype(np.float32)
    depth[::5, ::7] = 0
    rays = listed(depth, **parameters)
    measured = {((u, v, 1, 1), float(depth[v, u])) for v, u in zip(*np.nonzero(depth), strict=True)}
    assert set(blocks_of(rays, 70)) == measured
    assert rays.number == len(measured)


def test_rays_of_a_tile_stand_together() -> None:
    depth = np.full((70, 90), 2.0, np.float32)
    tiles = [(v // TILE, u // TILE) for (u, v, _, _), _ in blocks_of(listed(depth, ray_density=0.0), 90)]
    assert tiles == sorted(tiles)


def test_an_image_without_a_measurement_has_no_ray() -> None:
    rays = listed(np.zeros((5, 7), np.float32), ray_density=4.0)
    assert (rays.number, rays.widest) == (0, 1)


def test_only_finite_positive_depths_are_measurements() -> None:
    values = [1.5, 0.0, -1.0, np.nan, np.inf, -np.inf, 0.05, 1e39, -1e300]
    for kind in (np.float64, np.float32):
        with np.errstate(over="ignore"):
            depth = np.array([values]).astype(kind)
        clean = checked_depth(depth, camera_of(len(values), 1), 0.1)
        assert clean.dtype == np.float32
        np.testing.assert_array_equal(clean, [[1.5] + [0.0] * 8])
