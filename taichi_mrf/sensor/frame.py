"""One measurement of a depth camera, whatever it was recorded with."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera


@dataclass(frozen=True)
class Frame:
    """A depth image, where it was taken, and with what.

    ``depth_m`` is axial depth (along the optical axis), (H, W) float32 in metres; 0 means no
    measurement. ``T_world_camera`` is (4, 4) float64. ``stamp`` is in seconds. ``color`` is (H, W, 3)
    uint8 RGB of the same pixels, 0 0 0 where a pixel has none, or None. ``name`` is what error messages
    and reports call this frame.
    """

    depth_m: NDArray[np.float32]
    T_world_camera: Pose
    camera: PinholeCamera
    stamp: float
    name: str
    color: NDArray[np.uint8] | None = None
