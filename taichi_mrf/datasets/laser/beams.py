"""Laser scans as the beams that a factor graph is built of."""

import numpy as np

from taichi_mrf.datasets.laser.scans import LaserScans
from taichi_mrf.factor_graph.beams import Beams


def beams_of(scans: LaserScans, max_range_m: float = 0.0, no_return_is_free: bool | None = None) -> Beams:
    """All beams of all scans, in their order, in the plane z = 0 of the world frame.

    A beam longer than ``max_range_m`` (0: no limit) is cut there and then says only that its way is free.
    Beams that measured nothing (range 0) are left out, and so are those that did not come back, unless that
    says that their way is free: by ``no_return_is_free``, or if it is None as the scans have it.
    """
    count, beams = scans.range_m.shape
    angle = scans.pose_x_y_theta[:, 2:] + scans.angle_rad
    directions = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1).reshape(-1, 3)
    origin = np.column_stack([scans.pose_x_y_theta[:, :2], np.zeros(count)])
    range_m, hit = scans.range_m.ravel(), scans.hit.ravel()
    used = range_m > 0
    if not (scans.no_return_is_free if no_return_is_free is None else no_return_is_free):
        used &= hit
    if max_range_m > 0:
        hit = hit & (range_m <= max_range_m)
        range_m = np.minimum(range_m, np.float32(max_range_m))
    return Beams(
        origins=np.repeat(origin, beams, axis=0)[used],
        directions=directions[used],
        range_m=range_m[used],
        hit=hit[used],
    )
