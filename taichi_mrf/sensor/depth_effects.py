"""Effects on a depth camera's view of a surface: its tilt, its edges, and where it is sampled.

All functions take clean axial depth in metres, (H, W) float64, where 0 means that there is no surface.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.sensor.camera import PinholeCamera

Image = NDArray[np.float64]


def incidence(depth_m: Image, camera: PinholeCamera, across_edges: bool = True) -> Image:
    """Angle between each pixel's ray and the surface's normal, (H, W), in radians, 0 to pi / 2.

    A plane's inverse depth is linear in the image, a x + b y + c with x, y the ray at z = 1, and (a, b, c)
    is its normal; a and b are taken from central differences, one-sided at the image's edge. At an edge
    between two surfaces these make it steep; without ``across_edges`` the difference to the nearer in depth
    of the two neighbours gives each surface's own tilt. Where a neighbour has no depth central differences
    mean nothing.
    """
    inverse = _inverse(depth_m)
    by_row, by_column = np.gradient(inverse) if across_edges else (_slope(inverse, 0), _slope(inverse, 1))
    a, b = by_column * camera.fx, by_row * camera.fy
    rays = camera.rays()
    c = inverse - a * rays[..., 0] - b * rays[..., 1]
    length = np.sqrt(a * a + b * b + c * c)
    # The ray times the normal is the inverse depth itself.
    cosine = inverse / np.maximum(length * camera.range_per_depth(), 1e-12)
    return np.arccos(np.minimum(cosine, 1.0))


def at_a_jump(depth_m: Image, largest_share: float) -> NDArray[np.bool_]:
    """Pixels on either side of a step to a neighbour above, below, left or right."""
    jump = np.zeros(depth_m.shape, dtype=bool)
    for here, next_to_it in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        a, b = depth_m[here], depth_m[next_to_it]
        large = np.abs(a - b) > largest_share * np.minimum(a, b)
        jump[here] |= large
        jump[next_to_it] |= large
    return jump


def sampled_beside(
    depth_m: Image, shift_px: tuple[Image, Image]
) -> tuple[Image, tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Depth at places that lie ``shift_px`` = (across, down) from the pixels' centres, and the index of the
    pixel that each place belongs to.

    That pixel's own surface is continued to the place as a plane, whose inverse depth is linear in the
    image. A place beyond an edge of a surface thus has the neighbour's depth, and none is ever a mixture of
    two surfaces. Places outside the image belong to its outermost pixels.
    """
    rows, columns = np.indices(depth_m.shape)
    height, width = depth_m.shape
    u = np.clip(columns + shift_px[0], 0, width - 1)
    v = np.clip(rows + shift_px[1], 0, height - 1)
    pixel = (np.rint(v).astype(np.intp), np.rint(u).astype(np.intp))
    inverse = _inverse(depth_m)
    here = inverse[pixel]
    there = here + (u - pixel[1]) * _slope(inverse, 1)[pixel] + (v - pixel[0]) * _slope(inverse, 0)[pixel]
    # Half a pixel on, a plane seen from its edge would already be behind the camera.
    seen = (here > 0) & (there > 0)
    return np.where(seen, 1.0 / np.where(seen, there, 1.0), 0.0), pixel


def in_disparity_steps(depth_m: Image, step_at_1m: float) -> Image:
    """Round the inverse depth to whole steps, which at 1 m are ``step_at_1m`` of depth."""
    positive = depth_m > 0
    counts = np.round(1.0 / (np.where(positive, depth_m, 1.0) * step_at_1m))
    return np.where(positive & (counts > 0), 1.0 / (np.maximum(counts, 1.0) * step_at_1m), 0.0)


def _inverse(depth_m: Image) -> Image:
    """1 / depth, 0 where there is none."""
    return 1.0 / np.where(depth_m > 0, depth_m, np.inf)


def _slope(values: Image, axis: int) -> Image:
    """The smaller of the differences to the two neighbours: next to an edge, the one within the surface."""
    difference = np.moveaxis(np.diff(values, axis=axis), axis, 0)
    before = np.concatenate([difference[:1], difference])
    after = np.concatenate([difference, difference[-1:]])
    return np.moveaxis(np.where(np.abs(before) < np.abs(after), before, after), 0, axis)
