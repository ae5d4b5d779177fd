"""Distances of points from the surface, and their derivatives by the camera's pose: residuals and Jacobian.

A point p of the camera frame is moved by T exp(xi), xi = (rho, omega), to P = T (p + rho + omega x p). Its
residual is the mean over the surfels in the 27 cells around P, weighted by how near and how well known they
are, of the distance from each one's plane; with the mean normal n, and m = R^T n,

    r = n . (P - mu)        dr / dxi = (m, p x m)

The surfels are held fixed while the pose moves. Residuals count in units of sigma, which is the sensor's
along the normal and what the surface departs from its planes together, by Tukey's biweight.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.oriented_points import OrientedPoints
from taichi_mrf.alignment.recorded import SURFACE_SIGMA_M
from taichi_mrf.alignment.surfel_grid import SurfelGrid, SurfelPlanes
from taichi_mrf.alignment.surfels import ROUGHNESS
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.resident import Resident, resident
from taichi_mrf.system.types import I32, F32Array, F32Array2, IVec3, Mat3, Template, Vec3
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.numbering import flat, voxel_number
from taichi_mrf.voxels.traversal import Viewpoint

TUKEY = 4.685
"""Sigmas beyond which a residual has no weight (95% efficiency for normal errors)."""

LARGEST_COST = TUKEY**2 / 6
"""Cost of a residual beyond that, and of a point that has no surface near it."""

REACH = 0.6
"""Standard deviation, in cells, of the weight that a surfel has by its distance from a point."""

ALIKE = 0.7
"""Cosine of the largest angle (46 degrees) between a point's normal and that of a surfel of its surface."""

LEAST_WEIGHT = 1e-3
"""Weight below which there is no surface around a point: a thousandth of one good measurement right there."""

_TERMS = 6 * 6 + 6 + 4
_COST, _POINTS, _WEIGHT, _SQUARES = 42, 43, 44, 45


@dataclass(frozen=True)
class NormalEquations:
    """A least-squares problem around one pose: ``H`` (6, 6) and ``g`` (6,) of the step xi with H xi = -g.

    ``weight`` is the sum of the weights in H and g, per square metre. ``cost`` is Tukey's, summed over all
    ``total`` points; ``matched`` is the number of points with a surface near them; ``rms_m`` the weighted RMS
    of their residuals in metres.
    """

    H: NDArray[np.float64]
    g: NDArray[np.float64]
    weight: float
    cost: float
    matched: int
    total: int
    rms_m: float

    @property
    def overlap(self) -> float:
        """Share of the points with a surface near them."""
        return self.matched / max(1, self.total)

    @property
    def fit(self) -> float:
        """Share of the points that lie on a surface, by Tukey's measure."""
        return 1.0 - self.cost / (LARGEST_COST * max(1, self.total))

    @property
    def worth(self) -> float:
        """The factor that turns all points into one measurement with the sigma of a surface, less where few
        of them overlap."""
        return self.overlap / (self.weight * SURFACE_SIGMA_M**2) if self.weight > 0 else 0.0


@dataclass(frozen=True)
class _Points(Bundle):
    """OrientedPoints on the device, of which the first ``total`` are used."""

    positions: F32Array2
    """(N, 3) metres, in the camera frame."""

    normals: F32Array2
    """(N, 3), of length one."""

    sigmas: F32Array
    """(N) metres, along the normals."""

    total: I32


@dataclass(frozen=True)
class _Strips(Bundle):
    """Division of the points: a strip's points are added up one after the other, so that the sums do not
    depend on the number of threads."""

    number: I32

    spread: I32
    """Iterations that a strip stands for: on a CPU Taichi gives a thread no fewer than 512."""


class PointToPlane:
    """The residuals of some points against some surfels, for one pose after the other."""

    def __init__(self, points: OrientedPoints, grid: SurfelGrid) -> None:
        self.grid, self.total = grid, len(points.points)
        positions, normals = _resident(points.points), _resident(points.normals)
        self._points = _Points(positions, normals, _resident(points.sigmas), self.total)
        self._strips = _Strips(64, 512) if runtime.active() == "cpu" else _Strips(2048, 1)

    def linearised(self, T_world_camera: Pose) -> NormalEquations:
        """Residuals and their derivatives at a pose."""
        sums = np.zeros((self._strips.number, _TERMS), np.float32)
        if self.total and self.grid.count:
            view = self.grid.window.viewpoint(T_world_camera)
            rotation = ti.Matrix(T_world_camera[:3, :3].tolist(), ti.f32)
            accumulate(self._points, view, rotation, self.grid.planes, self._strips, sums)
            runtime.settle()
        total = sums.sum(axis=0, dtype=np.float64)
        matched = round(total[_POINTS])
        cost = total[_COST] + LARGEST_COST * (self.total - matched)
        rms_m = float(np.sqrt(total[_SQUARES] / total[_WEIGHT])) if total[_WEIGHT] > 0 else 0.0
        return NormalEquations(
            total[:36].reshape(6, 6), total[36:42], float(total[_WEIGHT]), cost, matched, self.total, rms_m
        )


def _resident(values: NDArray[np.float32]) -> Resident:
    return resident(values if len(values) else np.zeros((1, *values.shape[1:]), np.float32))


@ti.func
def surface_at(P: Vec3, normal: Vec3, surface: Template):
    """(signed distance in cells, unit normal, weight) of the surface (SurfelPlanes) around P, in cells from
    the window's corner, whose normal is like ``normal``; the weight is 0 where there is none."""
    weight, distance = 0.0, 0.0
    mean = Vec3(0.0)
    base = ti.floor(P, ti.i32)
    # A loop, not 27 copies of what is in it, which took seconds to compile.
    for dx, dy, dz in ti.ndrange((-1, 2), (-1, 2), (-1, 2)):
        cell = base + IVec3(dx, dy, dz)
        if cell.min() >= 0 and (surface.shape * BRICK - cell).min() > 0:
            brick = surface.bricks[flat(cell >> 3, surface.shape)]
            if brick >= 0:
                row = surface.places[brick * VOXELS + voxel_number(cell & 7)]
                if row >= 0:
                    planes = ti.static(surface.planes)
                    away = P - Vec3(planes[row, 1], planes[row, 2], planes[row, 3])
                    n = Vec3(planes[row, 4], planes[row, 5], planes[row, 6])
                    if n.dot(normal) > ALIKE:
                        w = planes[row, 0] * ti.exp(-0.5 / (REACH * REACH) * away.dot(away))
                        weight += w
                        distance += w * n.dot(away)
                        mean += w * n
    if weight > LEAST_WEIGHT:
        distance /= weight
        mean = mean.normalized()
    else:
        weight = 0.0
    return distance, mean, weight


@ti.func
def _vector(rows: Template, i: I32):
    """Row i of an array (n, 3)."""
    return Vec3(rows[i, 0], rows[i, 1], rows[i, 2])


@kernel
def accumulate(
    points: _Points, view: Viewpoint, rotation: Mat3, surface: SurfelPlanes, strips: _Strips, sums: F32Array2
) -> None:
    """Sum up H (36), g (6), cost, points, weights and weighted squares: ``sums`` is (strips, 46).

    ``view`` is the camera in the window of the ``surface``, ``rotation`` the camera's own in the world.
    """
    for iteration in range(strips.number * strips.spread):
        if iteration % strips.spread == 0:
            strip = iteration // strips.spread
            H = ti.Matrix.zero(ti.f32, 6, 6)
            g = ti.Vector.zero(ti.f32, 6)
            cost, found, weights, squares = 0.0, 0.0, 0.0, 0.0
            size = (points.total + strips.number - 1) // strips.number
            for i in range(strip * size, ti.min(points.total, (strip + 1) * size)):
                p = _vector(points.positions, i)
                facing = rotation @ _vector(points.normals, i)
                distance, n, weight = surface_at(view.centre + view.to_voxels @ p, facing, surface)
                if weight > 0.0:
                    r = distance * surface.cell_size_m
                    sigma = ti.sqrt(points.sigmas[i] ** 2 + (ROUGHNESS * surface.cell_size_m) ** 2)
                    inside = ti.max(0.0, 1.0 - (r / (TUKEY * sigma)) ** 2)
                    w = inside * inside / (sigma * sigma)
                    m = rotation.transpose() @ n
                    turn = p.cross(m)
                    J = ti.Vector([m[0], m[1], m[2], turn[0], turn[1], turn[2]])
                    H += w * J.outer_product(J)
                    g += w * r * J
                    cost += LARGEST_COST * (1.0 - inside * inside * inside)
                    found += 1.0
                    weights += w
                    squares += w * r * r
            for a in ti.static(range(6)):
                sums[strip, 36 + a] = g[a]
                for b in ti.static(range(6)):
                    sums[strip, 6 * a + b] = H[a, b]
            sums[strip, _COST] = cost
            sums[strip, _POINTS] = found
            sums[strip, _WEIGHT] = weights
            sums[strip, _SQUARES] = squares
