"""The forward sensor model: how likely is a measurement, given where the ray meets the first surface?

Measurements are normally distributed around the depth of the surface plus a bias. ``noise`` is that of one
pixel, with the methods of polynomials.PixelNoise. All depths are in metres along the ray's direction (axial
depth for a pinhole), because that is what depth images hold and what noise is learnt in. Functions for Taichi
kernels, which reach them through model.Sensor; each is tested against a NumPy oracle.
"""

from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, Template

AUTO, SEGMENT, CENTRE = 0, 1, 2
"""The point or average of a segment that stands for its surface: see InferenceConfig.likelihood."""

SUPPORT = 6.5
"""Sigmas beyond which a measurement is impossible: a density of 3e-10 / sigma, far below any floor."""

NORMALISER = 0.3989422804014327  # 1 / sqrt(2 pi)


@ti.func
def deviation(measured: F32, depth: F32, noise: Template) -> F32:
    """Sigmas by which the measurement lies beyond what a surface at ``depth`` would give on average."""
    return (measured - depth - noise.bias(depth)) / noise.sigma(depth)


@ti.func
def depth_of_deviation(measured: F32, sigmas: F32, noise: Template) -> F32:
    """The surface depth whose measurement would deviate by ``sigmas``: the inverse of deviation().

    Newton's method from the measurement. A table may hold polynomials that have no such depth, or one
    that runs away, so each step and the whole way are bounded.
    """
    reach = 3.0 * (ti.abs(sigmas) * noise.sigma(measured) + ti.abs(noise.bias(measured)))
    depth = measured
    for _ in ti.static(range(3)):
        excess = measured - depth - noise.bias(depth) - sigmas * noise.sigma(depth)
        gradient = 1.0 + noise.bias_slope(depth) + sigmas * noise.sigma_slope(depth)
        depth += excess / ti.max(gradient, 0.3)
        depth = ti.max(measured - reach, ti.min(measured + reach, depth))
    return ti.max(depth, 0.0)


@ti.func
def normal_density(x: F32) -> F32:
    """Standard normal density."""
    return NORMALISER * ti.exp(-0.5 * x * x)


@ti.func
def normal_tail(x: F32) -> F32:
    """Standard normal probability of more than x, for x >= 0.

    Abramowitz & Stegun 7.1.26 for erfc(x / sqrt 2) / 2: absolute error below 1e-7.
    """
    z = x * 0.7071067811865476
    s = 1.0 / (1.0 + 0.3275911 * z)
    series = s * (0.254829592 + s * (-0.284496736 + s * (1.421413741 + s * (-1.453152027 + s * 1.061405429))))
    return 0.5 * series * ti.exp(-z * z)


@ti.func
def normal_between(low: F32, high: F32) -> F32:
    """Standard normal probability of [low, high], taken on the side where no digits cancel."""
    mass = 0.0
    if low >= 0.0:
        mass = normal_tail(low) - normal_tail(high)
    elif high <= 0.0:
        mass = normal_tail(-high) - normal_tail(-low)
    else:
        mass = 1.0 - normal_tail(-low) - normal_tail(high)
    return ti.max(mass, 0.0)


@ti.func
def surface_likelihood(
    measured: F32, near: F32, far: F32, noise: Template, voxel_size: F32, mode: Template
) -> F32:
    """nu of eq. 4: density of the measurement if the first surface lies between depths near and far.

    Averaged over the segment, or taken at its centre. sigma is that of the centre.
    """
    centre = 0.5 * (near + far)
    sigma = noise.sigma(centre)
    average = ti.cast(mode == SEGMENT, ti.i32)
    if ti.static(mode == AUTO):
        average = ti.cast(sigma < voxel_size, ti.i32)
    density = 0.0
    if average == 1:
        high = (measured - near - noise.bias(near)) / sigma
        low = (measured - far - noise.bias(far)) / sigma
        # On a segment of next to no length the two probabilities would cancel; there the centre is exact.
        if high - low > 1e-2:
            if low < SUPPORT and high > -SUPPORT:
                density = normal_between(low, high) / (sigma * (high - low))
        else:
            density = normal_density(0.5 * (low + high)) / sigma
    else:
        density = normal_density((measured - centre - noise.bias(centre)) / sigma) / sigma
    return density


@ti.func
def beyond_likelihood(measured: F32, depth: F32, noise: Template) -> F32:
    """Density of the measurement if the first surface lies somewhere beyond ``depth``.

    For rays that leave the map: as likely as the likeliest surface out there, which is the one that the
    measurement would show if that lies beyond, else one at ``depth``.
    """
    surface = ti.max(depth, depth_of_deviation(measured, 0.0, noise))
    return normal_density(deviation(measured, surface, noise)) / noise.sigma(surface)
