"""Looking at the map: what a camera would see in it, and what a single ray meets (the curves of the paper's
Fig. 7).
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.config.arguments import array
from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.queries.survey import Answers, Medium, Occlusion, SurfaceSurvey, occlusion, survey_rays
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.noise import CameraNoise, NoiseTable
from taichi_mrf.sensor.origins import widened
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, Struct, Template, Vec3
from taichi_mrf.voxels.layout import BRICK
from taichi_mrf.voxels.log_odds import logistic
from taichi_mrf.voxels.pool import BrickPool
from taichi_mrf.voxels.traversal import FAR, Space, clip, make_ray, walk_voxels
from taichi_mrf.voxels.window import Window, WindowIndex


@dataclass(frozen=True)
class RayProfile:
    """Profile of a ray, voxel by voxel, where bricks exist; all arrays (N,) float32.

    ``distance`` is the range in metres to the middle of the ray's segment in the voxel, ``length`` the
    segment's length in metres; ``occupancy`` the marginal, ``visibility`` the probability that the ray
    reaches the segment (eq. 15), ``omega`` the density, per metre, of the ray's surface being there (eq. 18).
    """

    distance: NDArray[np.float32]
    length: NDArray[np.float32]
    occupancy: NDArray[np.float32]
    visibility: NDArray[np.float32]
    omega: NDArray[np.float32]


@dataclass(frozen=True)
class ProfileArrays(Bundle):
    """Output of a ray's profile, one entry for each voxel: arrays (N,) as in RayProfile."""

    distance: F32Array
    length: F32Array
    occupancy: F32Array
    visibility: F32Array
    omega: F32Array


@ti.dataclass
class _Meet(Struct):
    """The ray on its way."""

    voxel_size: F32  # metres
    visibility: F32  # what is left of it
    count: I32  # voxels met


@dataclass(frozen=True)
class _Profiled(Bundle):
    belief: F32Array
    occlusion: Occlusion
    out: ProfileArrays


@ti.func
def _meet(meet: Template, profiled: Template, voxel: I32, near: F32, far: F32):
    """One voxel of the ray."""
    log_odds = profiled.belief[voxel]
    alpha = occlusion(log_odds, profiled.occlusion) / meet.voxel_size
    i = meet.count
    profiled.out.distance[i] = 0.5 * (near + far)
    profiled.out.length[i] = far - near
    profiled.out.occupancy[i] = logistic(log_odds)
    profiled.out.visibility[i] = meet.visibility
    profiled.out.omega[i] = alpha * meet.visibility
    meet.visibility *= ti.exp(-alpha * (far - near))
    meet.count += 1
    return 1


@kernel
def profile_ray(
    origin: Vec3, direction: Vec3, voxel_size: F32, max_range: F32, rule: Occlusion,
    space: Space, belief: F32Array, out: ProfileArrays, count: I32Array,
) -> None:  # fmt: skip
    """Follow one ray up to ``max_range`` metres.

    ``origin`` is in voxels from the window's corner, ``direction`` the way in voxels for one metre.
    ``belief`` (pool * 512) holds log-odds; ``count`` (1) receives the number of voxels met.
    """
    for _ in range(1):
        ray = make_ray(origin, direction)
        begin, end = 0.0, max_range
        clip(ray, begin, end, space.lower, space.upper)
        meet = _Meet(voxel_size, 1.0, 0)
        walk_voxels(ray, begin, end, space, _meet, meet, _Profiled(belief, rule, out))
        count[0] = meet.count


Answer = Literal["surface", "omega"]
"""End of a ray: on the measured surface near its likeliest voxel, or in that voxel alone."""

_ALL_DIM = Occlusion()
_NO_NOISE = NoiseTable(np.zeros((1, 2, 5), np.float32), 1 << 30, 1)


def viewed_box(
    camera: Camera, T_world_camera: Pose, max_depth: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The upright box, two corners (3,) in metres, around all that a camera sees up to ``max_depth``."""
    corners = camera.tile_hulls(max(camera.shape)).reshape(-1, 3) * max_depth
    points = np.concatenate([corners @ T_world_camera[:3, :3].T, np.zeros((1, 3))]) + T_world_camera[:3, 3]
    return widened(camera, T_world_camera, points.min(axis=0), points.max(axis=0))


class View:
    """Follows rays through a pool of bricks."""

    def __init__(
        self,
        pool: BrickPool,
        voxel_size: float,
        volume: VolumeConfig,
        occlusion: Occlusion = _ALL_DIM,
        predicting: Occlusion | None = None,
        index: WindowIndex | None = None,
    ) -> None:
        """``predicting`` takes the place of ``occlusion`` where measurements are predicted. ``index`` is that
        of another view of the map, if it is shared."""
        self.pool, self.voxel_size, self.volume, self.occlusion = pool, voxel_size, volume, occlusion
        self.predicting = occlusion if predicting is None else predicting
        self.index = WindowIndex() if index is None else index

    def with_occlusion(self, **changes: float) -> "View":
        """Another view of the same map, in which other voxels let rays through (fields of Occlusion)."""
        dims, predicts = (dataclasses.replace(rule, **changes) for rule in (self.occlusion, self.predicting))
        return View(self.pool, self.voxel_size, self.volume, dims, predicts, self.index)

    def render_depth(self, camera: Camera, T_world_camera: Pose, max_depth: float) -> NDArray[np.float32]:
        """(H, W) axial depth in metres, NaN where the ray is more likely to pass than to be stopped."""
        likeliest_m, stopped = self.likeliest_depth(camera, T_world_camera, max_depth)
        return np.where(stopped, likeliest_m, np.float32(np.nan))

    def likeliest_depth(
        self, camera: Camera, T_world_camera: Pose, max_depth: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Axial depth (H, W) in metres of the likeliest voxel, NaN where a ray meets none, and whether the
        ray is more likely to be stopped than to pass, (H, W).

        What was never seen dims a ray, but is no surface.
        """
        learnt = self.pool.prior_log_odds + self.volume.min_evidence
        survey = self._survey(camera, T_world_camera, max_depth, learnt, self.occlusion, None, _NO_NOISE)
        met = survey.far > 0
        return np.where(met, survey.middle, np.float32(np.nan)), met & (survey.visibility < 0.5)

    def survey(
        self,
        camera: Camera,
        T_world_camera: Pose,
        max_depth: float,
        measured_m: NDArray[np.float32],
        noise: CameraNoise,
        predicting: bool = False,
    ) -> SurfaceSurvey:
        """Follow the rays of those pixels of (H, W) ``measured_m`` that are not 0, up to ``max_depth``.

        ``noise`` is that of the measurements; a negative one stands for a pixel without. Every voxel can be
        the surface, seen or not. With ``predicting`` voxels dim rays by the rule for predictions.
        """
        rule = self.predicting if predicting else self.occlusion
        return self._survey(camera, T_world_camera, max_depth, -FAR, rule, measured_m, noise)

    def _survey(
        self,
        camera: Camera,
        T_world_camera: Pose,
        max_depth: float,
        learnt: float,
        rule: Occlusion,
        measured_m: NDArray[np.float32] | None,
        noise: CameraNoise,
    ) -> SurfaceSurvey:
        near, far, visibility, expected, likelihood = np.zeros((5, *camera.shape), np.float32)
        visibility[:] = 1.0
        survey = SurfaceSurvey(near, far, visibility, expected, likelihood)
        window = self.fill(np.stack(viewed_box(camera, T_world_camera, max_depth)))
        if window is None:
            return survey
        judged = measured_m is not None
        measured = np.zeros(1, np.float32) if measured_m is None else measured_m.reshape(-1)
        survey_rays(
            noise.sensor(camera), window[0].viewpoint(T_world_camera),
            self.index.space(window[0], self.volume.lower, self.volume.upper), self.pool.belief,
            Medium(self.voxel_size, max_depth, learnt, rule),
            np.ascontiguousarray(measured, np.float32),
            Answers(*(answer.reshape(-1) for answer in (near, far, visibility, expected, likelihood))),
            judged,
        )  # fmt: skip
        self.index.clear(*window)
        runtime.settle()
        return survey

    def ray_profile(self, origin: ArrayLike, direction: ArrayLike, max_range: float) -> RayProfile:
        """Follow one ray; ``direction`` need not be normalised. Raises ConfigError if it is no direction."""
        start, along = array(origin, "origin"), array(direction, "direction")
        length = float(np.linalg.norm(along))
        if (
            start.shape != (3,)
            or along.shape != (3,)
            or not np.isfinite(start).all()
            or not 0 < length < np.inf
        ):
            raise ConfigError("a ray needs an origin and a direction of three finite numbers")
        along = along / length
        window = self.fill(np.stack([start, start + along * max_range]))
        if window is None:
            return RayProfile(*[np.zeros(0, np.float32) for _ in range(5)])
        steps = 4 * sum(window[0].shape) * BRICK
        out = [np.zeros(steps, np.float32) for _ in range(5)]
        count = np.zeros(1, np.int32)
        profile_ray(
            ti.Vector(window[0].to_voxels(start).tolist(), ti.f32),
            ti.Vector((along / self.voxel_size).tolist(), ti.f32), self.voxel_size,
            max_range, self.occlusion,
            self.index.space(window[0], self.volume.lower, self.volume.upper), self.pool.belief,
            ProfileArrays(*out), count,
        )  # fmt: skip
        self.index.clear(*window)
        runtime.settle()
        return RayProfile(*[a[: count[0]].copy() for a in out])

    def fill(
        self,
        points_m: NDArray[np.float64],
        keep: Callable[[NDArray[np.int32]], NDArray[np.bool_]] | None = None,
    ) -> tuple[Window, NDArray[np.int32]] | None:
        """Index the bricks in the box around some points (n, 3); None if there are none.

        ``keep`` says of slots (n,) which of them to index, all if it is not given.

        Returns the window and its cells that were filled, with which ``index.clear`` must follow.
        """
        slots = self.pool.in_use
        brick_m = self.voxel_size * BRICK
        lower = np.floor(points_m.min(axis=0) / brick_m)
        upper = np.floor(points_m.max(axis=0) / brick_m)
        bricks = self.pool.bricks[slots]
        inside = ((bricks >= lower) & (bricks <= upper)).all(axis=1)
        if keep is not None and inside.any():
            inside[inside] = keep(slots[inside])
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
