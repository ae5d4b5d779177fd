"""The surfaces of an analytic scene as a triangle mesh.

Solids may overlap, so there are triangles inside of other solids too; no camera sees them.
"""

import math

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.synthetic.analytic_scene import Scene, Solid
from taichi_mrf.datasets.synthetic.mesh_scene import TriangleMesh


def scene_mesh(scene: Scene, sag_m: float = 5e-5) -> TriangleMesh:
    """All solids of a scene as one mesh. Boxes are exact; round solids have their corners on the true
    surface, and their triangles lie at most ``sag_m`` inside of it."""
    vertices: list[NDArray[np.float64]] = []
    triangles: list[NDArray[np.int64]] = []
    first = 0
    for solid in scene.solids:
        points, faces = _lathed(solid, sag_m)
        c, s = math.cos(solid.yaw), math.sin(solid.yaw)
        vertices.append(points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + solid.center)
        triangles.append(faces + first)
        first += len(points)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(triangles).astype(np.int32))


def _lathed(solid: Solid, sag_m: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners and triangles of a solid around the origin: rings of corners from its bottom to its top."""
    if solid.kind == "box":
        around = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * solid.half_size[:2]
        heights, widths = np.array([-1, -1, 1, 1]) * solid.half_size[2], np.array([0.0, 1.0, 1.0, 0.0])
    else:
        radius = solid.half_size[0]
        # Half the sag for each of a sphere's two directions.
        count = max(8, math.ceil(math.pi / math.acos(1 - min(0.5 * sag_m / radius, 0.5))))
        angle = 2 * np.pi * np.arange(count) / count
        around = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        if solid.kind == "sphere":
            rise = np.pi * (np.arange(count // 2 + 2) / (count // 2 + 1) - 0.5)
            heights, widths = radius * np.sin(rise), np.cos(rise)
        else:
            heights = np.array([-1, -1, 1, 1]) * solid.half_size[2]
            widths = np.array([0.0, 1.0, 1.0, 0.0])
    rings, count = len(heights), len(around)
    points = np.empty((rings, count, 3))
    points[..., :2] = widths[:, None, None] * around
    points[..., 2] = heights[:, None]
    ring, spoke = np.indices((rings - 1, count))
    here, beside = ring * count + spoke, ring * count + (spoke + 1) % count
    # The first and the last ring are points, where one triangle of each pair would have no area.
    lower = np.stack([here, beside, beside + count], axis=-1)[1:]
    upper = np.stack([here, beside + count, here + count], axis=-1)[:-1]
    return points.reshape(-1, 3), np.concatenate([lower, upper]).reshape(-1, 3)
