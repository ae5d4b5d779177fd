"""Rendered against measured depth: closed forms and properties."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.errors import FrameError
from taichi_mrf.evaluation.held_out import DepthError, depth_error, pooled_depth_error


def _nothing_compared(error: DepthError) -> bool:
    return error.pixels == 0 and all(map(math.isnan, (error.median_abs, error.median, error.rms)))


def test_closed_form() -> None:
    measured = np.array([[2.0, 2.0, 2.0], [2.0, 0.0, np.nan]], np.float32)
    rendered = np.array([[2.0, 2.25, 1.5], [np.nan, 1.0, 1.0]], np.float32)
    error = depth_error(rendered, measured)
    assert error.pixels == 3
    assert error.unanswered == pytest.approx(1 / 4)
    assert error.median == pytest.approx(0.0)
    assert error.median_abs == pytest.approx(0.25)
    assert error.rms == pytest.approx(math.sqrt((0.25**2 + 0.5**2) / 3))


def test_nothing_rendered() -> None:
    error = depth_error(np.full((2, 2), np.nan), np.ones((2, 2)))
    assert _nothing_compared(error)
    assert error.unanswered == 1.0


@pytest.mark.parametrize("absent", [0.0, np.nan, np.inf, -1.0])
def test_nothing_measured(absent: float) -> None:
    error = depth_error(np.ones((2, 2)), np.full((2, 2), absent))
    assert _nothing_compared(error)
    assert math.isnan(error.unanswered)


def test_no_images() -> None:
    error = pooled_depth_error([])
    assert _nothing_compared(error)
    assert math.isnan(error.unanswered)


def test_shapes_must_agree() -> None:
    with pytest.raises(FrameError, match=r"\(2, 3\) and \(3, 2\)"):
        depth_error(np.ones((2, 3)), np.ones((3, 2)))


@given(offset=st.floats(-0.5, 0.5), seed=st.integers(0, 2**32 - 1))
def test_constant_offset(offset: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    measured = np.where(rng.random((6, 8)) < 0.3, 0.0, rng.uniform(1, 5, (6, 8)))
    measured[0, 0] = 2.0
    error = depth_error(measured + offset, measured)
    assert error.pixels == np.count_nonzero(measured)
    assert error.unanswered == 0.0
    assert error.median == pytest.approx(offset, abs=1e-12)
    assert error.median_abs == pytest.approx(abs(offset), abs=1e-12)
    assert error.rms == pytest.approx(abs(offset), abs=1e-12)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 4))
def test_pooling_equals_one_large_image(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    measured = np.where(rng.random((count, 5, 7)) < 0.2, 0.0, rng.uniform(1, 5, (count, 5, 7)))
    rendered = np.where(rng.random((count, 5, 7)) < 0.2, np.nan, measured + rng.normal(0, 0.1, (count, 5, 7)))
    pooled = pooled_depth_error(zip(rendered, measured, strict=True))
    whole = depth_error(rendered.reshape(-1, 7), measured.reshape(-1, 7))
    assert pooled == whole or (_nothing_compared(pooled) and _nothing_compared(whole))


def test_pooling_weighs_pixels_not_images() -> None:
    small = (np.array([[2.0, np.nan, np.nan]]), np.array([[1.0, 0.0, 0.0]]))  # one pixel, off by a metre
    large = (np.full((10, 10), 1.01), np.ones((10, 10)))
    assert pooled_depth_error([small, large]).median_abs == pytest.approx(0.01)
