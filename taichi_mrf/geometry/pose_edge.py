"""An edge of a pose graph: what was measured between two poses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose


@dataclass(frozen=True, eq=False)
class PoseEdge:
    """A measured step: the pose ``T_first_second`` (4, 4) of node ``second`` in the frame of ``first``.

    ``information`` (6, 6) is the inverse covariance of the twist
    log(inv(T_first_second) inv(T_first) T_second), in the frame of ``second``, metres before radians; None,
    where a file gives none, counts as the identity.
    ``certain``: not rejected however badly it fits, as steps between neighbours in time.
    """

    first: int
    second: int
    T_first_second: Pose
    information: NDArray[np.float64] | None = None
    certain: bool = True
