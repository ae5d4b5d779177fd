"""wavemap's measurement model (Reijgwart et al., RSS 2023) in float64 NumPy: every voxel against every beam.

Written from the paper's equations, and not from the kernels.
"""

import math

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.sections import WavemapConfig

Array = NDArray[np.float64]


def cumulative(t: Array) -> Array:
    """The distribution of the sum of three numbers drawn evenly from -1 to 1."""
    t = np.clip(t, -3.0, 3.0)
    low, middle, high = (3 + t) ** 3 / 48, 0.5 + t * (3 + t) * (3 - t) / 24, 1 - (3 - t) ** 3 / 48
    return np.where(t < -1, low, np.where(t > 1, high, middle))


def change(distance: Array, measured: Array, angle: Array, config: WavemapConfig, voxel_size: float) -> Array:
    """Log-odds that beams add to points, without a limit on how far these are."""
    sigma = config.range_sigma or max(voxel_size / 2, 0.05)
    f, g = (distance - measured) / sigma, angle / math.radians(config.angle_sigma_deg)
    r = cumulative(f) - cumulative(f - 3) / 2 - 0.5
    w = np.ones_like(g) if config.beams == "ray" else cumulative(g + 3) - cumulative(g - 3)
    x = r * w
    p = 0.5 + x * np.where(x < 0, config.scaling_free, config.scaling_occupied)
    return np.log(p / (1 - p))


def scan_change(
    centres_m: Array, T: Array, points_m: Array, config: WavemapConfig, voxel_size: float, max_range: float
) -> Array:
    """Log-odds that a scan adds to voxels: centres (N, 3) in the world, points (M, 3) measured in the
    sensor's frame. Distances and angles of six sigma and ``max_range`` bound it. NaN for voxels so near such
    a bound, or to a tie between beams, that rounding decides."""
    sigma, reach = config.range_sigma or max(voxel_size / 2, 0.05), 6 * math.radians(config.angle_sigma_deg)
    measured = np.linalg.norm(points_m, axis=1)
    beams = points_m / measured[:, None]
    ways = (centres_m - T[:3, 3]) @ T[:3, :3]
    distance = np.linalg.norm(ways, axis=1)
    most = 4 if config.beams == "neighbours" else 1
    total = np.zeros(len(ways))
    for i, way in enumerate(ways / distance[:, None]):
        angle = 2 * np.arcsin(np.clip(np.linalg.norm(beams - way, axis=1) / 2, 0, 1))
        order = np.argsort(angle)[: most + 1]
        gaps = np.append(np.diff(angle[order]), np.inf)[most - 1 : most]
        nearest = order[:most]
        near = nearest[angle[nearest] <= reach]
        limit = np.minimum(measured[near] + 6 * sigma, max_range)
        there = distance[i] <= limit
        doubtful = (np.abs(angle[nearest] - reach) < 1e-5).any() or (np.abs(distance[i] - limit) < 1e-4).any()
        doubtful |= bool((gaps < 1e-5).any()) and len(near) == most
        found = change(distance[i], measured[near], angle[near], config, voxel_size)[there].sum()
        total[i] = np.nan if doubtful else found
    return total
