"""The forward sensor model: every function that kernels use, against float64 with the exact erf."""

# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.polynomial import polynomial as exact
from numpy.typing import ArrayLike, NDArray
from oracles import forward as oracle
from oracles.forward import Noise

from taichi_mrf.sensor.forward import (
    AUTO,
    CENTRE,
    SEGMENT,
    beyond_likelihood,
    depth_of_deviation,
    deviation,
    normal_between,
    normal_density,
    normal_tail,
    surface_likelihood,
)
from taichi_mrf.sensor.noise import LEAST_SIGMA_M, TERMS
from taichi_mrf.sensor.polynomials import PixelNoise
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import I32, AnyArray, F32Array, Template, Vec5

# Written out, and not imported: these tests hold the values.
SUPPORT = 6.5

pytestmark = [pytest.mark.usefixtures("backend"), pytest.mark.compilers]

Values = NDArray[np.float64]

KINECT = Noise((0.001504, -0.00152, 0.0019))
CURVED = Noise((0.004, -0.002, 0.0025), (0.01, -0.02, 0.004))
FLAT = Noise((0.02,))
FALLING = Noise((0.03, -0.01))
"""Reaches zero at 3 m, beyond which it is clamped."""

VOXEL = 0.05

ROUNDING = 2.0**-23
"""float32."""


@ti.func
def _noise(coefficients: Template):
    noise = PixelNoise(Vec5(0.0), Vec5(0.0))
    for term in ti.static(range(TERMS)):
        noise.sigma_terms[term] = coefficients[0, term]
        noise.bias_terms[term] = coefficients[1, term]
    return noise


@ti.kernel
def _normal(low: F32Array, high: F32Array, between: F32Array, tail: F32Array, density: F32Array):
    for i in range(low.shape[0]):
        between[i] = normal_between(low[i], high[i])
        tail[i] = normal_tail(ti.abs(low[i]))
        density[i] = normal_density(low[i])


@ti.kernel
def _curves(coefficients: AnyArray, depth: F32Array, value: F32Array, rise: F32Array, sigma: F32Array):
    for i in range(depth.shape[0]):
        noise = _noise(coefficients)
        value[i] = noise.bias(depth[i])
        rise[i] = noise.bias_slope(depth[i])
        sigma[i] = noise.sigma(depth[i])


@ti.kernel
def _of_two(coefficients: AnyArray, measured: F32Array, other: F32Array, out: F32Array, which: I32):
    for i in range(measured.shape[0]):
        noise = _noise(coefficients)
        if which == 0:
            out[i] = deviation(measured[i], other[i], noise)
        elif which == 1:
            out[i] = depth_of_deviation(measured[i], other[i], noise)
        else:
            out[i] = beyond_likelihood(measured[i], other[i], noise)


@ti.kernel
def _surface(
    coefficients: AnyArray, measured: F32Array, near: F32Array, far: F32Array, voxel_size: F32Array,
    out: F32Array, mode: Template,
):  # fmt: skip
    for i in range(measured.shape[0]):
        out[i] = surface_likelihood(measured[i], near[i], far[i], _noise(coefficients), voxel_size[i], mode)


def single(*values: ArrayLike) -> list[NDArray[np.float32]]:
    """float32 arrays of one length, which both the engine and the oracle are given."""
    return [
        np.ascontiguousarray(a) for a in np.broadcast_arrays(*(np.asarray(v, np.float32) for v in values))
    ]


def coefficients_of(noise: Noise) -> NDArray[np.float32]:
    """(2, TERMS)."""
    out = np.zeros((2, TERMS), np.float32)
    out[0, : len(noise.sigma)], out[1, : len(noise.bias)] = noise.sigma, noise.bias
    return out


def rounded(noise: Noise) -> Noise:
    """With the coefficients that float32 holds."""
    return Noise(*(tuple(row.astype(float)) for row in coefficients_of(noise)))


def engine(which: int, noise: Noise, measured: ArrayLike, other: ArrayLike) -> Values:
    a, b = single(np.atleast_1d(measured), np.atleast_1d(other))
    out = np.zeros_like(a)
    _of_two(coefficients_of(noise), a, b, out, which)
    return out.astype(np.float64)


def likelihood(
    noise: Noise, measured: ArrayLike, near: ArrayLike, far: ArrayLike, voxel_size: ArrayLike, mode: int
) -> Values:
    arrays = single(measured, near, far, voxel_size)
    out = np.zeros_like(arrays[0])
    _surface(coefficients_of(noise), *arrays, out, mode)
    return out.astype(np.float64)


def test_normal_probabilities_are_those_of_the_error_function() -> None:
    x = np.concatenate([np.linspace(-10, 10, 401), [-1e-4, 0, 1e-4, -40, 40]])
    low, high = (a.reshape(-1) for a in np.meshgrid(x, x, indexing="ij"))
    low, high = single(low[low <= high], high[low <= high])
    between, tail, density = (np.zeros_like(low) for _ in range(3))
    _normal(low, high, between, tail, density)
    assert (between >= 0).all()
    assert (between[low == high] < 1e-7).all()
    # Half of what the formula may be wrong for erfc, and two units in the last place of 1/2 for float32:
    # CUDA's division is no more exact than that.
    of_a_tail = 0.75e-7 + 2 * np.spacing(np.float32(0.5))
    assert np.abs(tail - oracle.normal_between(np.abs(low), np.inf)).max() < of_a_tail
    assert np.abs(between - oracle.normal_between(low, high)).max() < 2 * of_a_tail
    np.testing.assert_allclose(density, oracle.normal_density(low), rtol=1e-4, atol=1e-12)


coefficient = st.floats(-5, 5, width=32)
five = st.lists(coefficient, min_size=TERMS, max_size=TERMS).map(tuple)
depths = st.lists(st.floats(0, 12, width=32), min_size=1, max_size=6)


def single_precision(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda x: float(np.float32(x)))


@given(five, five, depths)
def test_polynomials_their_slopes_and_the_least_sigma(
    sigma: tuple[float, ...], bias: tuple[float, ...], z: list[float]
) -> None:
    noise, (depth,) = Noise(sigma, bias), single(z)
    value, rise, least = (np.zeros_like(depth) for _ in range(3))
    _curves(coefficients_of(noise), depth, value, rise, least)
    size = exact.polyval(depth.astype(float), np.abs(bias))
    np.testing.assert_array_less(
        np.abs(value - exact.polyval(depth.astype(float), bias)), 1e-6 * size + 1e-30
    )
    derivative = exact.polyder(bias)
    size = exact.polyval(depth.astype(float), np.abs(derivative))
    error = np.abs(rise - exact.polyval(depth.astype(float), derivative))
    np.testing.assert_array_less(error, 1e-6 * size + 1e-30)
    size = exact.polyval(depth.astype(float), np.abs(sigma))
    assert (least >= np.float32(LEAST_SIGMA_M)).all()
    np.testing.assert_array_less(np.abs(least - noise.sigma_at(depth)), 1e-6 * size + 1e-9)


@pytest.mark.parametrize("noise", [KINECT, CURVED, FLAT, FALLING])
def test_deviation(noise: Noise) -> None:
    measured, depth = single(*np.random.default_rng(0).uniform(0.2, 9, (2, 2000)))
    expected = rounded(noise).deviation(measured, depth)
    np.testing.assert_allclose(engine(0, noise, measured, depth), expected, rtol=2e-5, atol=2e-3)


# Sigma is at its least there, so that its slope is 0.
@example(measured=7.0, sigmas=-7.0, sigma=(0.03125, -0.004999039544500032, 0.0), bias=(0.0, -0.046875, 0.0))
@given(
    measured=single_precision(0.2, 9),
    sigmas=st.sampled_from([-7.0, -3.0, -1.0, 0.0, 0.5, 3.0, SUPPORT]),
    sigma=st.tuples(st.floats(0.0005, 0.05), st.floats(-0.005, 0.005), st.floats(0, 0.002)),
    bias=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.003, 0.003)),
)
def test_depth_of_deviation_is_the_inverse_of_deviation(
    measured: float, sigmas: float, sigma: tuple[float, ...], bias: tuple[float, ...]
) -> None:
    """Wherever the deviation falls with depth, as it does unless a polynomial is wild."""
    noise = rounded(Noise(sigma, bias))
    around = np.linspace(0, 2 * measured + 1, 400)
    excess = measured - around - noise.bias_at(around) - sigmas * noise.sigma_at(around)
    assume((np.diff(excess) < -0.5 * np.diff(around)).all())
    depth = engine(1, noise, measured, sigmas)
    expected = noise.depth_of_deviation(measured, sigmas)
    scale = float(noise.sigma_at(expected))
    assert abs(depth[0] - expected) < 0.01 * scale + 4 * ROUNDING * measured
    if expected > 0:
        assert noise.deviation(measured, depth[0]) == pytest.approx(
            sigmas, abs=0.02 + 8 * ROUNDING * measured / scale
        )


def test_depth_of_deviation_never_lies_before_the_camera() -> None:
    assert engine(1, Noise((0.5,)), [0.4, 0.4], [3.0, 0.5]).tolist() == [0.0, pytest.approx(0.15, abs=1e-6)]


@given(
    measured=single_precision(0.05, 20),
    sigmas=st.floats(-7, 7, width=32),
    sigma=st.lists(st.floats(-1e3, 1e3, width=32), min_size=TERMS, max_size=TERMS).map(tuple),
    bias=st.lists(st.floats(-1e3, 1e3, width=32), min_size=TERMS, max_size=TERMS).map(tuple),
)
def test_depth_of_deviation_is_bounded_for_wild_polynomials(
    measured: float, sigmas: float, sigma: tuple[float, ...], bias: tuple[float, ...]
) -> None:
    noise = Noise(sigma, bias)
    depth = float(engine(1, noise, measured, sigmas)[0])
    size = exact.polyval(measured, np.abs(sigma)) * abs(sigmas) + exact.polyval(measured, np.abs(bias))
    sigma_here, bias_here = float(noise.sigma_at(measured)), float(noise.bias_at(measured))
    reach = 3 * (abs(sigmas) * sigma_here + abs(bias_here)) + 1e-5 * float(size)
    assert np.isfinite(depth)
    assert max(0.0, measured - reach) - 1e-5 <= depth <= measured + reach + 1e-5


def segment_grid(sigma: float) -> list[NDArray[np.float32]]:
    """Measured, near and far: segments of a hair to a voxel's diagonal, from 12 sigma before the
    measurement to 12 sigma behind it."""
    lengths = np.array([0.0, 1e-6, 1e-4, 0.009, 0.011, 0.1, 0.5, 1.0, 1.7]) * VOXEL
    lengths = np.concatenate([lengths, np.array([0.005, 0.0099, 0.0101, 0.05, 1.0, 5.0]) * sigma])
    offsets = np.linspace(-12, 12, 97) * sigma
    measured, offset, length = np.meshgrid([0.7, 1.9, 4.3], offsets, lengths, indexing="ij")
    near = np.maximum(measured + offset, 0.01)
    return single(measured.reshape(-1), near.reshape(-1), (near + length).reshape(-1))


RATIOS = np.geomspace(0.02, 50, 11)


@pytest.mark.parametrize("ratio", RATIOS)
def test_segment_likelihood_is_the_average_density(ratio: float) -> None:
    noise = rounded(Noise((ratio * VOXEL,)))
    measured, near, far = segment_grid(ratio * VOXEL)
    sigma = noise.sigma_at(near)
    width = (far.astype(float) - near) / sigma
    found = likelihood(noise, measured, near, far, VOXEL, SEGMENT) * sigma
    long = width > 0
    expected = oracle.normal_density(noise.deviation(measured, near))
    with np.errstate(divide="ignore", invalid="ignore"):
        averaged = noise.density_over(measured, near, far) * sigma
    expected[long] = averaged[long]
    # A probability to 3e-7, with both its bounds rounded (|x| times the density at x is 0.24 at most, and
    # a GPU may divide to 2.5 digits); on short segments the density's curvature over 0.01 sigma.
    probability = 3e-7 + 2 * 0.24 * 2.5 * ROUNDING
    tolerance = np.where(width > 0.0099, probability / np.maximum(width, 0.0099), 0.4 * 0.0101**2 / 24 + 3e-6)
    assert (np.abs(found - expected) <= tolerance).all()


@pytest.mark.parametrize("noise", [KINECT, CURVED])
@pytest.mark.parametrize("mode", [SEGMENT, CENTRE])
def test_likelihoods_with_noise_that_depends_on_depth(noise: Noise, mode: int) -> None:
    random = np.random.default_rng(1)
    around = random.uniform(0.4, 6, 5000)
    begin = np.maximum(around + random.normal(size=5000) * 4 * noise.sigma_at(around), 0.05)
    measured, near, far = single(around, begin, begin + random.uniform(0.1, 1.7, 5000) * VOXEL)
    exact_noise = rounded(noise)
    centre = 0.5 * (near.astype(float) + far)
    if mode == SEGMENT:
        expected = exact_noise.density_over(measured, near, far)
    else:
        expected = exact_noise.density_at(measured, centre)
    sigma = exact_noise.sigma_at(centre)
    # Rounding of the bias, against sigma, shifts the normal distribution.
    width = (far.astype(float) - near) / sigma if mode == SEGMENT else 1.0
    rounded_away = 0.1 + np.abs(measured - near) if mode == SEGMENT else centre
    shift = 8 * ROUNDING * rounded_away / sigma
    found = likelihood(noise, measured, near, far, VOXEL, mode)
    assert (np.abs(found - expected) * sigma <= (3e-7 + shift) / np.minimum(width, 1)).all()


@pytest.mark.parametrize("ratio", RATIOS)
def test_centre_likelihood_is_the_density_at_the_centre(ratio: float) -> None:
    noise = rounded(Noise((ratio * VOXEL,)))
    measured, near, far = segment_grid(ratio * VOXEL)
    centre = 0.5 * (near.astype(float) + far)
    found = likelihood(noise, measured, near, far, VOXEL, CENTRE) * noise.sigma_at(centre)
    expected = oracle.normal_density(noise.deviation(measured, centre))
    shift = 4 * ROUNDING * centre / noise.sigma_at(centre)  # the centre itself is rounded
    assert (np.abs(found - expected) <= 1e-6 + 0.25 * shift).all()


@pytest.mark.parametrize("ratio", RATIOS)
def test_auto_averages_where_sigma_is_less_than_a_voxel(ratio: float) -> None:
    noise = Noise((ratio * VOXEL,))
    measured, near, far = segment_grid(ratio * VOXEL)
    auto, averaged, centre = (
        likelihood(noise, measured, near, far, VOXEL, mode) for mode in (AUTO, SEGMENT, CENTRE)
    )
    np.testing.assert_array_equal(auto, averaged if ratio < 1 else centre)
    assert (averaged != centre).any()


@pytest.mark.parametrize("ratio", [0.02, 0.1, 0.5, 0.99])
@pytest.mark.parametrize("bias", [0.0, 0.03])
@pytest.mark.parametrize("mode", [SEGMENT, AUTO])
def test_segments_in_a_row_share_out_the_probability_of_their_interval(
    ratio: float, bias: float, mode: int
) -> None:
    random = np.random.default_rng(2)
    sigma = ratio * VOXEL
    for measured in random.uniform(0.5, 5, 10):
        edges = measured - bias + sigma * np.sort(random.uniform(-6, 6, 40))
        edges = single(edges[edges > 0])[0].astype(float)
        density = likelihood(Noise((sigma,), (bias,)), measured, edges[:-1], edges[1:], VOXEL, mode)
        mass = float((density * np.diff(edges)).sum())
        low, high = (measured - bias - edges[[-1, 0]]) / sigma
        shift = 8 * ROUNDING * (measured + bias) / sigma
        assert mass == pytest.approx(float(oracle.normal_between(low, high)), abs=2e-6 + 0.4 * shift)


def test_a_measurement_beyond_support_is_impossible() -> None:
    sigma = 0.01
    measured, near = 2.0, 2.0 + np.array([-1, 1]) * (SUPPORT + 0.5) * sigma
    near[0] -= 0.05  # the whole segment lies beyond
    assert likelihood(Noise((sigma,)), measured, near, near + 0.05, VOXEL, SEGMENT).tolist() == [0, 0]
    nearly = 2.0 + np.array([-1, 1]) * (SUPPORT - 0.5) * sigma
    nearly[0] -= 0.05
    assert (likelihood(Noise((sigma,)), measured, nearly, nearly + 0.05, VOXEL, SEGMENT) > 0).all()


def test_a_sigma_of_zero_or_less_is_the_least_one() -> None:
    arguments = (2.0, np.linspace(1.9, 2.1, 41), np.linspace(1.9, 2.1, 41) + 0.004, VOXEL, AUTO)
    clamped = likelihood(Noise((LEAST_SIGMA_M,)), *arguments)
    assert clamped.max() > 50
    for sigma in ((0.0,), (-0.3,), (0.02, -0.02), (0.1, 0.0, -0.05)):
        np.testing.assert_array_equal(likelihood(Noise(sigma), *arguments), clamped)


@pytest.mark.parametrize("noise", [FLAT, Noise((0.02,), (0.05,))])
def test_a_surface_beyond_is_as_likely_as_the_likeliest_there(noise: Noise) -> None:
    measured, depth = single(*np.random.default_rng(3).uniform(0.5, 5, (2, 400)))
    depth[::2] = measured[::2] + np.linspace(-0.2, 0.2, 200)
    beyond = depth.astype(float)[:, None] + np.linspace(0, 6, 6001)
    likeliest = rounded(noise).density_at(measured[:, None], beyond).max(axis=1)
    found = engine(2, noise, measured, depth)
    np.testing.assert_allclose(found, likeliest, atol=2e-3 * found.max())


def test_a_surface_beyond_has_the_sigma_of_where_it_is() -> None:
    """A map that ends at 2 m, a surface measured at 6 m: what explains it is a surface at 6 m."""
    measured, depth = 6.0, np.array([1.0, 2.0, 4.0, 5.9])
    expected = KINECT.density_at(measured, measured)
    np.testing.assert_allclose(engine(2, KINECT, measured, depth), expected, rtol=0.1)
