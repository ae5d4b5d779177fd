"""Artefacts: occupied voxels that views which the map has not seen look through.

Each ray of a held-out depth image that meets an occupied voxel counts for or against it. If the voxel lies
wholly more than 3 sigma in front of what was measured, the ray has **passed** it; if the measurement lies
within 3 sigma of the ray's way through it, the ray **confirms** it. What lies behind the measurement is not
judged. A voxel that at least LEAST_RAYS rays have passed or confirmed is judged, and it is an artefact if a
clear majority of them has passed it. Held-out stereo errs too, and a voxel may hold a surface in one corner
only, so no single ray decides.

A map could avoid all artefacts by being empty, hence its **coverage**: the share of the held-out
measurements that have an occupied voxel on their ray within 3 sigma and one voxel size. Both depend on the
probability from which a voxel counts as occupied, and maps are compared at equal coverage.
"""
# ruff: noqa: ANN202 - Taichi does not allow `-> None` on a kernel or a func.

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.sensor.rays import CameraRays
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, Struct, Template
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, pixel_ray, walk_voxels
from taichi_mrf.voxels.window import Window, WindowIndex

SIGMAS = 3.0
"""Largest distance of a surface from its measurement, in sigmas."""

LEAST_RAYS = 10
"""Rays that must pass or confirm a voxel before it is judged."""

MAJORITY = 0.75
"""Share of these rays from which on they are a clear majority."""


@dataclass(frozen=True)
class Sightings:
    """Numbers of held-out rays that pass and confirm each of a map's voxels.

    ``centres`` (N, 3) metres, ``probability`` (N,), and the number of rays that ``passed`` and ``confirmed``
    each, (N,) int32. ``met`` (M,) is the highest probability of the voxels near each held-out measurement,
    -1 where there is none.
    """

    centres: NDArray[np.float64]
    probability: NDArray[np.float32]
    passed: NDArray[np.int32]
    confirmed: NDArray[np.int32]
    met: NDArray[np.float32]

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Voxels that enough rays have passed or confirmed, (N,)."""
        return self.passed + self.confirmed >= LEAST_RAYS

    def artefacts(self, majority: float = MAJORITY) -> NDArray[np.bool_]:
        """Judged voxels that at least this share of the rays has passed, (N,)."""
        return self.judged & (self.passed >= majority * (self.passed + self.confirmed))

    def coverage(self, occupied_from: float) -> float:
        """Share of the measurements near a voxel of at least this probability; NaN if there are none."""
        return float(np.mean(self.met >= occupied_from)) if len(self.met) else float("nan")


class MeasuredView(Protocol):
    """A depth image that the map has not seen: (H, W) axial depth in metres, 0 for no measurement, and its
    pose."""

    @property
    def measured_m(self) -> NDArray[np.float32]: ...
    @property
    def T_world_camera(self) -> Pose: ...


def sightings(
    m: OccupancyMap,
    views: Iterable[MeasuredView],
    camera: PinholeCamera,
    noise: NoiseModel,
    max_depth: float,
    least_probability: float,
) -> Sightings:
    """Follow all rays of ``views`` through the voxels of a map of at least this probability.

    Measurements beyond ``max_depth`` metres pass voxels like all others, but need no cover.
    """
    centres, probability = m.marginals.voxels(least_probability)
    voxels = np.floor(centres / m.voxel_size).astype(np.int32)
    bricks, brick_of = np.unique(voxels // BRICK, axis=0, return_inverse=True)
    number = np.ravel_multi_index(tuple((voxels % BRICK).T), (BRICK,) * 3)
    place = brick_of.reshape(-1) * VOXELS + number
    of_voxels = np.full(max(1, len(bricks)) * VOXELS, -1.0, np.float32)
    of_voxels[place] = probability
    probabilities = ti.ndarray(ti.f32, len(of_voxels))
    probabilities.from_numpy(of_voxels)
    passed, confirmed = (ti.ndarray(ti.i32, len(of_voxels)) for _ in range(2))

    corners = bricks if len(bricks) else np.zeros((1, 3), np.int32)
    edge = m.voxel_size * BRICK
    window = Window.covering(
        (corners.min(axis=0) + 0.25) * edge, (corners.max(axis=0) + 0.75) * edge, m.voxel_size
    )
    index = WindowIndex()
    index.fill(window, window.cells_of(bricks), np.arange(len(bricks), dtype=np.int32))
    table, seen = noise.table(camera), _Seen(probabilities, passed, confirmed)
    met = []
    for view in views:
        depth = np.ascontiguousarray(view.measured_m, np.float32)
        reach = (SIGMAS * table.at_pixels(depth)[0]).astype(np.float32)
        best = np.full(depth.size, -1.0, np.float32)
        _look(
            depth.reshape(-1), reach.reshape(-1), camera.in_kernels(), window.viewpoint(view.T_world_camera),
            index.space(window), seen, best,
        )  # fmt: skip
        met.append(best[(depth > 0).reshape(-1) & (depth <= max_depth).reshape(-1)])
    near = np.concatenate(met) if met else np.zeros(0, np.float32)
    found = Sightings(centres, probability, passed.to_numpy()[place], confirmed.to_numpy()[place], near)
    runtime.settle()  # before the arrays are dropped
    return found


@dataclass(frozen=True)
class _Seen(Bundle):
    """The occupied voxels. Arrays (bricks * 512)."""

    probability: F32Array
    """-1 for a voxel that is not occupied."""

    passed: I32Array
    """Rays that have passed the voxel."""

    confirmed: I32Array
    """Rays that confirm it."""


@ti.dataclass
class _Sight(Struct):
    near: F32  # axial depths between which the measured surface lies
    far: F32
    covers: F32  # depth from which a voxel covers the measurement
    best: F32  # highest probability of a voxel that does


@ti.func
def _see(sight: Template, seen: Template, voxel: I32, t: F32, t_leave: F32):
    """One voxel of a ray."""
    probability = seen.probability[voxel]
    if probability >= 0.0:
        if t_leave < sight.near:
            ti.atomic_add(seen.passed[voxel], 1)
        elif t < sight.far:
            ti.atomic_add(seen.confirmed[voxel], 1)
        if t_leave >= sight.covers:
            sight.best = ti.max(sight.best, probability)
    return 1


@kernel
def _look(
    depth: F32Array, reach: F32Array, camera: CameraRays, view: Viewpoint, space: Space, seen: _Seen,
    best: F32Array,
) -> None:  # fmt: skip
    """Follow the ray of each pixel. ``depth`` and ``reach`` are (H * W) metres, 0 without a measurement;
    ``best`` (H * W) receives the highest probability of a voxel near the measurement, -1 without one."""
    for pixel in range(depth.shape[0]):
        measured = depth[pixel]
        sight = _Sight(measured - reach[pixel], measured + reach[pixel], 0.0, -1.0)
        if measured > 0.0:
            u, v = camera.pixel(pixel)
            ray = pixel_ray(camera, view, u, v)
            one_voxel = 1.0 / ray.direction.norm()
            sight.covers = sight.near - one_voxel
            begin, end = 0.0, sight.far + one_voxel
            clip(ray, begin, end, space.lower, space.upper)
            walk_voxels(ray, begin, end, space, _see, sight, seen)
        best[pixel] = sight.best  # always: on Vulkan what a kernel does not write comes back undefined
