"""A body that the camera carries along, as a robot's own arm or bumper: pixels whose depth stays while the
camera moves, and through whose points other frames look.

A floor before a robot that drives keeps its depth, too, but other frames measure it where it should be.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.doctor.readings import Reading
from taichi_mrf.datasets.doctor.search import NEARER, Search, seen_by
from taichi_mrf.geometry.poses import inverse
from taichi_mrf.sensor.camera import PinholeCamera

FEWEST_VIEWS = 5
"""With fewer frames a depth may stay by chance."""

IN_MOST = 0.8
"""Share of the frames that measure a pixel of the body."""

SPREAD = 0.03
"""By how much its depths may differ, as a share: from the lowest tenth to the highest."""

LEAST_SHARE = 0.005
"""Share of the image from which on a body is told."""

FEWEST_LOOKS = 2
"""Other frames that look through a pixel's point, at least, and more than agree with it."""

_PIXELS = 20_000
"""Of larger images every second row and column is looked at, or every third, ..."""


def carried_along(search: Search, reading: Reading) -> NDArray[np.bool_] | None:
    """The pixels (H, W) that show what the camera carries along; None if none do, or too few frames tell."""
    views = {i: v for i, v in search.sample.views.items() if isinstance(v.camera, PinholeCamera)}
    if len(views) < FEWEST_VIEWS or len({view.image.shape for view in views.values()}) > 1:
        return None
    images = np.stack([view.image for view in views.values()]).astype(np.float64)
    step = int(np.ceil(np.sqrt(images[0].size / _PIXELS)))
    there = np.where(images > 0, images, np.nan)[:, ::step, ::step]
    often = np.isfinite(there).mean(axis=0) >= IN_MOST
    low, high = np.nanpercentile(np.where(often, there, 1.0), (10, 90), axis=0)
    v, u = np.nonzero(often & (high <= (1 + SPREAD) * low))
    through, agree = np.zeros((2, len(v)), np.int64)
    for (first, second), T in zip(search.sample.pairs, search.moves(reading), strict=True):
        if T is None or first not in views or second not in views:
            continue
        for one, other, move in ((first, second, T), (second, first, inverse(T))):
            camera, depth_m = views[one].camera, views[one].image[v * step, u * step] * reading.factor
            assert isinstance(camera, PinholeCamera)
            rays = reading.stored_camera(camera).directions(u * step, v * step)
            if reading.along_ray:
                rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            seen = seen_by(views[other], rays * depth_m[:, None], move, reading)
            known = (depth_m > 0) & (seen.measured > 0) & (NEARER * seen.expected <= seen.measured)
            behind = seen.expected < NEARER * seen.measured
            through, agree = through + (known & behind), agree + (known & ~behind)
    body = np.zeros(often.shape, np.uint8)
    body[v, u] = (through >= FEWEST_LOOKS) & (through > agree)
    body = cv2.morphologyEx(body, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if body.mean() < LEAST_SHARE:
        return None
    return np.kron(body, np.ones((step, step), np.uint8))[: images.shape[1], : images.shape[2]] > 0
