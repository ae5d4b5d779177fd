"""Looking at the map: what a camera would see in it, and what a single ray meets.

Occupancy is read as a medium: a voxel of probability p has the occlusion density
alpha = -ln(1 - p) / voxel size, and the ray sees through it accordingly (eqs. 15 to 18).
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike, NDArray

from taichi_mrf import runtime
from taichi_mrf.camera import PinholeCamera
from taichi_mrf.config import VolumeConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.inference.log_odds import softplus
from taichi_mrf.inference.rays import pixel_direction
from taichi_mrf.poses import Pose
from taichi_mrf.voxels.layout import BRICK
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.traversal import clip, make_ray, walk_voxels
from taichi_mrf.voxels.types import F32, I32, F32Array, I32Array, IVec3, Mat3, Struct, Template, Vec3, Vec4
from taichi_mrf.voxels.window import Window, WindowIndex

OPAQUE = 1e-3
"""A ray that has lost this much of its visibility meets nothing more."""


@dataclass(frozen=True)
class RayProfile:
    """What a ray meets, voxel by voxel, where bricks exist; all arrays (N,) float32.

    ``distance`` is the range in metres to the middle of the ray's segment in the voxel, ``length`` the
    segment's length in metres; ``occupancy`` the marginal, ``visibility`` what is left of the ray at the
    segment's begin (eq. 15), ``omega`` the density, per metre, of the ray's surface being there (eq. 18).
    """

    distance: NDArray[np.float32]
    length: NDArray[np.float32]
    occupancy: NDArray[np.float32]
    visibility: NDArray[np.float32]
    omega: NDArray[np.float32]


class View:
    """Follows rays through a pool of bricks."""

    def __init__(self, pool: BrickPool, voxel_size: float, volume: VolumeConfig) -> None:
        self.pool, self.voxel_size, self.volume = pool, voxel_size, volume
        self.index = WindowIndex()

    def render_depth(
        self, camera: PinholeCamera, T_world_camera: Pose, max_depth: float
    ) -> NDArray[np.float32]:
        """(H, W) axial depth in metres, NaN where the ray is more likely to pass than to be stopped."""
        depth = np.full(camera.height * camera.width, np.nan, np.float32)
        u = np.array([-0.5, camera.width - 0.5])
        v = np.array([-0.5, camera.height - 0.5])
        x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        corners = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) * max_depth
        points = (
            np.concatenate([corners @ T_world_camera[:3, :3].T, np.zeros((1, 3))]) + T_world_camera[:3, 3]
        )
        window = self._fill(points)
        if window is None:
            return depth.reshape(camera.shape)
        centre, to_voxels = window[0].rays_of(T_world_camera)
        lower, upper = window[0].clip_box(self.volume.lower, self.volume.upper)
        _render(
            camera.width, ti.Vector([camera.fx, camera.fy, camera.cx, camera.cy], ti.f32), centre, to_voxels,
            max_depth, self.pool.prior_log_odds + self.volume.min_evidence,
            window[0].shape_vector, lower, upper,
            self.index.chunks, self.index.bricks, self.pool.belief, depth,
        )  # fmt: skip
        self.index.clear(*window)
        runtime.settle()
        depth[depth <= 0] = np.nan
        return depth.reshape(camera.shape)

    def ray_profile(self, origin: ArrayLike, direction: ArrayLike, max_range: float) -> RayProfile:
        """Follow one ray; ``direction`` need not be normalised. Raises ConfigError if it is no direction."""
        start, along = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
        length = float(np.linalg.norm(along))
        if (
            start.shape != (3,)
            or along.shape != (3,)
            or not np.isfinite(start).all()
            or not 0 < length < np.inf
        ):
            raise ConfigError("a ray needs an origin and a direction of three finite numbers")
        along = along / length
        window = self._fill(np.stack([start, start + along * max_range]))
        if window is None:
            return RayProfile(*[np.zeros(0, np.float32) for _ in range(5)])
        steps = 4 * sum(window[0].shape) * BRICK
        out = [np.zeros(steps, np.float32) for _ in range(5)]
        count = np.zeros(1, np.int32)
        lower, upper = window[0].clip_box(self.volume.lower, self.volume.upper)
        _profile(
            ti.Vector(window[0].to_voxels(start).tolist(), ti.f32),
            ti.Vector((along / self.voxel_size).tolist(), ti.f32), self.voxel_size,
            max_range, window[0].shape_vector, lower, upper,
            self.index.chunks, self.index.bricks, self.pool.belief, *out, count,
        )  # fmt: skip
        self.index.clear(*window)
        runtime.settle()
        return RayProfile(*[a[: count[0]].copy() for a in out])

    def _fill(self, points_m: NDArray[np.float64]) -> tuple[Window, NDArray[np.int32]] | None:
        """Index the bricks in the box around some points; None if there are none."""
        slots = self.pool.in_use
        brick_m = self.voxel_size * BRICK
        lower = np.floor(points_m.min(axis=0) / brick_m)
        upper = np.floor(points_m.max(axis=0) / brick_m)
        bricks = self.pool.bricks[slots]
        inside = ((bricks >= lower) & (bricks <= upper)).all(axis=1)
        if not inside.any():
            return None
        slots, bricks = slots[inside], bricks[inside]
        middle = 0.5 * self.voxel_size
        window = Window.covering(
            bricks.min(axis=0) * brick_m + middle, bricks.max(axis=0) * brick_m + middle, self.voxel_size
        )
        cells = window.cells_of(bricks)
        self.index.fill(window, cells, slots)
        return window, cells


@ti.dataclass
class _Look(Struct):
    per_t: F32  # voxels for one unit of t
    learnt: F32  # log-odds above which a voxel is more than its prior
    visibility: F32
    best: F32
    depth: F32


@ti.func
def _look(look: Template, context: Template, voxel: I32, near: F32, far: F32):
    density = softplus(context[0][voxel])  # alpha times the voxel size
    omega = density * look.visibility
    # What was never seen dims the ray as eq. 15 has it, but is no surface.
    if omega > look.best and context[0][voxel] > look.learnt:
        look.best = omega
        look.depth = 0.5 * (near + far)
    look.visibility *= ti.exp(-density * (far - near) * look.per_t)
    return ti.cast(look.visibility > OPAQUE, ti.i32)


@ti.kernel
def _render(
    width: I32, intrinsics: Vec4, centre: Vec3, to_voxels: Mat3,
    max_depth: F32, learnt: F32, shape: IVec3, lower: Vec3, upper: Vec3,
    chunks: I32Array, bricks: I32Array, belief: F32Array, depth: F32Array,
):  # fmt: skip
    """The segment's middle at the argmax of omega (eq. 18, section III-D), for every pixel."""
    for pixel in range(depth.shape[0]):
        direction = to_voxels @ pixel_direction(pixel % width, pixel // width, intrinsics)
        ray = make_ray(centre, direction)
        begin, end = 0.0, max_depth
        clip(ray, begin, end, lower, upper)
        look = _Look(direction.norm(), learnt, 1.0, 0.0, 0.0)
        walk_voxels(ray, begin, end, shape, chunks, bricks, _look, look, (belief,))
        depth[pixel] = look.depth if look.visibility < 0.5 else 0.0


@ti.dataclass
class _Meet(Struct):
    voxel_size: F32
    visibility: F32
    count: I32


@ti.func
def _meet(meet: Template, context: Template, voxel: I32, near: F32, far: F32):
    alpha = softplus(context[0][voxel]) / meet.voxel_size
    i = meet.count
    context[1][i] = 0.5 * (near + far)
    context[2][i] = far - near
    context[3][i] = 1.0 - ti.exp(-alpha * meet.voxel_size)
    context[4][i] = meet.visibility
    context[5][i] = alpha * meet.visibility
    meet.visibility *= ti.exp(-alpha * (far - near))
    meet.count += 1
    return 1


@ti.kernel
def _profile(
    origin: Vec3, direction: Vec3, voxel_size: F32, max_range: F32, shape: IVec3, lower: Vec3, upper: Vec3,
    chunks: I32Array, bricks: I32Array, belief: F32Array,
    distance: F32Array, length: F32Array, occupancy: F32Array, visibility: F32Array, omega: F32Array,
    count: I32Array,
):  # fmt: skip
    for _ in range(1):
        ray = make_ray(origin, direction)
        begin, end = 0.0, max_range
        clip(ray, begin, end, lower, upper)
        meet = _Meet(voxel_size, 1.0, 0)
        walk_voxels(
            ray, begin, end, shape, chunks, bricks, _meet, meet,
            (belief, distance, length, occupancy, visibility, omega),
        )  # fmt: skip
        count[0] = meet.count
