"""The list of rays: blocks that agree, the rest pixel by pixel, and nothing twice; groups of whole blocks."""

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.inference.keyframe import DepthImage, RayList, checked_depth
from taichi_mrf.inference.ray_list import (
    BITS,
    LEVELS,
    TILE,
    RayBundler,
    rays_per_voxel,
    stride_metres,
)
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise
from taichi_mrf.system import runtime
from taichi_mrf.system.resident import on_host

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.backends]

# Written out, and not imported: these tests hold the values.
AGREE_VOXELS, AGREE_SIGMAS, FREE_RAYS = 0.5, 2.0, 1.0
SUPPORT, END_SIGMAS = 6.5, 3.0

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
    depths = on_host(rays.depth)[: rays.number].tolist()
    return list(zip(_unpacked(on_host(rays.blocks)[: rays.number], width), depths, strict=True))


def groups_of(rays: RayList, width: int) -> list[tuple[Block, range]]:
    """The block of each group, and its rays."""
    first = on_host(rays.first)[: rays.group_number + 1].tolist()
    blocks = _unpacked(on_host(rays.groups)[: rays.group_number], width)
    return list(zip(blocks, map(range, first[:-1], first[1:]), strict=True))


def _unpacked(numbers: NDArray[np.int32], width: int) -> list[Block]:
    pixels, levels = numbers >> BITS, numbers & ((1 << BITS) - 1)
    columns = (pixels % width, pixels // width, 2 ** ((levels + 1) // 2), 2 ** (levels // 2))
    return list(zip(*(c.tolist() for c in columns), strict=True))


def oracle(depth: NDArray[np.float32], density: float, groups: bool = False) -> dict[Block, float]:
    """Blocks from single pixels up, as long as two of a size lie together, are few enough and agree; groups
    need not agree, and may hold pixels without a measurement."""
    height, width = depth.shape
    per_voxel = rays_per_voxel(VOXEL, density)
    per_voxel = min(per_voxel, FREE_RAYS) if groups else per_voxel
    stride = stride_metres(camera_of(width, height), VOXEL, per_voxel)
    if groups:
        depth = np.where(depth > 0, depth, np.inf)
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
                agrees = groups or np.ptp(patch) <= max(AGREE_VOXELS * VOXEL, AGREE_SIGMAS * SIGMA_M)
                fits = np.isinf(patch.min()) or wide * high * patch.min() ** 2 <= stride**2
                if all(part in found for part in parts) and fits and agrees:
                    found[u, v, wide, high] = float(np.mean([found.pop(part) for part in parts]))
    if groups:
        return {key: 0.0 for key in found if np.isfinite(_part(depth, key)).any()}
    return found


def _part(image: NDArray, block: Block) -> NDArray:
    u, v, wide, high = block
    return image[v : v + high, u : u + wide]


@settings(max_examples=40)
@given(
    width=st.integers(1, 75), height=st.integers(1, 70), wanted=st.sampled_from([1.0, 4.0, 9.0]),
    steepness=st.floats(0, 0.05), seed=st.integers(0, 2**20), on_gpu=st.booleans(),
)  # fmt: skip
def test_bundles_are_those_of_the_oracle(
    width: int, height: int, wanted: float, steepness: float, seed: int, on_gpu: bool
) -> None:
    """Tile by tile as on a CPU, and level by level as on a GPU."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    depth = 0.4 + steepness * (u + v) + random.uniform(-0.02, 0.02, (height, width))
    depth[(u - width / 2) ** 2 + (v - height / 2) ** 2 < (height / 4) ** 2] += 1.0  # a rim
    depth[random.random((height, width)) < 0.02] = 0
    depth = depth.astype(np.float32)
    with patch.object(runtime, "on_gpu", lambda: on_gpu):
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

    listed_blocks = [block for block, _ in blocks_of(rays, width)]
    groups = groups_of(rays, width)
    expected_groups = oracle(depth, wanted / 10, groups=True)
    assert len({block for block, _ in groups} ^ expected_groups.keys()) <= 0.02 * len(expected_groups)
    assert [i for _, members in groups for i in members] == list(range(rays.number))
    last, support = on_host(rays.last), on_host(rays.support)
    for number, ((u0, v0, wide, high), members) in enumerate(groups):
        assert len(members) > 0
        for u, v, columns, rows in (listed_blocks[i] for i in members):
            assert u0 <= u <= u + columns <= u0 + wide
            assert v0 <= v <= v + rows <= v0 + high
        depths = [found[listed_blocks[i]] for i in members]
        assert support[number] == pytest.approx(min(depths) - SUPPORT * SIGMA_M, abs=1e-5)
        np.testing.assert_allclose(last[list(members)], np.array(depths) + END_SIGMAS * SIGMA_M, atol=1e-5)
    assert rays.widest == max((wide for (_, _, wide, _), _ in groups), default=1)


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


def test_only_finite_depths_from_the_least_one_on_are_measurements() -> None:
    camera = PinholeCamera(7, 1, 5.0, 5.0, 3.0, 0.0)
    for kind in (np.float32, np.float64):
        with np.errstate(over="ignore"):
            depth = np.array([[0.5, 0.4999, np.inf, -1.0, np.nan, 1e300, 2.0]]).astype(kind)
        found = checked_depth(depth, camera, 0.5)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, np.float32([[0.5, 0, 0, 0, 0, 0, 2.0]]))
    zeros = checked_depth(np.zeros((1, 7)) * -1.0, camera, 0.0)
    assert not np.signbit(zeros).any()
