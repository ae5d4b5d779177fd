"""A sigma for each pixel of a stereo pair: small where images agree and have texture, large at edges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from stereo_rig import BASELINE, CAMERA, write
from stereo_scene import Layer, render

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.stereo.matching import (
    BLOCK,
    MOVE_POWER,
    MOVE_RANGE_PX,
    SIGMA_PX,
    SPREAD_OFFSET_PX,
    SPREAD_POWER,
    SPREAD_RANGE_PX,
    StereoMatching,
    StereoPairs,
    StereoRig,
    disparity_sigma,
    stereo_disparity,
)

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
    rig = StereoRig(CAMERA, BASELINE)
    sigma_d_px = (frame.sigma_m[measured] * BASELINE * 100) / frame.depth_m[measured].astype(float) ** 2
    assert of(MOVE_RANGE_PX[0], SPREAD_RANGE_PX[0]) * 0.999 <= sigma_d_px.min()
    np.testing.assert_allclose(rig.disparity(rig.depth(np.array([7.0, 0.0]))), [7.0, 0.0], rtol=1e-6)
    assert frame.own_for(SensorConfig()).sigma_m is frame.sigma_m
    assert frame.own_for(SensorConfig(pixel_sigma=False)).sigma_m is None
    dataset.matching = replace(dataset.matching, pixel_sigma=False)
    assert not dataset.stated.pixel_sigma
    assert dataset.read(0).sigma_m is None
