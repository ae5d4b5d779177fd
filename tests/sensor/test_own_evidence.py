"""A sigma for each pixel: what arguments mean, what a confidence becomes, and the same noise in kernels."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plugged_noise import PixelNoise, SquareNoise

from taichi_mrf.errors import ConfigError, KeyframeError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import NoiseModel, PatchNoise, PolynomialNoise, WidenedNoise
from taichi_mrf.sensor.own_evidence import OwnEvidence, checked_evidence, sigma_of_confidence
from taichi_mrf.sensor.polynomials import SensorNoise
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.types import F32Array2, F32Array3

# Written out, and not imported: these tests hold the values.
LEAST_SIGMA_M = 0.001

CAMERA = PinholeCamera(20, 12, 20.0, 20.0, 9.5, 5.5)
PATCHES = PatchNoise(
    np.random.default_rng(0).uniform(0.01, 0.02, (6, 3)), np.full((6, 2), 0.005), patch=8, camera=CAMERA
)
OF_PIXELS = PixelNoise(np.linspace(0.005, 0.03, 240, dtype=np.float32).reshape(CAMERA.shape))
MODELS = {
    "polynomials": PATCHES,
    "square": SquareNoise(0.01, 0.004, 0.005),
    "of pixels": OF_PIXELS,
    "widened": WidenedNoise(OF_PIXELS, np.array([0.004, 1.5])),
}
every_model = pytest.mark.parametrize("noise", MODELS.values(), ids=MODELS)


def depths() -> NDArray[np.float32]:
    return np.random.default_rng(1).uniform(0.5, 4.0, CAMERA.shape).astype(np.float32)


def sigmas() -> NDArray[np.float32]:
    """Between 5 mm and 20 cm; 0 for the model's at some pixels."""
    rng = np.random.default_rng(2)
    sigma = np.exp(rng.uniform(np.log(0.005), np.log(0.2), CAMERA.shape))
    return np.where(rng.random(CAMERA.shape) < 0.3, 0.0, sigma).astype(np.float32)


@every_model
def test_sigma_holds_where_measured_follows_the_models_law_and_leaves_the_bias(noise: NoiseModel) -> None:
    depth, sigma = depths(), sigmas()
    model = noise.table(CAMERA)
    table = OwnEvidence(None, sigma).noise_model(noise, depth).table(CAMERA)
    for factor in (1.0, 0.8, 1.5):
        found, bias = table.at_pixels(factor * depth)
        of_model, bias_of_model = model.at_pixels(factor * depth)
        at_measured = model.at_pixels(depth)[0]
        expected = np.where(sigma > 0, sigma * of_model / at_measured, of_model)
        np.testing.assert_allclose(found, np.maximum(expected, LEAST_SIGMA_M), rtol=1e-5)
        np.testing.assert_array_equal(bias, bias_of_model)
    largest, _ = table.largest(np.array([1.0, 4.0]))
    for bound, z in zip(largest, (1.0, 4.0), strict=True):
        assert bound >= table.at_pixels(np.full(CAMERA.shape, z))[0].max()


@kernel
def _noise_at(noise: SensorNoise, depth: F32Array2, out: F32Array3) -> None:
    for v, u in depth:
        here, z = noise.at_pixel(u, v), depth[v, u]
        out[v, u, 0] = here.sigma(z)
        out[v, u, 1] = here.bias(z)
        out[v, u, 2] = here.sigma_slope(z)


@pytest.mark.usefixtures("backend")
@every_model
def test_kernels_read_the_same_noise(noise: NoiseModel) -> None:
    depth = depths()
    table = OwnEvidence(None, sigmas()).noise_model(noise, depth).table(CAMERA)
    out = np.zeros((*CAMERA.shape, 3), np.float32)
    _noise_at(table.sensor(CAMERA).noise, depth, out)
    sigma, bias = table.at_pixels(depth)
    np.testing.assert_allclose(out[..., 0], sigma, rtol=1e-5)
    np.testing.assert_allclose(out[..., 1], bias, rtol=1e-5)
    slope = (table.at_pixels(depth + 1e-3)[0] - table.at_pixels(depth - 1e-3)[0]) / 2e-3
    np.testing.assert_allclose(out[..., 2], slope, rtol=1e-3, atol=1e-6)


def test_the_content_of_a_widened_noise_is_that_of_its_model_and_law() -> None:
    """Keyframes are sorted by it, so that it may not tell one object from another."""

    def widened(added_m: float) -> OwnEvidence:
        patches = PatchNoise(PATCHES.sigma, PATCHES.bias, 8, CAMERA)
        return OwnEvidence(WidenedNoise(patches, np.array([added_m, 2.0])))

    first, again, other = map(widened, (0.01, 0.01, 0.02))
    assert first.content() == again.content()
    assert first.content() not in (other.content(), OwnEvidence(PATCHES).content())


@pytest.mark.parametrize("sigma_m", [0.0, np.inf, np.nan])
def test_a_sigma_that_no_factor_changes_is_refused(sigma_m: float) -> None:
    """Where nothing was measured, or nothing is stated, it may be anything."""
    depth, stated = np.full(CAMERA.shape, 2.0, np.float32), np.full(CAMERA.shape, 0.05, np.float32)
    of_model = np.full(CAMERA.shape, 0.01, np.float32)
    of_model[:, :3] = sigma_m
    noise = PixelNoise(of_model)
    why = rf"sigma of 36 pixels cannot be scaled: it is {sigma_m:g} m at a depth of 2 m; let at_pixels of "
    with pytest.raises(ConfigError, match=why):
        OwnEvidence(None, stated).noise_model(noise, depth).table(CAMERA)
    with pytest.raises(ConfigError, match=why):
        OwnEvidence(pose_covariance=0.01 * np.eye(6)).noise_model(noise, depth).table(CAMERA)
    stated[:, :3] = 0.0
    found, _ = OwnEvidence(None, stated).noise_model(noise, depth).table(CAMERA).at_pixels(depth)
    np.testing.assert_allclose(found[:, 3:], 0.05, rtol=1e-6)


def test_a_model_without_sigma_is_clamped_before_it_is_scaled() -> None:
    falling = PolynomialNoise((0.01, -0.02))  # negative from 0.5 m on
    table = OwnEvidence(None, np.full(CAMERA.shape, 0.05, np.float32)).noise_model(falling, depths())
    np.testing.assert_allclose(table.table(CAMERA).at_pixels(depths())[0], 0.05, rtol=1e-5)


def test_what_the_values_mean() -> None:
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    depth[5] = 0.0
    sigma = np.full(CAMERA.shape, 0.03)
    sigma[0], sigma[1], sigma[2], sigma[3], sigma[4] = 0.0, -1.0, np.nan, np.inf, 1e-9
    measured, own = checked_evidence(depth, CAMERA, None, sigma)
    assert own.sigma_m is not None
    assert (measured[[3, 5]] == 0).all()
    assert (np.delete(measured, [3, 5], axis=0) == 2.0).all()
    assert (own.sigma_m[[0, 1, 2, 3, 5]] == 0).all()
    assert (own.sigma_m[4] == np.float32(LEAST_SIGMA_M)).all()
    assert (own.sigma_m[6:] == np.float32(0.03)).all()
    assert checked_evidence(depth, CAMERA, None, None)[1].content() == b""


def test_bad_arguments_are_refused() -> None:
    depth = depths()
    with pytest.raises(KeyframeError, match=r"sigma_m must be .* shape \(12, 20\), not float64 \(3,\)"):
        checked_evidence(depth, CAMERA, None, np.zeros(3))
    with pytest.raises(KeyframeError, match="not int64"):
        checked_evidence(depth, CAMERA, None, np.ones(CAMERA.shape, np.int64))
    with pytest.raises(KeyframeError, match="noise must be a noise model"):
        checked_evidence(depth, CAMERA, 0.1, None)  # type: ignore[arg-type]


def test_a_confidence_divides_the_models_sigma_within_bounds() -> None:
    depth = depths()
    share = np.linspace(-0.2, 1.2, depth.size).reshape(depth.shape)
    share[0, 0], share[0, 1] = np.nan, 0.0
    sigma = sigma_of_confidence(share, depth, PATCHES, CAMERA, least=0.25)
    model = PATCHES.table(CAMERA).at_pixels(depth)[0]
    assert np.isposinf(sigma[~(share > 0)]).all()
    for chosen, factor in (
        (share >= 1, 1.0),
        ((share > 0) & (share < 0.25), 4.0),
        ((share >= 0.25) & (share <= 1), 1 / np.clip(share, 0.25, 1)),
    ):
        expected = (model * factor)[chosen]
        assert len(expected) > 0
        np.testing.assert_allclose(sigma[chosen], expected, rtol=1e-6)
    with pytest.raises(ConfigError, match="least must be above 0"):
        sigma_of_confidence(share, depth, PATCHES, CAMERA, least=0.0)
    with pytest.raises(ConfigError, match="of the shape"):
        sigma_of_confidence(share[:3], depth, PATCHES, CAMERA)
