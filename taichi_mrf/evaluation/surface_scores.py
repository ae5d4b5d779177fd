"""Scores of a triangle mesh against the true surface: F-score, accuracy, completeness, normals, and the
calibration of its standard deviations.

The truth are the points that clean depth images see, with the planes through them. A distance is that to the
plane of the nearest point, and as far as the foot lies further aside than the points are apart, to the point.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.libraries import library

JUMP = 0.15
"""Neighbouring depths that differ by more than this share lie on two surfaces: there is no plane."""

SAMPLES_PER_M2 = 2500
"""Points on the mesh at which it is judged."""


@dataclass(frozen=True)
class OrientedPoints:
    """Points (n, 3) in metres with unit normals (n, 3), and how far apart they are (n,)."""

    points_m: NDArray[np.float64]
    normals: NDArray[np.float64]
    spacing_m: NDArray[np.float64]

    @cached_property
    def tree(self) -> Any:
        """Finds the nearest of the points."""
        return library("scipy.spatial", "surface scores need", "mesh").cKDTree(self.points_m)

    @staticmethod
    def joined(parts: Sequence["OrientedPoints"], cell_m: float) -> "OrientedPoints":
        """All of them, thinned to one for each cell of a grid: that with the smallest spacing."""
        points, normals, spacing = (
            np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(OrientedPoints)
        )
        order = np.argsort(spacing, kind="stable")
        cells = np.floor(points[order] / cell_m).astype(np.int64) + (1 << 20)
        _, first = np.unique(cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2], return_index=True)
        rows = order[first]
        return OrientedPoints(points[rows], normals[rows], np.maximum(spacing[rows], cell_m))


@dataclass(frozen=True)
class SurfaceScores:
    """``f_2cm`` and ``f_5cm`` are harmonic means of the shares of the mesh near the truth and of the visible
    truth near the mesh. ``accuracy_m`` is the mean distance of the mesh to the truth, ``precision_2cm`` and
    ``found_2cm`` the two shares at 2 cm, ``normals_deg`` the median angle between normals. ``within_1_std``
    and ``within_2_std`` are shares of the vertices; NaN for a mesh without standard deviations."""

    f_2cm: float
    f_5cm: float
    accuracy_m: float
    precision_2cm: float
    found_2cm: float
    normals_deg: float
    within_1_std: float
    within_2_std: float

    def to_json(self) -> dict[str, Any]:
        """The fields by name."""
        return {f.name: float(getattr(self, f.name)) for f in fields(self)}


@dataclass(frozen=True)
class SurfaceTruth:
    """``everything`` that any image sees, against which a mesh is judged, and the part ``seen`` by the images
    that the map was made of, which the mesh should hold."""

    everything: OrientedPoints
    seen: OrientedPoints

    def scores(
        self,
        vertices_m: NDArray[np.float64],
        triangles: NDArray[np.int64],
        std_m: NDArray[np.floating] | None = None,
    ) -> SurfaceScores:
        """Judge a mesh: vertices (V, 3), triangles (T, 3) and standard deviations (V,), all in metres."""
        sampled = sample_mesh(vertices_m, triangles)
        distance, angle = plane_distance(sampled.points_m, sampled.normals, self.everything)
        back, _ = plane_distance(self.seen.points_m, self.seen.normals, sampled)
        shares = {}
        for tolerance in (0.02, 0.05):
            precision, found = float(np.mean(distance <= tolerance)), float(np.mean(back <= tolerance))
            shares[tolerance] = precision, found, 2 * precision * found / max(precision + found, 1e-12)
        near = distance <= 0.05
        within = [float("nan")] * 2
        if std_m is not None:
            used = np.unique(triangles)
            error, _ = plane_distance(vertices_m[used], None, self.everything)
            within = [float(np.mean(error <= k * std_m[used])) for k in (1, 2)]
        return SurfaceScores(
            shares[0.02][2], shares[0.05][2], float(distance.mean()), shares[0.02][0], shares[0.02][1],
            float(np.median(angle[near])) if near.any() else float("nan"), *within,
        )  # fmt: skip


def surface_truth(
    depths_m: Sequence[NDArray[np.float32]],
    poses: Sequence[Pose],
    camera: PinholeCamera,
    seen: Sequence[int],
    judged: Sequence[NDArray[np.bool_]] | None = None,
    cell_m: float = 0.015,
) -> SurfaceTruth:
    """The truth from clean axial depth images (H, W), 0 where nothing is; ``seen`` are the numbers of those
    that the map was made of, ``judged`` (H, W) the pixels whose surface it should hold, by default all."""
    everything = [depth_points(depth, T, camera) for depth, T in zip(depths_m, poses, strict=True)]
    parts = [everything[i] for i in seen]
    if judged is not None:
        masked = [np.where(judged[i], depths_m[i], np.float32(0)) for i in seen]
        parts = [depth_points(depth, poses[i], camera) for i, depth in zip(seen, masked, strict=True)]
    return SurfaceTruth(OrientedPoints.joined(everything, cell_m), OrientedPoints.joined(parts, cell_m))


def depth_points(depth_m: NDArray[np.float32], T_world_camera: Pose, camera: PinholeCamera) -> OrientedPoints:
    """The points of a depth image's pixels that lie on one surface with their neighbours."""
    points = camera.rays() * depth_m[..., None].astype(np.float64)
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normals = np.cross(across, down)
    length = np.linalg.norm(normals, axis=-1)
    around = np.stack([depth_m[1:-1, 2:], depth_m[1:-1, :-2], depth_m[2:, 1:-1], depth_m[:-2, 1:-1]])
    middle = depth_m[1:-1, 1:-1]
    smooth = (around > 0).all(axis=0) & (np.abs(around - middle).max(axis=0) < JUMP * middle)
    smooth &= (middle > 0) & (length > 0)
    normals, points = normals[smooth] / length[smooth][:, None], points[1:-1, 1:-1][smooth]
    normals *= -np.sign((normals * points).sum(axis=1))[:, None]  # towards the camera
    spacing = 0.5 * np.sqrt((across**2).sum(-1) + (down**2).sum(-1))[smooth]
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    return OrientedPoints(points @ R.T + t, normals @ R.T, spacing)


def sample_mesh(vertices_m: NDArray[np.float64], triangles: NDArray[np.int64]) -> OrientedPoints:
    """Points spread evenly over the area of a mesh, by fixed random numbers."""
    corners = vertices_m[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(double_area, 1e-30)[:, None]
    rng = np.random.default_rng(0)
    count = max(1, int(0.5 * double_area.sum() * SAMPLES_PER_M2))
    ends = np.cumsum(double_area)
    rows = np.searchsorted(ends, (np.arange(count) + rng.random(count)) / count * ends[-1])
    rows = np.minimum(rows, len(corners) - 1)
    a, b = rng.random((2, count, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    chosen = corners[rows]
    points = chosen[:, 0] + a * (chosen[:, 1] - chosen[:, 0]) + b * (chosen[:, 2] - chosen[:, 0])
    return OrientedPoints(points, normals[rows], np.full(count, 1.0 / np.sqrt(SAMPLES_PER_M2)))


def plane_distance(
    points_m: NDArray[np.float64], normals: NDArray[np.float64] | None, surface: OrientedPoints
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The distance of points (n, 3) to a surface, and the angle in degrees to its normal there, (n,) each."""
    _, nearest = surface.tree.query(points_m, workers=-1)
    apart = points_m - surface.points_m[nearest]
    normal = surface.normals[nearest]
    across = (apart * normal).sum(axis=1)
    aside = np.sqrt(np.maximum((apart**2).sum(axis=1) - across**2, 0.0))
    beyond = np.maximum(aside - surface.spacing_m[nearest], 0.0)
    distance = np.sqrt(across**2 + beyond**2)
    if normals is None:
        return distance, np.zeros(len(points_m))
    cosine = np.clip((normals * normal).sum(axis=1), -1, 1)
    return distance, np.degrees(np.arccos(cosine))
