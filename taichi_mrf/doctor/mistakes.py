"""The usual mistakes of conventions, how each is undone, and the flag that undoes it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.timed_poses import quaternion
from taichi_mrf.datasets.trajectories import rotation_of
from taichi_mrf.sensor.camera import PinholeCamera

Floats = NDArray[np.float64]

UNITS = {
    1000.0: "millimetres",
    5000.0: "TUM RGB-D's, ICL-NUIM's",
    4000.0: "RealSense's and ScanNet's finer one",
    10000.0: "tenths of a millimetre",
    256.0: "KITTI's",
    100.0: "centimetres",
    1.0: "metres",
    1 / 0.3048: "feet",
}
"""Steps per metre of depth, and whose they are."""

AXES = {
    "optical": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ros": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}
"""The optical axes, as columns, in the frame whose poses were recorded."""


def _resized(factor: float) -> Callable[[PinholeCamera], PinholeCamera]:
    return lambda k: replace(
        k,
        fx=k.fx * factor,
        fy=k.fy * factor,
        cx=(k.cx + 0.5) * factor - 0.5,
        cy=(k.cy + 0.5) * factor - 0.5,
    )


LENSES: dict[str, Callable[[PinholeCamera], PinholeCamera]] = {
    "are of images of half the size": _resized(2.0),
    "are of images of twice the size": _resized(0.5),
    "are of images of two thirds of the size": _resized(1.5),
    "are of images of one and a half times the size": _resized(2 / 3),
    "are of images of a third of the size": _resized(3.0),
    "are of images of three times the size": _resized(1 / 3),
    "have cx and cy swapped": lambda k: replace(k, cx=k.cy, cy=k.cx),
    "have fx and fy swapped": lambda k: replace(k, fx=k.fy, fy=k.fx),
    "have x and y swapped": lambda k: replace(k, fx=k.fy, fy=k.fx, cx=k.cy, cy=k.cx),
}
"""What is wrong with the intrinsics, and the camera that they should be."""


@dataclass(frozen=True)
class Mistakes:
    """What is wrong with a recording; the defaults are a right one. ``factor`` is what depths must be
    multiplied by, ``lens`` a key of LENSES."""

    inverse: bool = False
    w_first: bool = False
    axes: str = "optical"
    late_s: float = 0.0
    along_ray: bool = False
    factor: float = 1.0
    lens: str = ""

    def poses(self, recorded: Floats) -> Floats:
        """T_world_camera (M, 4, 4) of recorded poses, but for their time."""
        T = recorded.copy()
        if self.w_first:
            T[:, :3, :3] = rotation_of(np.roll(quaternion(T[:, :3, :3]), -1, axis=-1))
        if self.inverse:
            T[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
            T[:, :3, 3] = -(T[:, :3, :3] @ T[:, :3, 3, None])[..., 0]
        T[:, :3, :3] = T[:, :3, :3] @ AXES[self.axes]
        return T

    def camera(self, recorded: PinholeCamera) -> PinholeCamera:
        """The camera that took the images."""
        return LENSES[self.lens](recorded) if self.lens else recorded
