"""The up direction of a world frame: an axis and a sign, from the way a camera was held.

A map keeps the direction of its first keyframe (``up`` in methods/protocol.py).
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose

Up = tuple[int, int]
"""An axis of the world (0, 1, 2), and 1 or -1 for its direction."""

Z_UP: Up = (2, 1)


UP_NAMES = ("x", "y", "z", "-x", "-y", "-z")


def up_of(T_world_camera: Pose, up: tuple[float, float, float] = (0.0, -1.0, 0.0)) -> Up:
    """The world axis nearest to a camera's upward direction, which in its own frame is ``up``."""
    upwards = T_world_camera[:3, :3] @ np.asarray(up, np.float64)
    axis = int(np.argmax(np.abs(upwards)))
    return axis, 1 if upwards[axis] > 0 else -1


def up_vector(up: Up) -> NDArray[np.float64]:
    """The unit vector (3,) that points up."""
    return up[1] * np.eye(3)[up[0]]


def up_name(up: Up) -> str:
    """``z`` or ``-y``, for example."""
    return f"{'' if up[1] > 0 else '-'}{'xyz'[up[0]]}"


def up_from_name(name: str) -> Up:
    """The inverse of :func:`up_name`."""
    return "xyz".index(name[-1]), -1 if name.startswith("-") else 1


def plan_axes(up: Up) -> tuple[int, int]:
    """The world axes that run to the right and upwards in a floor plan, seen from above.

    With up they form a right-handed frame, so a plan is never mirrored: x and y for z up, x and z for -y up.
    """
    axis, sign = up
    right, forwards = (axis + 1) % 3, (axis + 2) % 3
    return (right, forwards) if sign > 0 else (forwards, right)


def y_up(up: Up) -> NDArray[np.float64]:
    """The rotation, (4, 4), that turns a world's up into y, glTF's up axis; with z up it keeps x."""
    T = np.eye(4)
    across, upwards = np.eye(3)[1 if up[0] == 0 else 0], up_vector(up)
    T[:3, :3] = across, upwards, np.cross(across, upwards)
    return T
