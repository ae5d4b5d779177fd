"""Colour images of a camera of their own, beside the depth camera, brought to the depth camera's pixels.

A depth pixel takes the colour that the colour camera has where it sees the pixel's point. It has none where
that camera sees something nearer, or does not look, and where there is no depth.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera

_CELL = 2
"""Side in colour pixels of the cells in which the nearest point is kept, which closes small holes."""

_BEHIND = 0.03
"""A point that is further away than the nearest in its cell by more than this share is hidden."""

_NOWHERE = np.float32(-100.0)
"""The place of a pixel that takes no colour."""


@dataclass(frozen=True, eq=False)
class ColorCamera:
    """A colour camera: ``T_color_depth`` (4, 4) takes points of the depth camera beside it to it."""

    camera: PinholeCamera
    T_color_depth: Pose

    def registered(
        self, color: NDArray[np.uint8], depth_m: NDArray[np.float32], depth_camera: PinholeCamera
    ) -> NDArray[np.uint8]:
        """The colours (H, W, 3) of the pixels of a depth image (H, W), 0 0 0 where there is none; ``color``
        is the colour camera's image, uint8 RGB."""
        turned, shift = _turned_rays(depth_camera, self), self.T_color_depth[:3, 3].astype(np.float32)
        x, y, z = (turned[axis] * depth_m + shift[axis] for axis in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.float32(self.camera.fx) * x / z + np.float32(self.camera.cx)
            v = np.float32(self.camera.fy) * y / z + np.float32(self.camera.cy)
        seen = (depth_m > 0) & (z > 0) & (u >= 0) & (v >= 0)
        seen &= (u <= self.camera.width - 1) & (v <= self.camera.height - 1)
        seen[seen] = self._in_front(u[seen], v[seen], z[seen])
        u[~seen] = _NOWHERE
        picked = without_black(cv2.remap(color, u, v, cv2.INTER_LINEAR))
        picked[~seen] = 0
        return picked

    def _in_front(
        self, u: NDArray[np.float32], v: NDArray[np.float32], z: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """True for points (n,) at pixels (u, v) and depth z that no other point hides."""
        across = self.camera.width // _CELL + 1
        cell = (v.astype(np.int32) // _CELL) * np.int32(across) + u.astype(np.int32) // _CELL
        nearest = np.full(across * (self.camera.height // _CELL + 1), np.float32(np.inf))
        np.minimum.at(nearest, cell, z)
        return np.asarray(z <= nearest[cell] * np.float32(1.0 + _BEHIND))


def without_black(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours (..., 3) with 1 1 1 for black: 0 0 0 stands for no colour."""
    colors[(colors[..., 0] | colors[..., 1] | colors[..., 2]) == 0] = 1
    return colors


@lru_cache(maxsize=8)
def _turned_rays(depth_camera: PinholeCamera, to: ColorCamera) -> NDArray[np.float32]:
    """The depth camera's rays in the colour camera's axes, (3, H, W)."""
    return np.einsum("ij,hwj->ihw", to.T_color_depth[:3, :3], depth_camera.rays()).astype(np.float32)
