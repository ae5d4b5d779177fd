"""Schauwecker & Zell's mapping (IROS 2014) in float64 NumPy, ray by ray and voxel by voxel.

Written from the paper's equations, whose numbers stand at each step, and not from the kernels: a map is a
dictionary of the voxels that something is known of, and rays are cut at the grid's faces.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from oracles.forward import Noise
from oracles.traversal import clip_to_box, segments
from taichi_mrf.config.sections import VisibilityConfig
from taichi_mrf.sensor.camera import PinholeCamera

Voxel = tuple[int, int, int]
Map = dict[Voxel, float]
Box = tuple[tuple[float, float, float], tuple[float, float, float]]

SURE = 0.95


def occupancy(known: Map, voxel: Voxel, box: Box | None = None) -> float:
    """P(O): 0.5 where nothing is known; nothing is in the way outside the mapped box (in voxels)."""
    if box is not None and not all(
        low <= i + 0.5 <= high for low, i, high in zip(box[0], voxel, box[1], strict=True)
    ):
        return 0.0
    return known.get(voxel, 0.5)


def local_occlusion(known: Map, voxel: Voxel, sensor: Voxel, box: Box | None = None) -> float:
    """Eq. 1, over the faces that the sensor's voxel sees."""
    neighbours = []
    for axis in range(3):
        towards = int(np.sign(sensor[axis] - voxel[axis]))
        if towards:
            neighbour = list(voxel)
            neighbour[axis] += towards
            neighbours.append(occupancy(known, (neighbour[0], neighbour[1], neighbour[2]), box))
    return min(neighbours, default=0.0)


def visibilities(occluded: Iterable[float], config: VisibilityConfig) -> list[float]:
    """Eqs. 2 and 3 along a ray, up to the voxel before the first that falls below q_min."""
    out: list[float] = []
    before = 1.0
    for c in occluded:
        # Eq. 2 with all its four terms; what follows an invisible voxel is invisible.
        after = (
            config.visible_if_occluded * c * before
            + config.visible_if_clear * (1 - c) * before
            + 0.0 * c * (1 - before)
            + 0.0 * (1 - c) * (1 - before)
        )
        before = 1.0 if after >= config.q_max else after
        if before < config.q_min:
            break
        out.append(before)
    return out


def inside(depth: float, measured: float, sigma: float) -> float:
    """P(I): cumulative normal distribution."""
    return 0.5 * math.erfc((measured - depth) / sigma / math.sqrt(2))


def bayes(occupied: float, visible: float, if_occupied: float, if_free: float, if_hidden: float) -> float:
    """Eqs. 4 to 6 as the paper prints them."""
    of_occupied = if_hidden * (1 - visible) + if_occupied * visible
    of_any = if_hidden * (1 - visible) + if_occupied * occupied * visible + if_free * (1 - occupied) * visible
    return of_occupied * occupied / of_any


def interpolated(occupied: float, visible: float, inside: float, config: VisibilityConfig) -> float:
    """Eq. 8. The paper's published code takes P(H | not V) for P(not H | not V), 0.05 for 0.95, which makes a
    voxel that can hardly be seen almost as free as one in full view. This follows the paper."""
    c = config
    hit = bayes(occupied, visible, c.hit_if_occupied, c.hit_if_free, c.hit_if_hidden)
    miss = bayes(occupied, visible, 1 - c.hit_if_occupied, 1 - c.hit_if_free, 1 - c.hit_if_hidden)
    return inside * hit + (1 - inside) * miss


@dataclass
class Seen:
    """Evidence of a scan's rays for one voxel."""

    visible: list[float] = field(default_factory=list)
    inside: list[float] = field(default_factory=list)
    length: list[float] = field(default_factory=list)  # of the ray's segment, in voxel sizes


def follow(
    known: Map,
    depth_m: NDArray[np.float32],
    T: NDArray[np.float64],
    camera: PinholeCamera,
    voxel_size: float,
    noise: Noise,
    config: VisibilityConfig,
    max_depth: float,
    volume: Box | None = None,
) -> dict[Voxel, Seen]:
    """Evidence of all rays of a scan for the voxels that they get to; ``volume`` is a box in metres."""
    scan: dict[Voxel, Seen] = {}
    centre = T[:3, 3]
    sensor = _voxel(np.floor(centre / voxel_size))
    box = None
    if volume is not None:
        low, high = (tuple(np.round(np.array(c) / voxel_size).tolist()) for c in volume)
        box = (low, high)
    directions = camera.rays()
    for v, u in np.argwhere(depth_m > 0):
        measured = float(noise.depth_of_deviation(float(depth_m[v, u]), 0.0))
        sigma = float(noise.sigma_at(measured))  # eq. 7
        direction = T[:3, :3] @ directions[v, u]
        length = float(np.linalg.norm(direction))
        begin, end = 0.0, min(max_depth, measured + 10 * sigma + 10 * voxel_size)
        if config.max_range > 0:
            end = min(end, config.max_range / length)
        if box is not None:
            begin, end = clip_to_box(centre / voxel_size, direction / voxel_size, begin, end, box[0], box[1])
        cells, near, far = segments(centre, direction, begin, end, voxel_size)
        voxels = [_voxel(c) for c in cells]
        visible = visibilities((local_occlusion(known, c, sensor, box) for c in voxels), config)
        sure = False
        middle, lengths = 0.5 * (near + far), (far - near) * length / voxel_size
        for voxel, p, z, cut in zip(voxels, visible, middle.tolist(), lengths.tolist(), strict=False):
            there = scan.setdefault(voxel, Seen())
            there.length.append(cut)
            there.visible.append(p)
            there.inside.append(1.0 if sure else inside(z, measured, sigma))
            if sure:
                break
            sure = there.inside[-1] >= SURE
    return scan


def integrate(known: Map, scan: dict[Voxel, Seen], config: VisibilityConfig) -> Map:
    """The map after a scan. Of all rays the largest P(V) and the largest P(I) win."""
    after = dict(known)
    for voxel, seen in scan.items():
        p = interpolated(occupancy(known, voxel), max(seen.visible), max(seen.inside), config)
        after[voxel] = min(max(p, config.lowest), config.highest)
    return after


def _voxel(cell: NDArray) -> Voxel:
    i, j, k = (int(c) for c in cell)
    return i, j, k
