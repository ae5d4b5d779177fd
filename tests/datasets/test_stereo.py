"""Stereo depth on rendered pairs, whose disparity and occlusions are known exactly, and its
sigma for each pixel: small where images agree and have texture, large at edges."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from stereo_rig import BASELINE, write
from stereo_rig import CAMERA as STEREO_CAMERA
from stereo_scene import Layer, Pair, render

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.config.text import field_help
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.stereo.matching import (
    StereoMatching,
    StereoPairs,
    StereoRig,
    depth_sigma,
    disparity_sigma,
    left_right_consistent,
    stereo_depth,
    stereo_disparity,
)
from taichi_mrf.errors import ConfigError, FrameError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import PolynomialNoise, evaluate

# Written out, and not imported: these tests hold the values.
BLOCK = 5
MOVE_POWER = 0.3
MOVE_RANGE_PX = (0.1, 3.0)
SIGMA_D_PX = 0.286
SIGMA_PX = 0.47
SPREAD_OFFSET_PX = 0.1
SPREAD_POWER = 1 / 3
SPREAD_RANGE_PX = (0.06, 3.0)

CAMERA = PinholeCamera(300, 120, 250.0, 250.0, 149.5, 59.5)
RIG = StereoRig(CAMERA, baseline_m=0.2)
BOX = (120, 200, 30, 90)
"""Columns 120 to 199, rows 30 to 89."""


def matched(pair: Pair, **settings: float) -> NDArray[np.float32]:
    return stereo_disparity(pair.left, pair.right, dataclasses.replace(StereoMatching(), **settings))


@pytest.mark.parametrize(
    "plane",
    [(20, 0, 0), (20.3, 0, 0), (20.5, 0, 0), (15, 0.1, 0), (40, -0.1, 0.05), (10, 0.05, 0.2), (100, 0, 0)],
    ids=str,
)
@pytest.mark.parametrize("paths", [3, 4, 5, 8])
def test_a_slanted_plane_is_matched_to_a_part_of_a_pixel(plane: tuple[float, ...], paths: int) -> None:
    pair = render([Layer(plane)])
    disparity = matched(pair, paths=paths)
    found = disparity > 0
    error = (disparity - pair.disparity)[found]
    assert found[pair.visible].mean() > 0.95
    assert np.median(np.abs(error)) < 0.2  # the parabola through three costs pulls towards whole pixels
    assert np.sqrt(np.mean(error**2)) < SIGMA_D_PX
    assert np.abs(error).max() < 3


def test_whole_pixels_are_met_exactly() -> None:
    disparity = matched(render([Layer((23, 0, 0))]))
    np.testing.assert_allclose(disparity[10:-10, 40:-10], 23, atol=1 / 8)


def test_what_only_the_left_camera_sees_has_no_depth() -> None:
    pair = render([Layer((12, 0, 0.02)), Layer((32, 0, 0), BOX)])
    disparity = matched(pair)
    hidden = ~pair.visible
    beside_the_box = hidden & (np.arange(300) > 90)
    assert beside_the_box.sum() > 60 * 15  # the box hides a band as wide as its disparity is larger
    assert (disparity[beside_the_box] > 0).mean() < 0.05
    assert (disparity[hidden & (np.arange(300) < 60)] > 0).mean() < 0.01  # left of the right camera's view
    inside = disparity[BOX[2] + 4 : BOX[3] - 4, BOX[0] + 4 : BOX[1] - 4]
    np.testing.assert_allclose(inside, 32, atol=0.5)


def test_without_the_left_right_check_the_hidden_band_is_filled() -> None:
    pair = render([Layer((12, 0, 0.02)), Layer((32, 0, 0), BOX)])
    beside_the_box = ~pair.visible & (np.arange(300) > 90)
    checked = matched(pair, uniqueness=0, speckle_size=0)
    unchecked = matched(pair, uniqueness=0, speckle_size=0, left_right_tolerance=1000.0)
    assert (unchecked[beside_the_box] > 0).mean() > 0.2
    assert (checked[beside_the_box] > 0).mean() < 0.5 * (unchecked[beside_the_box] > 0).mean()


def test_the_left_edge_is_matched_as_far_as_the_right_camera_sees_it() -> None:
    """OpenCV alone gives nothing in the first 128 columns."""
    disparity = matched(render([Layer((12, 0, 0))]))
    assert (disparity[:, :12] > 0).mean() < 0.02
    assert (disparity <= np.arange(300) + 0.5).all()  # a larger one would point outside the right image
    assert (disparity[:, 20:128] > 0).mean() > 0.95


def test_speckles_are_dropped() -> None:
    pair = render([Layer((12, 0, 0)), Layer((30, 0, 0), (150, 160, 50, 60))])
    speck = np.s_[52:58, 152:158]
    assert (np.abs(matched(pair, speckle_size=0)[speck] - 30) < 1).all()
    assert (matched(pair)[speck] == 0).all()
    assert (matched(pair)[:40, 150:] > 0).mean() > 0.95


def test_an_area_without_texture_is_no_measurement() -> None:
    pair = render([Layer((12, 0, 0)), Layer((12, 0, 0), BOX, grey=128)])
    flat = np.s_[BOX[2] + 8 : BOX[3] - 8, BOX[0] + 8 : BOX[1] - 8]
    assert (matched(pair, least_texture=0.0)[flat] > 0).mean() > 0.9  # guessed from the surroundings
    assert (matched(pair)[flat] == 0).all()


def test_two_images_of_different_things_have_no_depth() -> None:
    left, right = render([Layer((12, 0, 0))], seed=1).left, render([Layer((12, 0, 0))], seed=2).right
    assert (stereo_disparity(left, right) > 0).mean() < 0.01


def test_what_is_too_far_or_too_near_has_no_depth() -> None:
    pair = render([Layer((5, 0.1, 0))])
    disparity = matched(pair, least_disparity=15.0, disparities=32)
    assert (disparity[:, :90] == 0).all()
    assert (disparity[:, 280:] == 0).all()
    middle = disparity[:, 120:250]
    assert (middle > 0).mean() > 0.95
    assert disparity[disparity > 0].min() >= 15
    assert disparity.max() < 32


def test_the_number_of_threads_changes_nothing() -> None:
    pair = render([Layer((12, 0.03, 0.02)), Layer((40, 0, 0), BOX)])
    threads = cv2.getNumThreads()
    try:
        images = []
        for count in (1, 3):
            cv2.setNumThreads(count)
            images.append(matched(pair))
    finally:
        cv2.setNumThreads(threads)
    np.testing.assert_array_equal(*images)


@given(st.integers(1, 40), st.integers(5, 60), st.sampled_from([3, 4, 5, 8]))
def test_any_size_is_matched(height: int, width: int, paths: int) -> None:
    left = np.random.default_rng(height * width).integers(0, 256, (height, width)).astype(np.uint8)
    disparity = stereo_disparity(left, np.roll(left, -4, axis=1), StereoMatching(paths=paths))  # type: ignore[arg-type]
    assert disparity.shape == (height, width)
    assert disparity.dtype == np.float32
    assert (disparity <= np.arange(width) + 0.5).all()  # the right image has no columns below 0


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 5.0))
def test_left_right_check_against_a_loop(seed: int, tolerance: float) -> None:
    random = np.random.default_rng(seed)
    left, right = (random.choice([0.0, 0.4, 1.0, 2.2, 3.0, 5.0], (4, 9)) for _ in range(2))
    expected = np.zeros(left.shape, bool)
    for v, u in np.ndindex(left.shape):
        partner = int(np.rint(u - left[v, u]))
        if left[v, u] > 0 and partner >= 0 and right[v, partner] > 0:
            expected[v, u] = abs(right[v, partner] - left[v, u]) <= tolerance
    np.testing.assert_array_equal(left_right_consistent(left, right, tolerance), expected)


def test_depth_is_baseline_times_focal_length_over_disparity() -> None:
    pair = render([Layer((20, 0, 0.1))])
    depth_m = stereo_depth(pair.left, pair.right, RIG)
    disparity = stereo_disparity(pair.left, pair.right)
    assert depth_m.dtype == np.float32
    np.testing.assert_array_equal(depth_m > 0, disparity > 0)
    found = depth_m > 0
    np.testing.assert_allclose(depth_m[found], 0.2 * 250 / disparity[found], rtol=1e-6)
    true_m = 0.2 * 250 / pair.disparity
    sigma_m = evaluate(PolynomialNoise(RIG.sigma()).sigma, true_m)
    error = ((depth_m - true_m) / sigma_m)[found]
    assert np.sqrt(np.mean(error**2)) < 1


def test_sigma_of_depth_is_that_of_noisy_disparities() -> None:
    random = np.random.default_rng(3)
    _, _, lambda_ = depth_sigma(0.25, RIG.baseline_m, CAMERA.fx)
    for depth_m in (0.5, 1.0, 2.0):
        disparity = RIG.baseline_m * CAMERA.fx / depth_m + 0.25 * random.standard_normal(200_000)
        assert RIG.depth(disparity).std() == pytest.approx(lambda_ * depth_m**2, rel=0.02)
    assert RIG.sigma(0.25) == depth_sigma(0.25, 0.2, 250.0) == (0.0, 0.0, 0.25 / 50.0)


def test_each_parameter_has_a_help_text() -> None:
    assert set(field_help(StereoMatching)) == {field.name for field in dataclasses.fields(StereoMatching)}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("disparities", 100),
        ("disparities", 0),
        ("paths", 6),
        ("block_size", 4),
        ("block_size", -1),
        ("small_step_penalty", 0.0),
        ("large_step_penalty", 8.0),
        ("uniqueness", 100),
        ("left_right_tolerance", 0.0),
        ("least_texture", -1.0),
        ("speckle_size", -1),
        ("speckle_range", 0.0),
        ("least_disparity", 0.0),
        ("least_disparity", 128.0),
    ],
)
def test_a_parameter_out_of_range_is_named(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=name):
        StereoMatching(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_rig_without_a_baseline_is_refused(value: float) -> None:
    with pytest.raises(ConfigError, match="baseline"):
        StereoRig(CAMERA, value)
    for arguments in ((value, 1.0, 1.0), (1.0, value, 1.0), (1.0, 1.0, value)):
        with pytest.raises(ConfigError, match="positive"):
            depth_sigma(*arguments)


def test_images_that_are_no_pair_are_refused() -> None:
    grey = np.zeros((120, 300), np.uint8)
    with pytest.raises(FrameError, match=r"left image has 300 x 120 pixels, the right one 299 x 120"):
        stereo_disparity(grey, grey[:, :-1])
    with pytest.raises(FrameError, match="right image is float64"):
        stereo_disparity(grey, grey.astype(np.float64))  # type: ignore[arg-type]
    with pytest.raises(FrameError, match=r"left image is uint8 \(120, 300, 3\)"):
        stereo_disparity(np.zeros((120, 300, 3), np.uint8), grey)
    with pytest.raises(FrameError, match="narrower"):
        stereo_disparity(grey[:, :4], grey[:, :4])
    with pytest.raises(FrameError, match="the camera 300 x 120"):
        stereo_depth(grey[:100], grey[:100], RIG)


SHAPE = (80, 160)


def of(move: float, spread: float) -> float:
    return float(SIGMA_PX * move**MOVE_POWER * (SPREAD_OFFSET_PX + spread) ** SPREAD_POWER)


def test_bounds_and_pixels_without_a_disparity() -> None:
    pair = render([Layer((10, 0, 0))], SHAPE)
    disparity = np.full(SHAPE, 10.0, np.float32)
    disparity[:, :30] = 0.0
    sigma = disparity_sigma(pair.left, pair.right, disparity)
    assert sigma.dtype == np.float32
    assert (sigma[:, :30] == 0).all()
    lowest, highest = of(MOVE_RANGE_PX[0], SPREAD_RANGE_PX[0]), of(MOVE_RANGE_PX[1], SPREAD_RANGE_PX[1])
    assert ((sigma[:, 30:] >= 0.999 * lowest) & (sigma[:, 30:] <= 1.001 * highest)).all()
    # The two images of a plane that faces the camera agree: as sure as a match can be, without a spread.
    np.testing.assert_allclose(np.median(sigma[5:-5, 40:-5]), lowest, rtol=0.05)


def test_exposure_does_not_count_and_noise_does() -> None:
    pair = render([Layer((10, 0, 0))], SHAPE)
    disparity = np.full(SHAPE, 10.0, np.float32)
    inside = np.s_[5:-5, 30:-5]
    plain = disparity_sigma(pair.left, pair.right, disparity)[inside]
    darker = np.clip(pair.right.astype(int) - 20, 0, 255).astype(np.uint8)
    assert np.median(disparity_sigma(pair.left, darker, disparity)[inside]) < 1.1 * np.median(plain)
    noise = np.random.default_rng(0).normal(0.0, 12.0, SHAPE)
    noisy = np.clip(pair.right + noise, 0, 255).astype(np.uint8)
    assert np.median(disparity_sigma(pair.left, noisy, disparity)[inside]) > 1.4 * np.median(plain)
    wrong = disparity_sigma(pair.left, pair.right, disparity + 4)[inside]
    assert np.median(wrong) > 1.6 * np.median(plain)


def test_the_spread_is_that_of_the_block() -> None:
    disparity = np.full(SHAPE, 10.0, np.float32)
    disparity[:, 80:] = 12.0
    flat = np.full(SHAPE, 128, np.uint8)  # cost and curvature 0: the move is the same everywhere
    sigma = disparity_sigma(flat, flat, disparity)
    near, far = sigma[40, 80 - BLOCK // 2 : 80 + BLOCK // 2], sigma[40, [20, 76, 83, 140]]
    np.testing.assert_allclose(near / far[0], of(1, 2.0) / of(1, SPREAD_RANGE_PX[0]), rtol=1e-4)
    np.testing.assert_allclose(far, far[0])


def test_errors_of_matching_grow_with_it() -> None:
    """A plane that slopes, a nearer one before it, and noise that grows across the image."""
    shape = (160, 320)
    pair = render([Layer((8, 0.02, 0.03)), Layer((30, 0, 0), box=(120, 220, 40, 120))], shape)
    rng = np.random.default_rng(1)
    left, right = (
        np.clip(image + rng.normal(0, 1, shape) * np.linspace(0, 25, shape[1]), 0, 255).astype(np.uint8)
        for image in (pair.left, pair.right)
    )
    found = stereo_disparity(left, right, StereoMatching(disparities=64))
    sigma = disparity_sigma(left, right, found)
    there = (found > 0) & pair.visible
    error, stated = np.abs(found - pair.disparity)[there], sigma[there]
    low, high = np.quantile(stated, [0.33, 0.67])
    assert np.mean(error[stated > high]) > 1.5 * np.mean(error[stated < low])


def test_frames_state_it_in_metres_unless_they_are_told_not_to(tmp_path: Path) -> None:
    dataset = open_dataset(write(tmp_path / "rig", ["a", "b", "c"]))
    assert isinstance(dataset, StereoPairs)
    assert dataset.stated.pixel_sigma
    frame = dataset.read(0)
    measured = frame.depth_m > 0
    np.testing.assert_array_equal(frame.sigma_m > 0, measured)
    rig = StereoRig(STEREO_CAMERA, BASELINE)
    sigma_d_px = (frame.sigma_m[measured] * BASELINE * 100) / frame.depth_m[measured].astype(float) ** 2
    assert of(MOVE_RANGE_PX[0], SPREAD_RANGE_PX[0]) * 0.999 <= sigma_d_px.min()
    np.testing.assert_allclose(rig.disparity(rig.depth(np.array([7.0, 0.0]))), [7.0, 0.0], rtol=1e-6)
    assert frame.own_for(SensorConfig()).sigma_m is frame.sigma_m
    assert frame.own_for(SensorConfig(pixel_sigma=False)).sigma_m is None
    dataset.matching = replace(dataset.matching, pixel_sigma=False)
    assert not dataset.stated.pixel_sigma
    assert dataset.read(0).sigma_m is None
