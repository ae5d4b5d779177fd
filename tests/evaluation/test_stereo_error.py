"""The measured error of disparities: against errors that were put in, and on real pairs with ground truth."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from datasets_recordings import write_image
from stereo_scene import Layer, render

from taichi_mrf.config.schema import load
from taichi_mrf.datasets.stereo.matching import SIGMA_D_PX, StereoMatching, depth_sigma
from taichi_mrf.errors import DatasetError, FrameError
from taichi_mrf.evaluation.stereo_error import (
    TruePair,
    measure,
    pooled_disparity_error,
    read_middlebury,
)

NAMES = ("view1", "view5", "disp1", "disp5")


def test_the_errors_that_were_put_in_come_out() -> None:
    random = np.random.default_rng(0)
    true = random.uniform(10, 60, (400, 500))
    measured = true + 0.1 + 0.3 * random.standard_normal(true.shape)
    wild = random.random(true.shape) < 0.02
    measured[wild] += 20
    measured[random.random(true.shape) < 0.25] = 0
    true[random.random(true.shape) < 0.1] = 0
    visible = random.random(true.shape) < 0.5
    error = pooled_disparity_error([(measured, true, visible)])
    assert error.pixels == np.count_nonzero((measured > 0) & (true > 0))
    assert error.completeness == pytest.approx(0.75, abs=0.01)
    assert error.outliers == pytest.approx(0.02, abs=0.002)
    assert error.bias == pytest.approx(0.1, abs=0.005)
    assert error.sigma_std == pytest.approx(0.3, rel=0.02)
    assert error.sigma_mad == pytest.approx(0.3, rel=0.05)  # the outliers widen it a little


def test_pooling_is_over_pixels_and_completeness_over_what_both_cameras_see() -> None:
    true = np.full((2, 4), 10.0)
    good, wild = true + np.array([0, 1, 0, 1]), true + 7
    seen, half = np.ones(true.shape, bool), np.arange(8).reshape(2, 4) < 4
    empty = np.zeros_like(true)
    pooled = pooled_disparity_error([(good, true, seen), (wild, true, half), (empty, true, half)])
    assert pooled.pixels == 16
    assert pooled.outliers == pytest.approx(0.5)
    assert pooled.completeness == pytest.approx(12 / 16)
    assert (pooled.bias, pooled.sigma_std) == (pytest.approx(0.5), pytest.approx(0.5))


def test_nothing_to_compare_is_nan_and_not_zero() -> None:
    empty, some = np.zeros((3, 4)), np.ones((3, 4))
    seen = np.ones((3, 4), bool)
    nothing = pooled_disparity_error([])
    assert nothing.pixels == 0
    assert np.isnan([nothing.completeness, nothing.outliers, nothing.bias, nothing.sigma_std]).all()
    unmatched = pooled_disparity_error([(empty, some, seen)])
    assert unmatched.completeness == 0
    assert np.isnan([unmatched.outliers, unmatched.sigma_std, unmatched.sigma_mad]).all()
    wild = pooled_disparity_error([(some + 50, some, seen)])
    assert (wild.completeness, wild.outliers) == (1, 1)
    assert np.isnan([wild.bias, wild.sigma_std, wild.sigma_mad]).all()


def test_images_of_different_shapes_are_refused() -> None:
    with pytest.raises(FrameError, match=r"\(3, 4\), \(4, 3\) and \(3, 4\)"):
        pooled_disparity_error([(np.ones((3, 4)), np.ones((4, 3)), np.ones((3, 4), bool))])


def test_a_rendered_pair_in_middlebury_layout(tmp_path: Path) -> None:
    pair = render([Layer((12, 0, 0)), Layer((32.5, 0, 0), (120, 200, 30, 90))])
    from_right = np.full(pair.left.shape, 12.0)
    from_right[30:90, 88:167] = 32.5
    for name, image in zip(NAMES, (pair.left, pair.right, 2 * pair.disparity, 2 * from_right), strict=True):
        write_image(tmp_path / f"{name}.png", image.astype(np.uint8))
    true_pair = read_middlebury(tmp_path)
    np.testing.assert_array_equal(true_pair.left, pair.left)
    np.testing.assert_array_equal(true_pair.right, pair.right)
    np.testing.assert_array_equal(true_pair.left_px, pair.disparity)
    assert (true_pair.visible() == pair.visible).mean() > 0.995  # the columns at the box's edges differ
    error = measure([true_pair])
    assert error.completeness > 0.95
    assert error.outliers < 0.01
    assert error.sigma_std < SIGMA_D_PX


def test_a_broken_middlebury_folder_is_named(tmp_path: Path) -> None:
    for name in NAMES:
        write_image(tmp_path / f"{name}.png", np.zeros((10, 20), np.uint8))
    write_image(tmp_path / "disp5.png", np.zeros((10, 21), np.uint8))
    with pytest.raises(FrameError, match=f"{tmp_path.name}: .*not of one size"):
        read_middlebury(tmp_path)
    (tmp_path / "view5.png").unlink()
    with pytest.raises(DatasetError, match=r"view5\.png: the image is missing"):
        read_middlebury(tmp_path)


@pytest.fixture(scope="module")
def middlebury(shared_data: Path) -> dict[str, TruePair]:
    return {name: read_middlebury(shared_data / "stereo_middlebury" / name) for name in ("Wood2", "Cloth3")}


def warp_difference(pair: TruePair, disparity_px: np.ndarray) -> float:
    """Mean grey difference of the left image to the right one, shifted by a disparity, where both see."""
    rows, columns = np.indices(pair.left.shape, dtype=np.float32)
    shifted = cv2.remap(pair.right, (columns - disparity_px).astype(np.float32), rows, cv2.INTER_LINEAR)
    seen = pair.visible()
    return float(np.abs(shifted[seen].astype(float) - pair.left[seen]).mean())


@pytest.mark.shared_data
def test_the_true_disparities_warp_one_view_into_the_other(middlebury: dict[str, TruePair]) -> None:
    """view1 is the left one, and the files count half pixels."""
    for pair in middlebury.values():
        right_one = warp_difference(pair, pair.left_px)
        assert right_one < 4
        for wrong in (-pair.left_px, 2 * pair.left_px, 2 / 3 * pair.left_px):
            assert warp_difference(pair, wrong) > 1.5 * right_one


@pytest.mark.shared_data
def test_sigma_d_is_what_middlebury_gives(middlebury: dict[str, TruePair]) -> None:
    pooled = measure(middlebury.values())
    assert pooled.sigma_std == pytest.approx(SIGMA_D_PX, rel=0.05)
    assert pooled.sigma_mad == pytest.approx(SIGMA_D_PX, rel=0.1)
    assert pooled.outliers < 0.01
    assert pooled.completeness > 0.97
    for name, pair in middlebury.items():
        alone = measure([pair])
        assert alone.sigma_std == pytest.approx(SIGMA_D_PX, rel=0.1), name
        assert alone.outliers < 0.01, name


@pytest.mark.shared_data
def test_the_left_right_check_takes_gross_errors_out(middlebury: dict[str, TruePair]) -> None:
    unchecked = measure(middlebury.values(), StereoMatching(left_right_tolerance=1000.0))
    assert measure(middlebury.values()).outliers < 0.8 * unchecked.outliers


def test_the_stereo_configuration_holds_the_measured_lambda(repository: Path) -> None:
    sigma = load(repository / "configs" / "stereo.yaml").sensor.sigma
    np.testing.assert_allclose(sigma, depth_sigma(SIGMA_D_PX, baseline_m=0.5372, fx=707.1), rtol=1e-3)
