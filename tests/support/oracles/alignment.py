"""Normals of a depth image and point-to-plane residuals in NumPy, float64, one after the other.

Written from the definitions: planes through all pixels of a square by singular values, and the sums over the
27 cells around each point as loops.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.alignment.surfels import Planes
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera

TUKEY = 4.685


def plane_normal(depth_m: NDArray[np.float32], camera: PinholeCamera, u: int, v: int, half: int) -> NDArray:
    """Unit normal, towards the camera, of the plane n . p = 1 that fits the inverse depths 1 / z = n . ray of
    a square of pixels best."""
    rows, inverse = [], []
    for y in range(v - half, v + half + 1):
        for x in range(u - half, u + half + 1):
            rows.append([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
            inverse.append(1.0 / float(depth_m[y, x]))
    n = np.linalg.lstsq(np.array(rows), np.array(inverse), rcond=None)[0]
    return -n / np.linalg.norm(n)


@dataclass
class Sums:
    H: NDArray
    g: NDArray
    cost: float
    weight: float
    matched: int


def summed(
    points: NDArray, normals: NDArray, sigmas: NDArray, T: Pose, planes: Planes, cell_size: float, *,
    reach: float, alike: float, least_weight: float, roughness: float,
) -> Sums:  # fmt: skip
    """Sums of point_to_plane.accumulate; a point without a surface costs the most."""
    row_of = {tuple(cell): row for row, cell in enumerate(planes.cells.tolist())}
    out = Sums(np.zeros((6, 6)), np.zeros(6), 0.0, 0.0, 0)
    R = T[:3, :3]
    for p, facing, noise in zip(
        points.astype(float), normals.astype(float), sigmas.astype(float), strict=True
    ):
        P = R @ p + T[:3, 3]
        weight, distance, mean = 0.0, 0.0, np.zeros(3)
        base = np.floor(P / cell_size).astype(int)
        for offset in np.ndindex(3, 3, 3):
            row = row_of.get(tuple((base + offset - 1).tolist()))
            if row is None or planes.normals[row] @ (R @ facing) <= alike:
                continue
            away = P - planes.points_m[row]
            w = planes.weights[row] * np.exp(-0.5 * (away @ away) / (reach * cell_size) ** 2)
            weight, distance = weight + w, distance + w * planes.normals[row] @ away
            mean = mean + w * planes.normals[row]
        if weight <= least_weight:
            out.cost += TUKEY**2 / 6
            continue
        r, n = distance / weight, mean / np.linalg.norm(mean)
        sigma = np.hypot(noise, roughness * cell_size)
        x = min(abs(r) / (TUKEY * sigma), 1.0)
        m = R.T @ n
        J = np.concatenate([m, np.cross(p, m)])
        w = (1 - x * x) ** 2 / sigma**2
        out.H += w * np.outer(J, J)
        out.g += w * r * J
        out.cost += TUKEY**2 / 6 * (1 - (1 - x * x) ** 3)
        out.weight += w
        out.matched += 1
    return out
