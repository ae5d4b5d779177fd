"""Words and pictures on the parts of the view that have samples, and those that lack them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_scenes import CAMERA, Planes, random_tables
from numpy.typing import NDArray

from taichi_mrf.calibration.coverage import Coverage
from taichi_mrf.calibration.fit import calibrate
from taichi_mrf.calibration.noise_pictures import central_third
from taichi_mrf.calibration.options import CalibrationConfig
from taichi_mrf.calibration.report import write_pictures
from taichi_mrf.calibration.samples import Cells
from taichi_mrf.sensor.camera import PinholeCamera

CELLS = Cells(CAMERA, CalibrationConfig(min_depth=0.5, max_depth=2.5))
"""8 x 6 patches, 20 bins of 0.1 m."""


def all_but(*missing: tuple[slice, slice, slice]) -> Coverage:
    """Coverage of everything except for (rows, columns, bins)."""
    grid = np.ones((6, 8, 20), dtype=bool)
    for where in missing:
        grid[where] = False
    return Coverage(CELLS, grid.reshape(48, 20))


ALL = slice(None)


def test_full_coverage_says_so() -> None:
    assert all_but().in_words() == ["All of the view is covered."]
    assert all_but().depth_range() == (0.5, pytest.approx(2.5))
    assert all_but().share == 1.0


def test_ends_of_the_range_are_named_for_the_whole_image() -> None:
    coverage = all_but((ALL, ALL, slice(0, 3)), (ALL, ALL, slice(15, None)))
    assert coverage.in_words() == ["Not covered in the whole image: nearer than 0.8 m, beyond 2 m."]
    assert coverage.depth_range() == (pytest.approx(0.8), pytest.approx(2.0))


def test_parts_of_the_image_are_named_with_the_depths_they_lack() -> None:
    coverage = all_but(
        (ALL, ALL, slice(18, None)),
        (slice(0, 2), slice(0, 3), slice(5, 10)),
        (slice(0, 2), slice(6, 8), slice(5, 10)),
        (slice(2, 4), slice(3, 6), ALL),
        (slice(4, 6), slice(3, 6), slice(14, None)),
    )
    assert coverage.in_words() == [
        "Not covered in the whole image: beyond 2.3 m.",
        "Not covered at the top left and top right: 1 to 1.5 m.",
        "Not covered at the centre: at any depth.",
        "Not covered at the bottom: beyond 1.9 m.",
    ]


def test_short_gaps_in_one_part_are_not_worth_a_word() -> None:
    coverage = all_but((slice(0, 2), slice(0, 3), slice(5, 7)))
    assert coverage.in_words() == ["All of the view is covered."]


def test_images_of_one_patch_have_no_parts_to_name() -> None:
    cells = Cells(PinholeCamera(16, 16, 20, 20, 8, 8), CalibrationConfig())
    assert Coverage(cells, np.ones((1, cells.bins), dtype=bool)).in_words() == ["All of the view is covered."]


def pixels(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path))
    assert image is not None
    return image


@pytest.mark.usefixtures("full_pictures")
@pytest.mark.parametrize(("nearest", "furthest"), [(0.6, 3.5), (1.0, 1.9)])
def test_pictures_show_what_was_learnt(tmp_path: Path, nearest: float, furthest: float) -> None:
    tables = random_tables(48, 20, np.random.default_rng(0))
    noise = calibrate(Planes(tables, 30, nearest, furthest), CAMERA, CalibrationConfig()).noise
    paths = write_pictures(tmp_path, noise, Coverage(noise.cells, noise.covered))
    assert [path.name for path in paths] == ["noise_curves.png", "noise_maps.png", "coverage.png"]
    for path in paths:
        image = pixels(path)
        assert min(image.shape[:2]) > 400
        assert image.std() > 10
    coverage = pixels(tmp_path / "coverage.png").astype(int)
    lacking = (coverage[..., 2] > 140) & (coverage[..., :2].max(axis=-1) < 60)  # the red of no samples
    assert lacking.mean() > 0.02


def test_the_centre_is_the_middle_third_of_rows_and_columns() -> None:
    noise = calibrate(
        Planes(random_tables(48, 20, np.random.default_rng(0)), 20, 0.6, 3.5), CAMERA, CalibrationConfig()
    ).noise
    rows, columns = np.divmod(np.flatnonzero(central_third(noise)), 8)
    assert set(rows) == {2, 3}
    assert set(columns) == {3, 4}
