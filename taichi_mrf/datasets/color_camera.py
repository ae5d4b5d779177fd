"""Colour images of a camera of their own, beside the depth camera, brought to the depth camera's pixels.

A depth pixel takes the colour that the colour camera has where it sees the pixel's point. It has none where
that camera sees something nearer, or does not look, and where there is no depth.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera

_CELL = 2
"""Side in colour pixels of the cells in which the nearest point is kept: small holes between points are
closed."""

_BEHIND = 0.03
"""A point that is further away than the nearest in its cell by more than this share is hidden."""

_NOWHERE = np.float32(-100.0)
"""The place of a pixel that takes no colour."""


@dataclass(frozen=True)
class ColorCamera:
    """A colour camera beside a depth camera: ``T_color_depth`` (4, 4) takes points of the depth camera to
    it."""

    camera: PinholeCamera
    T_color_depth: Pose

    def registered(
        self, color: NDArray[np.uint8], depth_m: NDArray[np.float32], depth_camera: PinholeCamera
    ) -> NDArray[np.uint8]:
        """The colours (H, W, 3) of the pixels of a depth image (H, W), 0 0 0 where there is none; ``color``
        is the colour camera's image, uint8 RGB."""
        measured = depth_m > 0
        points = depth_camera.rays()[measured] * depth_m[measured][:, None].astype(np.float64)
        x, y, z = (points @ self.T_color_depth[:3, :3].T + self.T_color_depth[:3, 3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self.camera.fx * x / z + self.camera.cx
            v = self.camera.fy * y / z + self.camera.cy
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u <= self.camera.width - 1) & (v <= self.camera.height - 1)
        rows, columns = np.nonzero(measured)
        kept = np.flatnonzero(inside)
        kept = kept[self._in_front(u[kept], v[kept], z[kept])]
        u_of, v_of = np.full((2, *depth_m.shape), _NOWHERE, np.float32)
        u_of[rows[kept], columns[kept]], v_of[rows[kept], columns[kept]] = u[kept], v[kept]
        picked = without_black(cv2.remap(color, u_of, v_of, cv2.INTER_LINEAR))
        picked[u_of == _NOWHERE] = 0
        return picked

    def _in_front(
        self, u: NDArray[np.float64], v: NDArray[np.float64], z: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Which points (n,) at pixels (u, v) and depth z have none before them."""
        across = self.camera.width // _CELL + 1
        cell = (v / _CELL).astype(np.int64) * across + (u / _CELL).astype(np.int64)
        nearest = np.full(across * (self.camera.height // _CELL + 1), np.inf)
        np.minimum.at(nearest, cell, z)
        return np.asarray(z <= nearest[cell] * (1.0 + _BEHIND))


def without_black(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same colours (..., 3) with 1 1 1 for black: 0 0 0 stands for no colour."""
    colors[~colors.any(axis=-1)] = 1
    return colors
