"""Orientation of the map's surfaces, and the up direction: what a picture needs beyond the voxels.

A map holds neither the direction of gravity nor the inside of a room. Both follow from what the keyframes
see: a surface faces the camera that saw it, and most of a room is level or upright.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.up import Z_UP, Up, up_vector
from taichi_mrf.methods.protocol import OccupancyMap, PosedDepth
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.unrolled import covering
from taichi_mrf.voxels.layout import grid_keys

_VIEWS = 60
"""Keyframes that are looked through, at most: more see the same surfaces again."""

_VIEW_WIDTH = 160
"""Width in pixels of the depth images that normals are taken from."""

_VIEW_PIXELS = 160 * 120
"""About so many pixels have those of cameras that are no pinholes."""

_RINGS = 2
"""Rings of neighbouring cells that ``thickened`` adds."""

_NEIGHBOURS = np.array([(i << 42) + (j << 21) + k for i, j, k in np.ndindex(3, 3, 3)], dtype=np.int64) - (
    (1 << 42) + (1 << 21) + 1
)
"""Steps from a cell's key to its own and to those of the 26 cells around it."""


@dataclass(frozen=True)
class Surfaces:
    """Mean normals of the seen surfaces on a coarse grid, world frame."""

    cell_m: float
    """Side of a cell in metres."""

    keys: NDArray[np.int64]
    """Sorted keys of the cells that hold a surface, (C,)."""

    normals: NDArray[np.float32]
    """Mean of the unit normals in each cell, (C, 3), towards where the surface was seen from. Its length
    is how well they agree: 1 in a plane, 0.7 at a square edge."""

    def normals_at(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """The normals of points (N, 3); 0 where nothing was seen."""
        out = np.zeros((len(points), 3), np.float32)
        if self.keys.size:
            wanted = cell_keys(points, self.cell_m)
            at = np.minimum(np.searchsorted(self.keys, wanted), self.keys.size - 1)
            seen = self.keys[at] == wanted
            out[seen] = self.normals[at[seen]]
        return out

    def thickened(self) -> "Surfaces":
        """Surfaces with the cells around: a mapped surface is some voxels thick, and seen from one side."""
        keys, normals = self.keys, self.normals
        for _ in range(_RINGS):
            around = (keys[:, None] + _NEIGHBOURS).ravel()
            empty = ~np.isin(around, keys)
            more_keys, more = mean_vectors(around[empty], np.repeat(normals, len(_NEIGHBOURS), axis=0)[empty])
            keys, normals = np.concatenate([keys, more_keys]), np.concatenate([normals, more])
            order = np.argsort(keys)
            keys, normals = keys[order], normals[order]
        return Surfaces(self.cell_m, keys, normals)


def seen_surfaces(m: OccupancyMap) -> Surfaces:
    """Render the map from its keyframes and average the surface normals in cells of four voxels."""
    cell_m = 4.0 * m.voxel_size
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    keyframes = list(m.keyframes.values())
    for at in np.unique(np.linspace(0, len(keyframes) - 1, _VIEWS).round().astype(int)) if keyframes else ():
        keyframe = keyframes[at]
        camera = _small_view(keyframe.camera)
        depth_m = m.render_depth(camera, keyframe.T_world_camera, by="omega")
        p, n = _normals(depth_m, camera, step_m=cell_m)
        R, t = keyframe.T_world_camera[:3, :3], keyframe.T_world_camera[:3, 3]
        points.append((p - 0.5 * m.voxel_size * n) @ R.T + t)  # from the voxel's face into the voxel
        normals.append(n @ R.T)
    keys, means = mean_vectors(cell_keys(np.concatenate(points), cell_m), np.concatenate(normals))
    return Surfaces(cell_m, keys, means)


def _small_view(camera: Camera) -> Camera:
    """A camera that sees about the same with fewer pixels."""
    if isinstance(camera, PinholeCamera):
        return camera.scaled(min(1.0, _VIEW_WIDTH / camera.width))
    return covering(camera, min(_VIEW_PIXELS, camera.width * camera.height))


def up_direction(
    upwards: Iterable[NDArray[np.floating]], normals: NDArray[np.floating], otherwise: Up = Z_UP
) -> NDArray[np.float64]:
    """Unit vector that points up, (3,), world frame.

    The first guess is the mean of ``upwards``, (3,) each, the cameras' upward axes (:func:`upward_axis`). It
    is tilted where the camera looked down most of the time, so it is refined as by Gupta, Arbelaez and Malik
    (CVPR 2013, section 4): the direction that is most parallel to the nearly parallel surface normals (N, 3),
    of any length, and most perpendicular to the nearly perpendicular ones. Without cameras it is
    ``otherwise``.
    """
    axes = list(upwards)
    mean = np.mean(axes, axis=0) if axes else np.zeros(3)
    if np.linalg.norm(mean) < 0.1:
        return up_vector(otherwise)
    up = mean / np.linalg.norm(mean)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(lengths, 1e-12)
    for limit_deg in (45.0, 45.0, 30.0, 15.0, 15.0):
        cosine = np.abs(normals @ up)
        level = normals[cosine > np.cos(np.deg2rad(limit_deg))]
        upright = normals[cosine < np.sin(np.deg2rad(limit_deg))]
        if len(level) + len(upright) < 3:
            break
        spread = upright.T @ upright - level.T @ level
        axis = np.linalg.eigh(spread.astype(np.float64))[1][:, 0]
        up = axis if axis @ up > 0 else -axis
    return up


def upward_axis(keyframe: PosedDepth) -> NDArray[np.float64]:
    """The upward axis of a keyframe's camera in the world, (3,)."""
    return keyframe.T_world_camera[:3, :3] @ np.asarray(keyframe.camera.up)


def level_rotation(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """R_level_world (3, 3): the smallest rotation that turns ``up`` (a unit vector) to +z."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + cosine)


def _normals(
    depth_m: NDArray[np.floating], camera: Camera, step_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and unit normals towards the camera of a depth image, (N, 3) each, camera frame.

    Differences span about ``step_m`` on the surface (several voxels, whose steps would show
    otherwise) and never cross an edge where the depth jumps.
    """
    depth = np.asarray(depth_m, np.float64)
    points = camera.rays() * depth[..., None]
    middle = float(np.nanmedian(depth_m)) if np.isfinite(depth_m).any() else 1.0
    step = max(1, round(0.5 * step_m * camera.pixels_per_radian / middle))
    if min(camera.shape) <= 2 * step:
        return np.zeros((0, 3)), np.zeros((0, 3))
    inner = slice(step, -step)
    across = points[inner, 2 * step :] - points[inner, : -2 * step]
    down = points[2 * step :, inner] - points[: -2 * step, inner]
    normal = np.cross(down, across)
    length = np.linalg.norm(normal, axis=-1)
    beside = np.abs(depth[inner, 2 * step :] - depth[inner, : -2 * step])
    steep = np.maximum(beside, np.abs(depth[2 * step :, inner] - depth[: -2 * step, inner])) > 4.0 * step_m
    ok = np.isfinite(length) & (length > 0) & ~steep & np.isfinite(depth[inner, inner])
    return points[inner, inner][ok], normal[ok] / length[ok][:, None]


def mean_vectors(
    keys: NDArray[np.int64], vectors: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The distinct keys (C,), sorted, and the mean of the vectors (N, 3) that share each, (C, 3)."""
    distinct, group, count = np.unique(keys, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(group, v, minlength=distinct.size) for v in vectors.T], axis=-1)
    return distinct, (sums / count[:, None]).astype(np.float32)


def cell_keys(points: NDArray[np.floating], cell_m: float) -> NDArray[np.int64]:
    """One integer for each cell that a point (N, 3) lies in, (N,); 21 bits an axis."""
    return grid_keys(np.floor(np.asarray(points) / cell_m))
