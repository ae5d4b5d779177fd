"""The round trip: known tables, simulated data, learnt tables; agreement is judged by their own errors."""

import numpy as np
import pytest
from calibration_scenes import CAMERA, Planes, Tables, random_tables
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from taichi_mrf.calibration.fit import Calibration, LearntNoise, calibrate
from taichi_mrf.calibration.least_squares import Curves, kept_above
from taichi_mrf.calibration.options import HIGHEST_DEGREE, CalibrationConfig
from taichi_mrf.calibration.pairs import DepthPair
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import TERMS

PATCHES = 48
NEAREST, FURTHEST = 0.6, 3.5
INSIDE = np.linspace(0.7, 3.3, 27)
"""Depths that the planes cover in every patch."""


def distances(curves: Curves, truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared Mahalanobis distance of each patch's coefficients from the truth: chi-square of as many
    degrees of freedom as there are coefficients, if the covariances are right."""
    off = curves.coefficients - truth
    return np.einsum("pi,pij,pj->p", off, np.linalg.inv(curves.covariance), off)


def assert_chi_square(values: NDArray[np.float64], freedom: int) -> None:
    """The sum of independent chi-square values within four of its standard deviations."""
    n = freedom * len(values)
    assert values.sum() == pytest.approx(n, abs=4 * np.sqrt(2 * n))


def assert_close(curves: Curves, truth: NDArray[np.float64], depths: NDArray[np.float64]) -> None:
    """Within 5% or 1 mm of the truth, whichever is more."""
    expected = polyval(depths, truth.T)
    assert (np.abs(curves.at(depths) - expected) <= np.maximum(0.05 * np.abs(expected), 1e-3)).all()


@pytest.fixture(scope="module")
def tables() -> Tables:
    return random_tables(PATCHES, 20, np.random.default_rng(1))


@pytest.fixture(scope="module")
def calibration(tables: Tables) -> Calibration:
    return calibrate(Planes(tables, 150, NEAREST, FURTHEST), CAMERA, CalibrationConfig())


@pytest.mark.parametrize("name", ["bias", "sigma"])
def test_learnt_tables_agree_with_the_known_ones_within_their_standard_errors(
    calibration: Calibration, tables: Tables, name: str
) -> None:
    curves, truth = getattr(calibration.noise, name), getattr(tables, name)
    assert calibration.noise.own.all()
    assert_chi_square(distances(curves, truth), freedom=3)
    z = (curves.at(INSIDE) - polyval(INSIDE, truth.T)) / curves.standard_error(INSIDE)
    # Depths of one patch hang together: no more than 48 x 3 of the 48 x 27 values are independent.
    assert np.mean(np.abs(z) < 1) == pytest.approx(0.683, abs=4 * np.sqrt(0.683 * 0.317 / (PATCHES * 3)))
    assert np.abs(z).max() < 4.5
    assert np.abs(z.mean(axis=0)).max() < 4.5 / np.sqrt(PATCHES)
    assert_close(curves, truth, INSIDE)


def test_the_bins_follow_the_polynomials(calibration: Calibration) -> None:
    misfit, bins = calibration.noise.misfit, calibration.noise.covered.sum(axis=1)
    assert np.mean(misfit) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (bins - 3).sum()))


def test_a_wrong_degree_shows_as_misfit(tables: Tables) -> None:
    line = calibrate(Planes(tables, 80, NEAREST, FURTHEST), CAMERA, CalibrationConfig(degree=1))
    assert np.median(line.noise.misfit) > 4
    quartic = calibrate(Planes(tables, 80, NEAREST, FURTHEST), CAMERA, CalibrationConfig(degree=4))
    padded = np.pad(tables.bias, ((0, 0), (0, 2)))
    assert_chi_square(distances(quartic.noise.bias, padded), freedom=5)


def test_wide_bins_do_not_blur_a_steep_sigma() -> None:
    steep = Tables(np.tile([0.001, -0.004, 0.006], (PATCHES, 1)), np.tile([0, 0.02], (PATCHES, 1)), 20)
    options = CalibrationConfig(bin_width=0.3)
    noise = calibrate(Planes(steep, 100, NEAREST, FURTHEST), CAMERA, options).noise
    assert_chi_square(distances(noise.sigma, steep.sigma), freedom=3)
    assert_chi_square(distances(noise.bias, np.pad(steep.bias, ((0, 0), (0, 1)))), freedom=3)


class WithOutliers:
    """Planes of which some pixels measure anything at all."""

    def __init__(self, planes: Planes, share: float) -> None:
        self.names, self._planes, self._share = planes.names, planes, share

    def read(self, name: str) -> DepthPair:
        pair, random = self._planes.read(name), np.random.default_rng([9, int(name)])
        wild = random.random(pair.measured_m.shape) < self._share
        measured = np.where(wild, random.uniform(0.2, 6, wild.shape), pair.measured_m)
        return DepthPair(name, measured.astype(np.float32), pair.true_m)


def test_wild_pixels_are_left_out(tables: Tables) -> None:
    source = WithOutliers(Planes(tables, 100, NEAREST, FURTHEST), 0.03)
    learnt = calibrate(source, CAMERA, CalibrationConfig())
    assert learnt.outliers / learnt.samples == pytest.approx(0.03, abs=0.003)
    for name in ("bias", "sigma"):
        assert_close(getattr(learnt.noise, name), getattr(tables, name), INSIDE)


class Masked:
    """Planes of which a patch, by its number, sees only some depths."""

    def __init__(self, planes: Planes, seen: dict[int, tuple[float, float]]) -> None:
        self.names, self._planes, self._seen = planes.names, planes, seen
        v, u = np.indices(CAMERA.shape)
        self._patch = v // 20 * 8 + u // 20

    def read(self, name: str) -> DepthPair:
        pair = self._planes.read(name)
        true = pair.true_m.copy()
        for patch, (near, far) in self._seen.items():
            true[(self._patch == patch) & ~((true >= near) & (true <= far))] = 0
        return DepthPair(name, pair.measured_m, true)


def test_patches_with_too_little_data_borrow_from_their_neighbours(tables: Tables) -> None:
    nothing, little = (0, 9, 10, 47), (20, 30)
    seen = {**dict.fromkeys(nothing, (9.0, 9.0)), **dict.fromkeys(little, (1.0, 1.6))}
    learnt = calibrate(Masked(Planes(tables, 120, NEAREST, FURTHEST), seen), CAMERA, CalibrationConfig())
    noise = learnt.noise
    np.testing.assert_array_equal(np.flatnonzero(~noise.own), sorted(seen))
    for curves, truth in ((noise.bias, tables.bias), (noise.sigma, tables.sigma)):
        z = (curves.at(INSIDE) - polyval(INSIDE, truth.T)) / curves.standard_error(INSIDE)
        # They differ from their neighbours as these from one another, and their errors say so.
        assert np.abs(z[~noise.own]).max() < 4
        error = curves.standard_error(INSIDE)
        assert (error[list(nothing)] > 5 * np.median(error[noise.own], axis=0)).all()
        own_range = (INSIDE >= 1.0) & (INSIDE <= 1.6)
        assert (error[list(little)][:, own_range] < 0.4 * error[9, own_range]).all()
        assert_close(
            Curves(curves.coefficients[noise.own], curves.covariance[noise.own]), truth[noise.own], INSIDE
        )
        assert_close(
            Curves(curves.coefficients[list(little)], curves.covariance[list(little)]),
            truth[list(little)],
            INSIDE[own_range],
        )


def test_with_few_good_patches_the_others_share_one_curve(tables: Tables) -> None:
    seen = dict.fromkeys(range(3, PATCHES), (1.0, 1.25))
    noise = calibrate(Masked(Planes(tables, 120, NEAREST, FURTHEST), seen), CAMERA, CalibrationConfig()).noise
    np.testing.assert_array_equal(np.flatnonzero(noise.own), [0, 1, 2])
    assert (noise.bias.coefficients[3:] == noise.bias.coefficients[3]).all()
    assert not (noise.bias.coefficients[0] == noise.bias.coefficients[3]).any()
    spread = polyval(1.1, tables.bias.T).std()
    expected = polyval(1.1, tables.bias.mean(axis=0))
    assert noise.bias.at([1.1])[3, 0] == pytest.approx(expected, abs=3 * spread / np.sqrt(PATCHES - 3))


def test_sigma_stays_positive_over_the_whole_working_range() -> None:
    steep = Tables(np.tile([-0.004, 0.006, 0.001], (PATCHES, 1)), np.zeros((PATCHES, 1)), 20)
    options = CalibrationConfig(min_depth=0.3, max_depth=4.0, least_sigma=5e-4)
    noise = calibrate(Planes(steep, 100, 1.2, 3.5), CAMERA, options).noise
    assert noise.lifted.all()
    depths = np.linspace(0.3, 4.0, 500)
    assert noise.sigma.at(depths).min() > 0.99 * 5e-4
    covered = np.linspace(1.3, 3.3, 20)
    assert_close(noise.sigma, steep.sigma, covered)


def test_lifting_moves_a_curve_least_where_it_is_known_best() -> None:
    curve = Curves(np.array([[-0.002, 0.004, 0.0]]), np.diag([4e-6, 1e-6, 1e-8])[None])
    lifted, changed = kept_above(curve, 1e-3, 0.0, 2.0)
    assert changed.all()
    # The curve is too low at depth 0 first of all, and there the constant alone can help.
    np.testing.assert_allclose(lifted.coefficients[0], [1e-3, 0.004, 0.0], atol=2e-5)
    same, changed = kept_above(Curves(np.array([[0.01, 0.0, 0.001]]), curve.covariance), 1e-3, 0.0, 2.0)
    assert not changed.any()
    np.testing.assert_array_equal(same.coefficients, [[0.01, 0.0, 0.001]])


def test_curves_in_metres_are_the_same_curves() -> None:
    random = np.random.default_rng(2)
    root = random.standard_normal((4, 3, 3))
    scaled = Curves(random.standard_normal((4, 3)), root @ np.swapaxes(root, 1, 2))
    metres = scaled.in_metres(0.5, 4.5)
    depth = np.array([0.5, 1.0, 3.3])
    np.testing.assert_allclose(metres.at(depth), scaled.at((depth - 2.5) / 2))
    np.testing.assert_allclose(metres.standard_error(depth), scaled.standard_error((depth - 2.5) / 2))


def test_too_few_samples_are_an_error_that_counts_them(tables: Tables) -> None:
    one_depth = Planes(tables, 3, 1.0, 1.01)
    with pytest.raises(DatasetError, match=r"too few samples: [\d,]+ pixels .* polynomial of degree 4 needs"):
        calibrate(one_depth, CAMERA, CalibrationConfig(degree=4, bin_width=0.5))
    with pytest.raises(DatasetError, match=r"too few samples.* only 0 depth bins"):
        calibrate(one_depth, CAMERA, CalibrationConfig(least_count=10**6))


def test_images_without_measurements_are_an_error(tables: Tables) -> None:
    class Blank(Planes):
        def read(self, name: str) -> DepthPair:
            pair = super().read(name)
            return DepthPair(name, np.zeros_like(pair.measured_m), pair.true_m)

    with pytest.raises(DatasetError, match="none of the 3 depth images contains a measurement"):
        calibrate(Blank(tables, 3, 1, 2), CAMERA, CalibrationConfig())
    with pytest.raises(DatasetError, match=r"no pixel of the 3 images .* from 8 to 9 m"):
        calibrate(Planes(tables, 3, 1, 2), CAMERA, CalibrationConfig(min_depth=8, max_depth=9))


def test_the_highest_degree_is_what_kernels_have_room_for() -> None:
    assert HIGHEST_DEGREE == TERMS - 1


@pytest.mark.parametrize(
    ("field", "value"),
    [("patch", 0), ("degree", 5), ("max_depth", 0.1), ("bin_width", 0.0), ("least_span", 2.0)],
)
def test_options_out_of_range_are_named(field: str, value: float) -> None:
    with pytest.raises(ConfigError, match=field):
        CalibrationConfig(**{field: value})


@pytest.mark.shared_data
@pytest.mark.slow
def test_the_tables_of_a_real_camera_are_learnt_again(shared_data) -> None:  # noqa: ANN001
    """768 patches of a RealSense D435, where the simulated sigma is what the table says."""
    folder = shared_data / "coffin_world"
    tables = Tables(
        np.load(folder / "realsense_stddev_poly5x.npy").astype(np.float64),
        np.load(folder / "realsense_bias_poly5x.npy").astype(np.float64),
        20,
    )
    camera = PinholeCamera(width=640, height=480, fx=615, fy=615, cx=319.5, cy=239.5)
    least = 1e-3
    source = Planes(tables, 60, NEAREST, FURTHEST, camera, least_sigma=least)
    noise: LearntNoise = calibrate(source, camera, CalibrationConfig()).noise
    simulated = polyval(np.linspace(0.3, 5, 95), tables.sigma.T).min(axis=1) > least
    assert simulated.sum() > 500
    for curves, truth in ((noise.bias, tables.bias), (noise.sigma, tables.sigma)):
        assert_chi_square(distances(curves, truth)[simulated], freedom=3)
        learnt = Curves(curves.coefficients[simulated], curves.covariance[simulated])
        assert_close(learnt, truth[simulated], INSIDE)
