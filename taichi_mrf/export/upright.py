"""Which way is up in a map, for files that are shown by programs which have their own idea of it."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.queries.known_bricks import QueriedMap
from taichi_mrf.viewer.scene.look import Up, up_of, up_vector

_Z_UP: Up = (2, 1)


def up_of_map(m: QueriedMap) -> Up:
    """The world's axis that is up in the first keyframe's image; z in a map without keyframes."""
    first = next(iter(m.keyframes.values()), None)
    return _Z_UP if first is None else up_of(first.T_world_camera)


def y_up(up: Up) -> NDArray[np.float64]:
    """The rotation, (4, 4), that makes a world's up glTF's, which is y; with z up it keeps x."""
    T = np.eye(4)
    across, upwards = np.eye(3)[1 if up[0] == 0 else 0], up_vector(up)
    T[:3, :3] = across, upwards, np.cross(across, upwards)
    return T
