"""The pattern on surfaces: fixed in space, mild, and gone where pixels are too wide for it."""

import numpy as np
import pytest

from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.synthetic.rendered_sequence import CONTRAST, CUBES_M, pattern
from taichi_mrf.datasets.synthetic.room import SyntheticRoom

SMALL = "synthetic:room?width=80&height=60&frames=60"


def test_a_pattern_is_continuous_and_neither_brightens_nor_darkens() -> None:
    points_m = np.random.default_rng(1).uniform(-5, 5, (20_000, 3))
    fine = np.full(len(points_m), 1e-3)
    factor = pattern(points_m, fine)
    assert abs(factor.mean() - 1) < 0.01
    assert factor.std() > 0.1
    assert factor.max() <= (1 + CONTRAST) ** 3
    assert factor.min() >= (1 - CONTRAST) ** 3
    step = np.array([1e-4, -1e-4, 1e-4])
    # The slope of smoothed interpolation is at most 1.5 for each cube's side and axis.
    steepest = factor.max() * 3 * 2 * CONTRAST * 1.5 / (1 - CONTRAST) / min(CUBES_M)
    assert np.abs(pattern(points_m + step, fine) - factor).max() < steepest * 1e-4


def test_wide_pixels_see_plain_paint() -> None:
    points_m = np.random.default_rng(2).uniform(-5, 5, (100, 3))
    np.testing.assert_array_equal(pattern(points_m, np.full(100, 0.5)), 1.0)


@pytest.mark.usefixtures("one_backend")
def test_a_mottled_room_has_the_same_depth_and_the_pattern_of_its_points() -> None:
    plain, mottled = open_dataset(SMALL), open_dataset(f"{SMALL}&texture=mottled")
    assert isinstance(mottled, SyntheticRoom)
    a, b = plain.read(7), mottled.read(7)
    np.testing.assert_array_equal(a.depth_m, b.depth_m)
    assert a.color is not None
    assert b.color is not None
    depth_m = mottled.clean_depth(7).astype(np.float64)
    points = mottled.camera.rays() * depth_m[..., None]
    T = mottled.pose(7)
    expected = a.color * pattern(points @ T[:3, :3].T + T[:3, 3], depth_m / mottled.camera.fx)[..., None]
    assert np.abs(b.color - np.clip(expected, 0, 255)).max() <= 1.0
    assert (a.color != b.color).any(axis=-1).mean() > 0.8
