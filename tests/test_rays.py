"""Which pixels become rays, and that each is followed once."""

import numpy as np
import pytest
import taichi as ti
from hypothesis import given, settings
from hypothesis import strategies as st

from taichi_mrf.camera import PinholeCamera
from taichi_mrf.config import InferenceConfig
from taichi_mrf.inference.rays import deals, dealt_pixel, is_cast, pixel_direction, stride_metres
from taichi_mrf.voxels.types import F32, I32, F32Array, F32Array3, I32Array, Vec4

pytestmark = pytest.mark.usefixtures("backend")


@ti.kernel
def _deal(workers: I32, tile: I32, width: I32, height: I32, times: I32Array):  # noqa: ANN202 (Taichi allows no None)
    for worker in range(workers):
        for turn in range(deals(workers, tile, width, height)):
            u, v = dealt_pixel(worker, turn, workers, tile, width)
            if u < width and v < height:
                ti.atomic_add(times[v * width + u], 1)


@settings(max_examples=50)
@given(
    width=st.integers(1, 90), height=st.integers(1, 70), workers=st.integers(1, 40), tile=st.integers(1, 33)
)
def test_every_pixel_is_dealt_once(width: int, height: int, workers: int, tile: int) -> None:
    times = ti.ndarray(ti.i32, width * height)
    times.fill(0)
    _deal(workers, tile, width, height, times)
    np.testing.assert_array_equal(times.to_numpy(), 1)


@ti.kernel
def _select(depth: F32Array, width: I32, stride: F32, chosen: I32Array):  # noqa: ANN202 (Taichi allows no None)
    for pixel in range(depth.shape[0]):
        chosen[pixel] = is_cast(pixel % width, pixel // width, depth[pixel], stride)


@pytest.mark.parametrize("wanted", [0.0, 1.0, 4.0, 9.0])
def test_rays_are_thinned_by_what_a_voxel_covers(wanted: float) -> None:
    camera = PinholeCamera(64, 48, 60.0, 50.0, 31.5, 23.5)
    depth = np.random.default_rng(1).uniform(0.2, 3.0, camera.shape).astype(np.float32)
    depth[::5, ::7] = 0
    config = InferenceConfig(rays_per_voxel=wanted)
    chosen = np.zeros(depth.size, np.int32)
    _select(depth.reshape(-1), camera.width, stride_metres(camera, 0.1, config), chosen)
    v, u = np.mgrid[: camera.height, : camera.width]
    with np.errstate(divide="ignore"):
        covered = 0.1 * 50.0 / depth.astype(np.float64)  # pixels along a voxel's side
    stride = np.ones(depth.shape) if wanted == 0 else np.maximum(1, np.floor(covered / np.sqrt(wanted)))
    expected = (depth > 0) & (u % stride == 0) & (v % stride == 0)
    # float32 may round a quotient that lies next to a whole number to its other side.
    covered[depth == 0] = 0.5
    clear = np.abs(covered / np.sqrt(max(wanted, 1)) % 1 - 0.5) < 0.499
    np.testing.assert_array_equal(chosen.reshape(depth.shape)[clear] != 0, expected[clear])


@ti.kernel
def _directions(width: I32, intrinsics: Vec4, out: F32Array3):  # noqa: ANN202 (Taichi allows no None)
    for v, u in ti.ndrange(out.shape[0], width):
        d = pixel_direction(u, v, intrinsics)
        for axis in ti.static(range(3)):
            out[v, u, axis] = d[axis]


def test_directions_are_the_cameras() -> None:
    camera = PinholeCamera(13, 9, 20.0, 17.0, 5.3, 4.9)
    out = np.zeros((9, 13, 3), np.float32)
    _directions(13, ti.Vector([20.0, 17.0, 5.3, 4.9], ti.f32), out)
    np.testing.assert_allclose(out, camera.rays(), atol=1e-6)
