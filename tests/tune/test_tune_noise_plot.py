"""The curves of the noise plot of the tuning page: of polynomials, of tables, and where a table has gone."""

import html
from pathlib import Path

import numpy as np
import pytest

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import LEAST_SIGMA_M, noise_from_config
from taichi_mrf.viewer.tune.messages import Residuals
from taichi_mrf.viewer.tune.plots import NoiseCurves, plot_data, sentence

CAMERA = PinholeCamera(width=8, height=6, fx=8.0, fy=8.0, cx=3.5, cy=2.5)
DEPTH_M = np.linspace(0.5, 4.0, 7)
TABLE = np.array([[0.004, 0.0, 0.001], [0.01, -0.02, 0.003], [0.0, 0.002, 0.0], [0.05, 0.0, 0.0]])
RESIDUALS = Residuals(
    number=0,
    depth_m=DEPTH_M.astype(np.float32),
    residual_m=np.full(len(DEPTH_M), 0.002, np.float32),
    bin_m=np.array([1.0, 2.0]),
    median_m=np.array([0.001, 0.003]),
    spread_m=np.array([0.02, 0.03]),
)


@pytest.fixture
def tabled(tmp_path: Path) -> SensorConfig:
    """A table of sigma for patches of 4 pixels, four of them; the bias is a polynomial."""
    np.save(tmp_path / "sigma.npy", TABLE)
    return SensorConfig(sigma_table=str(tmp_path / "sigma.npy"), bias=(0.001, 0.002), patch=4)


def test_without_tables_the_curves_are_the_polynomials() -> None:
    curves = NoiseCurves.of(SensorConfig(sigma=(0.003, 0.0, 0.002), bias=(0.001, -0.004)))
    bias, sigma = curves.at(DEPTH_M)
    np.testing.assert_allclose(bias, 0.001 - 0.004 * DEPTH_M)
    np.testing.assert_allclose(sigma, 0.003 + 0.002 * DEPTH_M**2)
    assert curves.note == ""


def test_a_table_s_curve_is_the_mean_of_what_kernels_use_at_every_pixel(tabled: SensorConfig) -> None:
    bias, sigma = NoiseCurves.of(tabled).at(DEPTH_M)
    np.testing.assert_allclose(bias, 0.001 + 0.002 * DEPTH_M)
    values = sum(TABLE[:, i, None] * DEPTH_M**i for i in range(3))
    assert (values < LEAST_SIGMA_M).any()  # one patch is clamped
    np.testing.assert_allclose(sigma, np.maximum(values, LEAST_SIGMA_M).mean(axis=0))
    # A pixel of each patch: 8 x 6 pixels hold 2 x 2 patches of 4.
    image = noise_from_config(tabled, CAMERA).table(CAMERA)
    corners = [image.at_pixels(np.full((6, 8), depth))[0][[0, 0, 5, 5], [0, 7, 0, 7]] for depth in DEPTH_M]
    np.testing.assert_allclose(sigma, np.mean(corners, axis=1), rtol=1e-5)


def test_the_plot_holds_the_table_s_curves_and_the_text_says_so(tabled: SensorConfig) -> None:
    curves = NoiseCurves.of(tabled)
    x, *_, bias, upper, lower = plot_data(RESIDUALS, curves)
    expected_bias, expected_sigma = curves.at(x)
    np.testing.assert_allclose(bias, 1000 * expected_bias)
    np.testing.assert_allclose((upper - lower) / 2, 1000 * expected_sigma)
    said = sentence(RESIDUALS, curves)
    assert "For sigma the curves are the mean over the patches" in said
    ratio = np.median(RESIDUALS.spread_m / curves.at(RESIDUALS.bin_m)[1])
    assert f"**{ratio:.1f} times**" in said


def test_a_table_that_has_gone_leaves_the_points_and_says_why(tabled: SensorConfig) -> None:
    assert tabled.sigma_table is not None
    Path(tabled.sigma_table).unlink()
    curves = NoiseCurves.of(tabled)
    assert np.isnan(plot_data(RESIDUALS, curves)[-1]).all()
    assert "The curves are not drawn: sensor.sigma_table" in html.unescape(sentence(RESIDUALS, curves))
