"""Contrast of a colour image, which can be aligned: how much brighter each pixel is than its surroundings.

Exposure, shading and lamps that are near or far change brightness over wide areas; contrast stays. Images are
thinned to two widths, so that a search can go from coarse to fine.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame

WIDEST = 320
"""Columns of the fine image, at most; the coarse one has half as many."""

NEAR, AROUND = 0.8, 4.0
"""Standard deviations of what counts as a pixel's own brightness and as its surroundings', in pixels of the
thinned image."""

DARK = 8.0
"""Brightness (of 255) that is added to the surroundings, so that the noise of dark places does not count."""

LEAST_SLOPE = 0.02
"""Contrast must change by this much from pixel to pixel where a point is taken."""

LARGEST_JUMP = 0.05
"""A point whose neighbours differ in depth by more than this share lies on an edge that hides something."""

MOST_POINTS = 800
"""Points of one image that are kept."""

_SQUARE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class TexturedPoints:
    """Points (N, 3) float32 in metres, in the camera frame, and the ``contrast`` (N,) float32 that they
    have."""

    points: NDArray[np.float32]
    contrast: NDArray[np.float32]


@dataclass(frozen=True)
class ContrastImage:
    """The contrast of an image (H, W), float32, and what goes with it: ``slopes`` (H, W, 2), its change along
    columns and rows for each pixel; ``depth_m`` (H, W), 0 for none; ``usable`` (H, W), whether the pixel and
    its neighbours have a colour. ``camera`` is that of the thinned image."""

    camera: PinholeCamera
    contrast: NDArray[np.float32]
    slopes: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    usable: NDArray[np.bool_]

    def textured_points(self) -> TexturedPoints:
        """The points where contrast changes and depth does not jump, evenly thinned to MOST_POINTS."""
        farthest, nearest = cv2.dilate(self.depth_m, _SQUARE), cv2.erode(self.depth_m, _SQUARE)
        smooth = (nearest > 0) & (farthest - nearest < LARGEST_JUMP * self.depth_m)
        steep = np.linalg.norm(self.slopes, axis=-1) > LEAST_SLOPE
        v, u = np.nonzero(self.usable & smooth & steep)
        if len(v) > MOST_POINTS:
            some = np.linspace(0, len(v) - 1, MOST_POINTS).round().astype(np.intp)
            v, u = v[some], u[some]
        points = self.camera.directions(u, v) * self.depth_m[v, u, None]
        return TexturedPoints(points.astype(np.float32), self.contrast[v, u])


def contrast_images(frame: Frame) -> list[ContrastImage]:
    """The coarse and the fine one of a frame; empty if it has no colour, or its camera is no pinhole."""
    camera = frame.camera
    if frame.color is None or not isinstance(camera, PinholeCamera):
        return []
    step = -(-camera.width // WIDEST)
    depth_m = np.where(np.isfinite(frame.depth_m), frame.depth_m, 0).astype(np.float32)
    return [_thinned(frame.color, depth_m, camera, every) for every in (2 * step, step)]


def _thinned(
    color: NDArray[np.uint8], depth_m: NDArray[np.float32], camera: PinholeCamera, every: int
) -> ContrastImage:
    brightness = np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.float32)
    there = np.asarray(color.any(axis=-1), np.float32)  # 0 0 0 is no colour
    kept = there[::every, ::every] > 0
    if every > 1:
        brightness, there = (
            np.ascontiguousarray(cv2.GaussianBlur(wide, (0, 0), every / 2)[::every, ::every])
            for wide in (brightness, there)
        )
    near, around = (_blurred(brightness, there, sigma) for sigma in (NEAR, AROUND))
    contrast = np.asarray(np.where(kept, (near - around) / (around + np.float32(DARK)), 0), np.float32)
    slopes = np.zeros((*contrast.shape, 2), np.float32)
    slopes[:, 1:-1, 0] = (contrast[:, 2:] - contrast[:, :-2]) / 2
    slopes[1:-1, :, 1] = (contrast[2:] - contrast[:-2]) / 2
    usable = cv2.erode(kept.astype(np.uint8), _SQUARE, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    usable[[0, -1]] = usable[:, [0, -1]] = False
    return ContrastImage(
        camera.thinned(every), contrast, slopes, np.ascontiguousarray(depth_m[::every, ::every]), usable
    )


def _blurred(
    brightness: NDArray[np.float32], there: NDArray[np.float32], sigma: float
) -> NDArray[np.float32]:
    """The mean brightness around each pixel, of those that have a colour."""
    total, weight = (cv2.GaussianBlur(image, (0, 0), sigma) for image in (brightness, there))
    return np.asarray(total / np.maximum(weight, np.float32(1e-3)), np.float32)
