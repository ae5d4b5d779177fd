"""Noise models: polynomials, patches of pixels, tables from files, and what is said of bad ones."""

import dataclasses
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import (
    LEAST_SIGMA_M,
    TERMS,
    NoiseTable,
    PatchNoise,
    PolynomialNoise,
    evaluate,
    noise_from_config,
    warn_of_bad_sigma,
    without_bias,
)
from taichi_mrf.sensor.polynomials import SensorNoise
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, AnyArray

CAMERA = PinholeCamera(width=50, height=37, fx=40, fy=40, cx=24.5, cy=18)
"""With patches of 16 pixels it has 4 columns and 3 rows, the last ones cut off by the image's edge."""

KINECT_ONE = PinholeCamera(width=512, height=424, fx=365, fy=365, cx=255.5, cy=211.5)
REALSENSE = PinholeCamera(width=640, height=480, fx=615, fy=615, cx=319.5, cy=239.5)

coefficient = st.floats(-10, 10)


@kernel
def _look_up(noise: SensorNoise, width: I32, height: I32, out: AnyArray) -> None:
    for u, v in ti.ndrange(width, height):
        here = noise.at_pixel(u, v)
        for term in range(TERMS):
            out[v, u, 0, term] = here.sigma_terms[term]
            out[v, u, 1, term] = here.bias_terms[term]


def per_pixel(table: NoiseTable, camera: PinholeCamera) -> NDArray[np.float32]:
    """Terms that kernels read for each pixel, (H, W, 2, TERMS): sigma, bias."""
    out = np.full((*camera.shape, 2, TERMS), np.nan, np.float32)
    _look_up(table.sensor(camera).noise, camera.width, camera.height, out)
    return out


def numbered(patches: int, degree: int = 2, sign: float = 1) -> NDArray[np.float64]:
    """A table in which every coefficient is another number."""
    return sign * (np.arange(patches)[:, None] + np.arange(1, degree + 2) / 8)


@given(st.lists(coefficient, min_size=1, max_size=TERMS), st.lists(st.floats(0, 20), min_size=1, max_size=8))
def test_evaluate_is_the_polynomial(coefficients: list[float], depths: list[float]) -> None:
    padded = np.zeros(TERMS)
    padded[: len(coefficients)] = coefficients
    expected = polynomial.polyval(np.array(depths), coefficients)
    scale = polynomial.polyval(np.array(depths), np.abs(coefficients))
    np.testing.assert_array_less(np.abs(evaluate(padded, depths) - expected), 1e-12 * scale + 1e-12)


def test_evaluate_broadcasts_patches_against_depths() -> None:
    tables = np.random.default_rng(0).normal(size=(7, 1, TERMS))
    depths = np.linspace(0.1, 9, 13)
    values = evaluate(tables, depths[None, :])
    assert values.shape == (7, 13)
    np.testing.assert_allclose(values, [polynomial.polyval(depths, table[0]) for table in tables])


@given(
    st.lists(coefficient, min_size=1, max_size=TERMS),
    st.lists(coefficient, min_size=1, max_size=TERMS),
    st.floats(0.1, 10),
)
def test_one_polynomial_holds_for_every_pixel_and_camera(
    sigma: list[float], bias: list[float], depth: float
) -> None:
    table = PolynomialNoise(sigma, bias).table(CAMERA)
    assert table.coefficients.shape == (1, 2, TERMS)
    assert table.coefficients.dtype == np.float32
    for row, given_ in zip(table.coefficients[0], (sigma, bias), strict=True):
        scale = float(polynomial.polyval(depth, np.abs(given_)))
        assert evaluate(row.astype(np.float64), depth) == pytest.approx(
            polynomial.polyval(depth, given_), abs=1e-6 * scale + 1e-30
        )
    assert (CAMERA.height - 1) // table.patch * table.columns + (CAMERA.width - 1) // table.patch == 0


def test_without_a_bias_there_is_none() -> None:
    assert (PolynomialNoise((0.01, 0.0, 0.002)).table(CAMERA).coefficients[:, 1] == 0).all()


@pytest.mark.parametrize("patch", [1, 7, 16, 25, 37, 50, 64])
def test_kernels_find_each_pixels_patch(backend: str, patch: int) -> None:
    """At the borders of patches, and where the last patches hang over the image's edge."""
    rows, columns = -(-CAMERA.height // patch), -(-CAMERA.width // patch)
    sigma, bias = numbered(rows * columns), numbered(rows * columns, degree=4, sign=-1)
    seen = per_pixel(PatchNoise(sigma, bias, patch, CAMERA).table(CAMERA), CAMERA)
    v, u = np.indices(CAMERA.shape)
    number = np.ravel_multi_index((v // patch, u // patch), (rows, columns))
    np.testing.assert_array_equal(seen[..., 0, :3], sigma.astype(np.float32)[number])
    assert (seen[..., 0, 3:] == 0).all()
    np.testing.assert_array_equal(seen[..., 1, :], bias.astype(np.float32)[number])


def test_kernels_read_one_polynomial_for_all_pixels(backend: str) -> None:
    for camera in (CAMERA, PinholeCamera(20, 50, 40, 40, 9.5, 24.5)):
        seen = per_pixel(PolynomialNoise((0.5, 0.25), (0.125,)).table(camera), camera)
        assert (seen == np.array([[0.5, 0.25, 0, 0, 0], [0.125, 0, 0, 0, 0]], np.float32)).all()


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (
            lambda: PatchNoise(numbered(11), numbered(12), 16, CAMERA),
            "sigma table has 11 patches.* 16 make 12",
        ),
        (lambda: PatchNoise(numbered(12), numbered(13), 16, CAMERA), "bias table has 13 patches.*50 x 37"),
        (
            lambda: PatchNoise(numbered(12), numbered(12), 20, CAMERA),
            "sigma table has 12 patches.* 20 make 6",
        ),
        (lambda: PatchNoise(numbered(12, TERMS), numbered(12), 16, CAMERA), "sigma has degree 5"),
        (lambda: PatchNoise(numbered(12), np.zeros((3, 4, 3)), 16, CAMERA), r"bias must be .*\(3, 4, 3\)"),
        (lambda: PatchNoise(np.zeros(12), numbered(12), 16, CAMERA), r"sigma must be .*\(12,\)"),
        (lambda: PatchNoise(numbered(12) * np.nan, numbered(12), 16, CAMERA), "sigma .*not finite"),
        (lambda: PatchNoise(numbered(12), numbered(12) * np.inf, 16, CAMERA), "bias .*not finite"),
        (lambda: PatchNoise(numbered(12), numbered(12), 0, CAMERA), "patch"),
        (lambda: PolynomialNoise((1, 2, 3, 4, 5, 6)), "sigma has degree 5; the highest is 4"),
        (lambda: PolynomialNoise((0.1,), (0, 0, 0, 0, 0, 1)), "bias has degree 5"),
        (lambda: PolynomialNoise((0.1, float("nan"))), "sigma .*not finite"),
        (lambda: PolynomialNoise((0.1,), (float("inf"),)), "bias .*not finite"),
        (lambda: PolynomialNoise(()), "sigma must be"),
    ],
)
def test_wrong_models_are_refused_by_name(make: Callable[[], object], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_table_holds_for_the_camera_that_it_was_learnt_with() -> None:
    noise = PatchNoise(numbered(12), numbered(12), 16, CAMERA)
    same_size = PinholeCamera(50, 37, 41.0, 42.0, 25, 18)
    np.testing.assert_array_equal(noise.table(same_size).coefficients, noise.table(CAMERA).coefficients)
    with pytest.raises(ConfigError, match="learnt at 50 x 37 pixels, not 25 x 18"):
        noise.table(CAMERA.scaled(0.5))


def test_the_warning_names_the_first_bad_patch_and_counts_the_others() -> None:
    sigma = np.tile([0.02, 0.0, 0.001], (12, 1))
    sigma[6] = (0.05, -0.03, 0.0)  # row 1, column 2 of 4: below zero beyond 1.67 m
    sigma[9] = (-0.01, 0.0, 0.0)
    table = PatchNoise(sigma, np.zeros((12, 1)), 16, CAMERA).table(CAMERA)
    with pytest.warns(UserWarning, match=r"patch \(row 1, column 2\)") as caught:
        warn_of_bad_sigma(table, 0.1, 3.0)
    text = str(caught[0].message)
    assert "-0.0400 m at a depth of 3.00 m" in text
    assert f"clamped at {LEAST_SIGMA_M} m; so do 1 other patches" in text
    assert "\n" not in text


@pytest.mark.parametrize("sigma", [(0.05, -0.03), (0.0,)])
def test_a_bad_polynomial_is_warned_of_without_a_patch(sigma: tuple[float, ...]) -> None:
    with pytest.warns(UserWarning, match="sigma of the polynomial falls to"):
        warn_of_bad_sigma(PolynomialNoise(sigma).table(CAMERA), 0.1, 3.0)


def test_there_is_no_warning_for_a_good_sigma_or_beyond_the_working_range() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_bad_sigma(PolynomialNoise((0.05, -0.03)).table(CAMERA), 0.1, 1.6)
        warn_of_bad_sigma(PolynomialNoise(SensorConfig.sigma).table(CAMERA), 0.1, 10)


@pytest.mark.shared_data
@pytest.mark.parametrize(
    ("name", "camera", "patch"), [("realsense", REALSENSE, 20), ("kinect2", KINECT_ONE, 16)]
)
def test_learnt_tables_are_read_patch_by_patch_and_warned_of(
    shared_data: Path, name: str, camera: PinholeCamera, patch: int
) -> None:
    folder = shared_data / "coffin_world"
    sigma = np.load(folder / f"{name}_stddev_poly5x.npy")
    config = SensorConfig(
        sigma_table=str(folder / f"{name}_stddev_poly5x.npy"),
        bias_table=str(folder / f"{name}_bias_poly5x.npy"),
        patch=patch,
    )
    table = noise_from_config(config, camera).table(camera)
    assert (table.patch, table.columns) == (patch, -(-camera.width // patch))
    np.testing.assert_array_equal(table.coefficients[:, 0, :3], sigma)
    np.testing.assert_array_equal(table.coefficients[:, 1, :3], np.load(str(config.bias_table)))
    depths = np.linspace(0.3, 6, 100)
    bad = (polynomial.polyval(depths, sigma.astype(np.float64).T) <= 0).any(axis=1)
    assert bad.any()
    row, column = divmod(int(np.flatnonzero(bad)[0]), table.columns)
    with pytest.warns(UserWarning, match=rf"\(row {row}, column {column}\).* {bad.sum() - 1} other patches"):
        warn_of_bad_sigma(table, 0.3, 6)


def test_a_configuration_without_tables_is_a_polynomial() -> None:
    noise = noise_from_config(SensorConfig(sigma=(0.01, 0.002), bias=(0.5,)), CAMERA)
    expected = PolynomialNoise((0.01, 0.002), (0.5,)).table(CAMERA)
    np.testing.assert_array_equal(noise.table(CAMERA).coefficients, expected.coefficients)


@pytest.mark.parametrize("which", ["sigma", "bias"])
def test_one_table_goes_with_the_other_polynomial(tmp_path: Path, which: str) -> None:
    path = tmp_path / "table.npy"
    np.save(path, numbered(12).astype(np.float32))
    config = SensorConfig(sigma=(0.01, 0.002), bias=(0.5, 0.25), patch=16)
    table: dict[str, Any] = {f"{which}_table": str(path)}
    config = dataclasses.replace(config, **table)
    found = noise_from_config(config, CAMERA).table(CAMERA).coefficients
    tabled, constant = (0, 1) if which == "sigma" else (1, 0)
    np.testing.assert_array_equal(found[:, tabled, :3], numbered(12).astype(np.float32))
    other = (0.5, 0.25) if which == "sigma" else (0.01, 0.002)
    np.testing.assert_array_equal(found[:, constant, :2], np.tile(np.array(other, np.float32), (12, 1)))


def text_file(path: Path) -> None:
    path.write_text("0.1 0.2 0.3\n")


def empty_file(path: Path) -> None:
    path.touch()


def cut_short(path: Path) -> None:
    np.save(path, numbered(12))
    path.write_bytes(path.read_bytes()[:-40])


def broken_archive(path: Path) -> None:
    path.write_bytes(b"PK\x03\x04 and nothing of an archive")


def archive(path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, sigma=numbered(12))


def objects(path: Path) -> None:
    np.save(path, np.array([[{}]], dtype=object), allow_pickle=True)


def words(path: Path) -> None:
    np.save(path, np.array([["a", "b"]]))


def not_finite(path: Path) -> None:
    np.save(path, np.full((12, 3), np.nan))


def too_high_a_degree(path: Path) -> None:
    np.save(path, np.ones((12, 6)))


def absent(path: Path) -> None:
    """No file at all."""


@pytest.mark.parametrize("field", ["sigma_table", "bias_table"])
@pytest.mark.parametrize(
    "make",
    [
        text_file, empty_file, cut_short, broken_archive, archive, objects, words, not_finite,
        too_high_a_degree, absent, Path.mkdir,
    ],
)  # fmt: skip
def test_an_unreadable_table_is_named_with_its_field(
    tmp_path: Path, make: Callable[[Path], None], field: str
) -> None:
    path = tmp_path / "noise.npy"
    make(path)
    with pytest.raises(ConfigError) as caught:
        noise_from_config(SensorConfig(patch=16, **{field: str(path)}), CAMERA)  # type: ignore[arg-type]
    assert str(caught.value).startswith(f"sensor.{field}: {path}")
    assert "\n" not in str(caught.value)


def test_the_bias_is_taken_from_measurements() -> None:
    bias = numbered(12, sign=-1) * 1e-4
    table = PatchNoise(numbered(12), bias, 16, CAMERA).table(CAMERA)
    true_m = np.random.default_rng(0).uniform(0.5, 5.0, CAMERA.shape)
    measured_m = true_m + table.at_pixels(true_m)[1]
    assert np.abs(measured_m - true_m).max() > 0.01
    np.testing.assert_allclose(without_bias(measured_m, table), true_m, atol=1e-5)
    measured_m[3, 4:6] = 0.0, np.nan
    assert (without_bias(measured_m, table)[3, 4:6] == 0).all()
    unbiased = PolynomialNoise((0.01,)).table(CAMERA)
    np.testing.assert_array_equal(without_bias(true_m, unbiased), true_m)
