"""Sums of messages: exact to their resolution, the same in any order, and never too large for their bits."""

# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import look_at
from taichi_mrf.inference.accumulators import LONGEST, add_message, finest_scale, length_sum, mean_message
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, F32Array, I32Array, I64Array
from taichi_mrf.voxels.layout import BRICK, offsets_in_brick
from taichi_mrf.voxels.window import Window

pytestmark = pytest.mark.backends

VOXELS = 40

Floats = NDArray[np.float32]


@ti.kernel
def _add(index: I32Array, length: F32Array, message: F32Array, scale: F32, sums: I64Array):
    for i in range(index.shape[0]):
        add_message(sums, index[i], length[i], message[i], scale)


@ti.kernel
def _read(sums: I64Array, scale: F32, lengths: F32Array, means: F32Array):
    for i in range(lengths.shape[0]):
        lengths[i] = length_sum(sums[i], scale)
        means[i] = mean_message(sums[i])


def accumulated(
    index: NDArray[np.int32], length: Floats, message: Floats, scale: float
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """The packed sums, the lengths and the means of VOXELS voxels."""
    sums = ti.ndarray(ti.i64, VOXELS)
    sums.fill(0)
    _add(index, length, message, scale, sums)
    lengths, means = np.zeros(VOXELS, np.float32), np.zeros(VOXELS, np.float32)
    _read(sums, scale, lengths, means)
    return sums.to_numpy(), lengths, means


def random_rays(count: int, seed: int) -> tuple[NDArray[np.int32], Floats, Floats]:
    random = np.random.default_rng(seed)
    index = (VOXELS * random.random(count) ** 3).astype(np.int32)  # from many rays a voxel to few
    length = (LONGEST * random.random(count) ** 2).astype(np.float32)
    message = random.beta(0.4, 0.6, count).astype(np.float32)
    return index, length, message


@pytest.mark.parametrize("exponent", [11, 17, 22])
@pytest.mark.parametrize("count", [60, 3000])
def test_means_are_the_weighted_means(backend: str, count: int, exponent: int) -> None:
    index, length, message = random_rays(count, seed=count)
    _, lengths, means = accumulated(index, length, message, 2.0**exponent)
    rays = np.bincount(index, minlength=VOXELS)
    total = np.bincount(index, length.astype(np.float64), minlength=VOXELS)
    weighted = np.bincount(index, length.astype(np.float64) * message, minlength=VOXELS)
    # A contribution is rounded to the next of 2^exponent steps, and on the way there to float32.
    resolution = rays * 0.5 / 2.0**exponent + 4 * 2.0**-24 * total
    assert (np.abs(lengths - total) <= resolution + 1e-30).all()
    seen = total > 8 * resolution
    error = np.abs(means - weighted / np.maximum(total, 1e-30))
    assert (error[seen] <= 2.5 * resolution[seen] / total[seen] + 2.0**-22).all()
    assert ((means >= 0) & (means <= 1)).all()
    assert seen[rays > 0].mean() > 0.7
    assert (lengths[rays == 0] == 0).all()
    assert (means[rays == 0] == 0).all()


def test_sums_do_not_depend_on_the_order(backend: str) -> None:
    index, length, message = random_rays(20000 if backend == "cpu" else 4000, seed=7)
    expected, _, _ = accumulated(index, length, message, 2.0**14)
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(len(index))
        sums, _, _ = accumulated(index[order], length[order], message[order], 2.0**14)
        np.testing.assert_array_equal(sums, expected)


def test_certain_messages_stay_certain(backend: str) -> None:
    """A mean of ones is 1 and of zeros 0, up to sums of nearly 2^31."""
    for count in (1, 5, 1000):
        scale = 2.0 ** np.floor(np.log2(2**31 / (LONGEST * count + 1)))
        index = np.zeros(count, np.int32)
        length = np.full(count, LONGEST, np.float32)
        for value in (0.0, 1.0):
            message = np.full(count, value, np.float32)
            _, lengths, means = accumulated(index, length, message, scale)
            assert lengths[0] == pytest.approx(count * LONGEST, rel=1e-6)
            assert means[0] == value


def test_the_two_halves_do_not_touch(backend: str) -> None:
    """A sum of lengths beyond 2^31 would still not reach the messages: it has all of its 32 bits."""
    scale = 2.0**28
    index, length = np.zeros(15, np.int32), np.ones(15, np.float32)
    sums, lengths, means = accumulated(index, length, np.full(15, 0.25, np.float32), scale)
    assert lengths[0] == 15
    assert means[0] == 0.25
    assert sums[0] >> 32 == 15 * 2**26


def rays_through(
    camera: PinholeCamera, T_world_camera: NDArray[np.float64], lower: NDArray[np.float64]
) -> tuple[int, float]:
    """How many pixels' rays meet a unit cube (in front of the camera), and the sum of their lengths in it."""
    directions = camera.rays().reshape(-1, 3) @ T_world_camera[:3, :3].T
    directions[directions == 0] = 1e-20  # parallel to a face: either infinitely far from it, or in it
    centre = T_world_camera[:3, 3]
    a, b = (lower - centre) / directions, (lower + 1 - centre) / directions
    near = np.maximum(np.minimum(a, b).max(axis=1), 0)
    far = np.maximum(a, b).min(axis=1)
    lengths = np.maximum(far - near, 0) * np.linalg.norm(directions, axis=1)
    return int((lengths > 0).sum()), float(lengths.sum())


angle = st.floats(-1, 1)
cameras = st.builds(
    lambda width, height, fx, stretch, cx, cy: PinholeCamera(
        width, height, fx, fx * stretch, cx * width, cy * height
    ),
    st.integers(2, 160), st.integers(2, 120), st.floats(20, 400), st.floats(0.5, 2), st.floats(-0.2, 1.2),
    st.floats(-0.2, 1.2),
)  # fmt: skip


@settings(max_examples=300)
@given(
    camera=cameras,
    pixel=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    distance=st.floats(0, 60),
    turn=st.tuples(angle, angle, angle),
    offset=st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1)),
    seed=st.integers(0, 2**20),
)
def test_no_voxel_gets_more_rays_than_the_scale_allows(
    camera: PinholeCamera, pixel: tuple, distance: float, turn: tuple, offset: tuple, seed: int
) -> None:
    """Counted by brute force over the voxels of a brick that lies anywhere in the image."""
    T = look_at((0, 0, 0), np.array([1.0, 0.1, 0.0]) + turn)
    ray = camera.rays()[int(pixel[1] * (camera.height - 1)), int(pixel[0] * (camera.width - 1))] @ T[:3, :3].T
    number = np.random.default_rng(seed).integers(0, BRICK**3)
    towards_camera = np.where(ray > 0, 0, BRICK - 1)  # the brick's nearest voxel is the likeliest culprit
    brick = np.array([3, -70, 12])
    low = brick * BRICK
    # Put the camera where this pixel sees the brick's nearest corner from ``distance`` voxels.
    T[:3, 3] = low + towards_camera + np.array(offset) - distance * ray / np.linalg.norm(ray)
    window = Window((0, -80, 8), (16, 16, 16), 1.0)
    scale = finest_scale(camera, camera.width * camera.height, T, window, brick[None].astype(np.int32))
    assert np.log2(scale) == round(np.log2(scale))
    for local in (towards_camera, offsets_in_brick()[number]):
        count, length = rays_through(camera, T, low + local)
        assert count * LONGEST * scale <= 2**31
        assert length * scale + 0.5 * count < 2**31


@settings(max_examples=100)
@given(
    camera=cameras,
    pixel=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    distance=st.floats(1, 60),
    side=st.sampled_from([2, 4, 8]),
)
def test_rays_that_stand_for_many_pixels_do_not_overflow_either(
    camera: PinholeCamera, pixel: tuple, distance: float, side: int
) -> None:
    """The image in blocks, each one ray through its middle that counts as all its pixels."""
    T = look_at((0, 0, 0), (1.0, 0.1, 0.0))
    ray = camera.rays()[int(pixel[1] * (camera.height - 1)), int(pixel[0] * (camera.width - 1))] @ T[:3, :3].T
    towards_camera = np.where(ray > 0, 0, BRICK - 1)
    brick = np.array([3, -70, 12])
    T[:3, 3] = brick * BRICK + towards_camera + 0.5 - distance * ray / np.linalg.norm(ray)
    window = Window((0, -80, 8), (16, 16, 16), 1.0)
    pixels = camera.width * camera.height
    scale = finest_scale(camera, pixels, T, window, brick[None].astype(np.int32), side)
    if min(camera.width, camera.height) < side:
        return
    middle = (side - 1) / 2
    blocks = PinholeCamera(
        camera.width // side, camera.height // side, camera.fx / side, camera.fy / side,
        (camera.cx - middle) / side, (camera.cy - middle) / side,
    )  # fmt: skip
    count, length = rays_through(blocks, T, brick * BRICK + towards_camera)
    assert count * side**2 * LONGEST * scale <= 2**31
    assert side**2 * length * scale + 0.5 * count < 2**31


def test_far_voxels_get_a_finer_scale() -> None:
    """At 4 m and 2 cm a VGA camera's 307200 rays are some 30 a voxel: seven more binary digits at least."""
    camera = PinholeCamera(640, 480, 525, 525, 319.5, 239.5)
    window = Window((0, -8, -8), (32, 16, 16), 0.02)
    T = look_at((0.1, 0, 0), (1, 0, 0))
    rays = camera.width * camera.height
    near = finest_scale(camera, rays, T, window, np.array([[0, 0, 0]], np.int32))
    far = finest_scale(camera, rays, T, window, np.array([[25, 0, 0], [26, 0, 0]], np.int32))
    assert near * LONGEST * rays < 2**31
    assert far / near >= 2**7
    few = finest_scale(camera, 10, T, window, np.array([[0, 0, 0]], np.int32))
    assert 2**31 / 2.01 <= few * (LONGEST * 10 + 1) <= 2**31


def test_the_scale_is_there_without_any_brick_or_ray() -> None:
    camera = PinholeCamera(640, 480, 525, 525, 319.5, 239.5)
    window = Window((0, 0, 0), (8, 8, 8), 0.02)
    scale = finest_scale(camera, 0, np.eye(4), window, np.zeros((0, 3), np.int32))
    assert 0 < scale * LONGEST < 2**31
