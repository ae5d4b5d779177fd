"""What the rays of a keyframe say of the surface in and around each voxel: signed distances.

A voxel whose centre lies at depth t on a ray with the measurement z gets the distance

    d = z - bias(t) - t        with the weight        w = P l / (sigma(t)^2 + (voxel / 4)^2)

for each of the ray's pixels, in metres along the ray, where l is the length of its way through the voxel.
Noise is that of a surface at the voxel: at the measurement, rays that err towards the camera would look more
precise than others, and draw the surface nearer. With the marginals m of the
map, and o for a measurement from anywhere in the sensor's range,

    P = (E + B) / (E + B + o)        E = sum_i nu_i m_i vis_i, B the same for what lies beyond the map    (4)

is the posterior probability that the ray met a surface at all: a pixel of something that came and went, or an
outlier, has none. A ray reaches as far as its band, the depths that are within 2 voxels or 3 sigma of the
measurement. Free space in front of the band gets nothing, so that what lies behind a thin wall is no surface.

The sums are integers, so they do not depend on the order of rays and keyframes.
"""

from dataclasses import dataclass

import taichi as ti

from taichi_mrf.inference.keyframe import RayList
from taichi_mrf.inference.ray_list import listed_ray
from taichi_mrf.inference.ray_posterior import RayVisitor
from taichi_mrf.inference.sum_product import TINY
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, I64Array, IVec3, Template, Vec2, Vec3
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, walk_bricks, walk_voxels

SCALE = float(1 << 24)
"""Steps of the sums for a weight of 1."""

SURE = 0.999
"""P of a ray is not followed further than this."""


@dataclass(frozen=True)
class Band(Bundle):
    """How far to either side of its surface a ray counts."""

    voxels: F32
    """At least so many voxels,"""

    sigmas: F32
    """and at least so many standard deviations."""

    max_depth: F32
    """Metres of depth that no ray goes beyond."""


@dataclass(frozen=True)
class DistanceSums(Bundle):
    """Sums over rays for the voxels of some bricks. Arrays (bricks * 512), in units of 1 / SCALE."""

    weight: I64Array
    """Of w, times (voxel / 4)^2: a pixel with a small sigma has the weight l."""

    distance: I64Array
    """Of this weight times d in voxels."""


@dataclass(frozen=True)
class _Measured(Bundle):
    """One ray, and all that a step along its band needs."""

    ray: Template
    sums: DistanceSums
    measured: F32
    noise: Template  # of its pixel
    to_voxels: F32  # length of the ray, in voxels, for one metre of depth
    weight: F32  # pixels times P


@dataclass(frozen=True)
class _Marked(Bundle):
    """The bricks of a window: its shape, and a mark for each."""

    shape: IVec3
    marks: I32Array


@dataclass(frozen=True)
class FindTrust(RayVisitor):
    """Finds P of each ray, which ends where P can only be SURE or more."""

    outliers: F32
    """o."""

    trust: F32Array
    """(rays): receives P."""

    @ti.func
    def meet(self, ahead: Template, sight: Template, voxel: I32, here: F32):
        return ti.cast(ahead.explained * (1.0 - SURE) < self.outliers * SURE, ti.i32)

    @ti.func
    def end(self, ahead: Template, sight: Template, beyond: F32):
        met = ahead.explained + TINY + beyond
        self.trust[sight.number] = met / (met + self.outliers)


@kernel
def mark_band(
    rays: RayList, sensor: Sensor, view: Viewpoint, shape: IVec3, lower: Vec3, upper: Vec3, band: Band,
    marks: I32Array,
) -> None:  # fmt: skip
    """Mark the bricks that lie in the bands of rays. ``marks`` (bricks of the window) are those of a window
    of ``shape`` bricks; ``lower`` and ``upper`` bound its mapped part, in voxels."""
    for i in range(rays.number):
        ray, noise, _ = listed_ray(rays, i, sensor, view)
        reach = _band_of(rays.depth[i], noise, sensor, band, ray.direction.norm())
        begin, end = reach[0], reach[1]
        clip(ray, begin, end, lower, upper)
        state = 0
        walk_bricks(ray, begin, end, shape, marks, False, _mark_brick, state, _Marked(shape, marks))


@kernel
def add_distances(
    rays: RayList, trust: F32Array, sensor: Sensor, view: Viewpoint, space: Space, band: Band,
    sums: DistanceSums,
) -> None:  # fmt: skip
    """Add the distances of a keyframe's rays, whose P are ``trust`` (rays), to the bricks of ``space``."""
    for i in range(rays.number):
        ray, noise, pixels = listed_ray(rays, i, sensor, view)
        to_voxels = ray.direction.norm()
        reach = _band_of(rays.depth[i], noise, sensor, band, to_voxels)
        begin, end = reach[0], reach[1]
        clip(ray, begin, end, space.lower, space.upper)
        state = 0
        measured = _Measured(ray, sums, rays.depth[i], noise, to_voxels, pixels * trust[i])
        walk_voxels(ray, begin, end, space, _add_distance, state, measured)


@ti.func
def _band_of(measured: F32, noise: Template, sensor: Template, band: Template, to_voxels: F32) -> Vec2:
    """The depths between which a ray's band lies."""
    surface, least = sensor.surface_depth(measured, noise), band.voxels / to_voxels
    nearest = ti.min(surface - least, sensor.nearest_depth(measured, noise, band.sigmas))
    farthest = ti.max(surface + least, sensor.farthest_depth(measured, noise, band.sigmas))
    return Vec2(ti.max(0.0, nearest), ti.min(farthest, band.max_depth))


@ti.func
def _mark_brick(state: Template, marked: Template, ray: Template, brick: IVec3, t: F32, t_leave: F32):
    """Mark one brick of a band."""
    marked.marks[flat(brick, marked.shape)] = 1
    return 1


@ti.func
def _add_distance(state: Template, measured: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a band."""
    ray = measured.ray
    centre = ti.floor(ray.origin + 0.5 * (near + far) * ray.direction) + 0.5
    depth = (centre - ray.origin).dot(ray.direction) / (measured.to_voxels * measured.to_voxels)
    distance = (measured.measured - measured.noise.bias(depth) - depth) * measured.to_voxels
    sigma = measured.noise.sigma(depth) * measured.to_voxels
    weight = measured.weight * (far - near) * measured.to_voxels / (16.0 * sigma * sigma + 1.0)
    ti.atomic_add(measured.sums.weight[voxel], ti.cast(weight * SCALE, ti.i64))
    ti.atomic_add(measured.sums.distance[voxel], ti.cast(weight * distance * SCALE, ti.i64))
    return 1
