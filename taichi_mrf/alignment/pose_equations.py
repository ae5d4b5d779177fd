"""The normal equations of a step of many poses at once, H xi = -g: sparse, in blocks of 6 x 6, because a pose
meets only those that it is measured against."""

import numpy as np
from numpy.typing import NDArray

_WITHIN = np.arange(6)


class PoseEquations:
    """Equations of the twists of ``poses`` poses, to which terms are added."""

    def __init__(self, poses: int) -> None:
        self.poses = poses
        self.g = np.zeros((poses, 6))
        self._values: list[NDArray[np.float64]] = []
        self._rows: list[NDArray[np.intp]] = []
        self._columns: list[NDArray[np.intp]] = []

    def add(
        self,
        at: NDArray[np.intp],
        H: NDArray[np.float64],
        g: NDArray[np.float64],
    ) -> None:
        """Add terms of one pose each: second derivatives H (n, 6, 6) and first ones g (n, 6) of the poses
        numbered ``at`` (n,)."""
        self._block(at, at, H)
        np.add.at(self.g, at, g)

    def add_pairs(
        self,
        moving: NDArray[np.intp],
        other: NDArray[np.intp],
        to_other: NDArray[np.float64],
        H: NDArray[np.float64],
        g: NDArray[np.float64],
    ) -> None:
        """Add terms of the motion xi_moving + to_other xi_other of two poses against each other: H
        (n, 6, 6) and g (n, 6) by that motion, ``to_other`` (n, 6, 6)."""
        H_both = H @ to_other
        back = np.swapaxes(to_other, -1, -2)
        self.add(moving, H, g)
        self.add(other, back @ H_both, (back @ g[..., None])[..., 0])
        self._block(moving, other, H_both)
        self._block(other, moving, np.swapaxes(H_both, -1, -2))

    def step(self, free: NDArray[np.bool_], damping: float = 0.0) -> NDArray[np.float64]:
        """The step (poses, 6): 0 for poses that are not ``free`` (poses,), and for those without any term.
        ``damping`` is Levenberg's, a share of the diagonal."""
        from scipy import sparse  # slow to import, and few runs need it
        from scipy.sparse.linalg import splu

        size = 6 * self.poses
        if not self._values:
            return np.zeros((self.poses, 6))
        chosen = np.flatnonzero(np.repeat(free, 6))
        parts = (np.concatenate(part) for part in (self._values, self._rows, self._columns))
        values, rows, columns = parts
        H = sparse.csc_matrix((values, (rows, columns)), shape=(size, size))[:, chosen][chosen]
        diagonal = H.diagonal()
        floor = 1e-12 * max(1.0, float(diagonal.max(initial=0.0)))
        H = H + sparse.diags(damping * diagonal + floor)
        options = {"SymmetricMode": True}
        factors = splu(H.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        step = np.zeros(size)
        step[chosen] = factors.solve(-self.g.ravel()[chosen])
        return step.reshape(-1, 6)

    def _block(self, rows: NDArray[np.intp], columns: NDArray[np.intp], values: NDArray[np.float64]) -> None:
        shape = (len(rows), 6, 6)
        self._values.append(values.ravel())
        self._rows.append(np.broadcast_to((6 * rows[:, None] + _WITHIN)[:, :, None], shape).ravel())
        self._columns.append(np.broadcast_to((6 * columns[:, None] + _WITHIN)[:, None, :], shape).ravel())
