"""The pinhole camera: pixels to rays, other resolutions of the same view, and refused parameters."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import PinholeCamera

CAMERA = PinholeCamera(width=64, height=48, fx=52.5, fy=51.0, cx=31.0, cy=24.5)

cameras = st.builds(
    PinholeCamera,
    width=st.integers(1, 50),
    height=st.integers(1, 50),
    fx=st.floats(1, 1000),
    fy=st.floats(1, 1000),
    cx=st.floats(-10, 60),
    cy=st.floats(-10, 60),
)


@given(cameras)
def test_rays_project_back_to_their_pixels(camera: PinholeCamera) -> None:
    rays = camera.rays()
    assert rays.shape == (*camera.shape, 3)
    u = camera.fx * rays[..., 0] / rays[..., 2] + camera.cx
    v = camera.fy * rays[..., 1] / rays[..., 2] + camera.cy
    np.testing.assert_allclose(u, np.tile(np.arange(camera.width), (camera.height, 1)), atol=1e-9)
    np.testing.assert_allclose(v.T, np.tile(np.arange(camera.height), (camera.width, 1)), atol=1e-9)


def test_range_per_depth_is_one_on_the_optical_axis_and_grows_to_the_corner() -> None:
    scale = CAMERA.range_per_depth()
    corner = np.linalg.norm([(0 - 31.0) / 52.5, (0 - 24.5) / 51.0, 1.0])
    assert scale[24, 31] == pytest.approx(np.hypot(1.0, 0.5 / 51.0))
    assert scale[0, 0] == pytest.approx(corner)
    assert (scale >= 1).all()


def test_scaled_sees_the_same_view() -> None:
    half = CAMERA.scaled(0.5)
    assert half.shape == (24, 32)
    # The image's border, half a pixel outside the outermost centres, stays at the same angles.
    for camera, factor in ((CAMERA, 1.0), (half, 0.5)):
        left = (-0.5 - camera.cx) / camera.fx
        top = (-0.5 - camera.cy) / camera.fy
        right = (64 * factor - 0.5 - camera.cx) / camera.fx
        assert (left, top, right) == pytest.approx((-31.5 / 52.5, -25.0 / 51.0, 32.5 / 52.5))


@given(cameras)
def test_scaling_by_one_changes_nothing(camera: PinholeCamera) -> None:
    assert dataclasses.astuple(camera.scaled(1.0)) == pytest.approx(dataclasses.astuple(camera))


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("width", 0, "at least 1"),
        ("height", -3, "at least 1"),
        ("fx", 0.0, "positive"),
        ("fy", -500.0, "positive"),
        ("fx", float("nan"), "fx is not finite"),
        ("cy", float("inf"), "cy is not finite"),
    ],
)
def test_impossible_parameters_are_refused(field: str, value: float, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        dataclasses.replace(CAMERA, **{field: value})
