"""Which way rays go, and that each is followed once."""

import numpy as np
import pytest
import taichi as ti
from hypothesis import given, settings
from hypothesis import strategies as st

from taichi_mrf.kernels.types import I32, F32Array3, I32Array, Vec4
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.rays import deals, dealt_ray, pixel_direction

pytestmark = pytest.mark.usefixtures("backend")


@ti.kernel
def _deal(workers: I32, run: I32, rays: I32, times: I32Array):  # noqa: ANN202 (Taichi allows no None)
    for worker in range(workers):
        for turn in range(deals(workers, run, rays)):
            ray = dealt_ray(worker, turn, workers, run)
            if ray < rays:
                ti.atomic_add(times[ray], 1)


@settings(max_examples=50)
@given(rays=st.integers(1, 5000), workers=st.integers(1, 40), run=st.integers(1, 300))
def test_every_ray_is_dealt_once(rays: int, workers: int, run: int) -> None:
    times = ti.ndarray(ti.i32, rays)
    times.fill(0)
    _deal(workers, run, rays, times)
    np.testing.assert_array_equal(times.to_numpy(), 1)


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
