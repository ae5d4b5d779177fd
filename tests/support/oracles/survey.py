"""A ray through a piecewise constant medium in float64: eqs. 15 to 18 of MRFMap, section III-D."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oracles.forward import Noise

Vector = NDArray[np.float64]

SLIVER = 1e-3
"""A corner that a ray cuts by less than this share of a voxel may be met or not: rounding decides."""

UNDECIDED = 0.01
"""Two voxels whose omegas are this close, relative to the larger, explain a ray equally well."""


@dataclass(frozen=True)
class Profile:
    """Voxels that a ray meets, (n,) each. ``near`` and ``far`` are values of the ray's own
    parameter, one unit of which is ``speed`` metres long; ``through`` is what is left at the end."""

    near: Vector
    far: Vector
    speed: float
    voxel_size: float
    occupancy: Vector
    visibility: Vector
    omega: Vector
    through: float


def profile(
    near: Vector,
    far: Vector,
    log_odds: Vector,
    voxel_size: float,
    speed: float,
    *,
    unknown: float = np.inf,
    empty_below: float = -np.inf,
    least: float = -np.inf,
    most: float = np.inf,
) -> Profile:
    """Voxels of the log-odds ``unknown``, or of less than ``empty_below``, dim nothing; the others as if
    their log-odds were between ``least`` and ``most``."""
    alpha = np.log1p(np.exp(np.clip(log_odds, least, most))) / voxel_size  # -ln(1 - p) / voxel size
    alpha[(log_odds == unknown) | (log_odds < empty_below)] = 0.0
    left = np.exp(-np.concatenate([[0.0], np.cumsum(alpha * (far - near) * speed)]))
    occupancy = 1 / (1 + np.exp(-log_odds))
    return Profile(near, far, speed, voxel_size, occupancy, left[:-1], alpha * left[:-1], float(left[-1]))


@dataclass(frozen=True)
class Surveyed:
    """SurfaceSurvey's answer for a ray or for each pixel of a view; ``clear`` where rounding has no say."""

    near: Any
    far: Any
    visibility: Any
    expected: Any
    likelihood: Any
    clear: Any


def survey(ray: Profile, opaque: float, measured: float, noise: Noise) -> Surveyed:
    """``opaque`` is the visibility at which a ray is not followed further."""
    left = np.append(ray.visibility[1:], ray.through)[: len(ray.near)]
    met = ray.visibility > opaque
    near, far, omega, left = ray.near[met], ray.far[met], ray.omega[met], left[met]
    if not omega.any():
        return Surveyed(0.0, 0.0, 1.0, 0.0, 0.0, True)
    stopped = ray.visibility[met] - left
    best = int(omega.argmax())
    whole = np.where((far - near) * ray.speed > SLIVER * ray.voxel_size, omega, 0.0)
    clear = whole[best] > 0
    clear &= bool(np.delete(omega, best).max(initial=0.0) < (1 - UNDECIDED) * omega[best])
    clear &= bool((np.abs(left - opaque) > 0.05 * opaque).all())
    return Surveyed(
        near=float(near[best]),
        far=float(far[best]),
        visibility=float(left[-1]),
        expected=float((stopped * 0.5 * (near + far)).sum() / stopped.sum()),
        likelihood=float((stopped * noise.density_over(measured, near, far)).sum()),
        clear=clear,
    )
