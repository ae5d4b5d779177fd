"""Signed distances of voxels to the surface that a keyframe's rays measured in and around them.

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

The third sum, of w (d^2 - sigma^2 - (voxel / 4)^2), is the square by which distances differ more than noise
lets them: where the bands of rays that met other surfaces reach the voxel too.

The sums are integers, so they do not depend on the order of rays and keyframes.
"""

from dataclasses import dataclass

from taichi_mrf.inference.keyframe import RayList
from taichi_mrf.inference.ray_list import listed_ray
from taichi_mrf.inference.ray_posterior import RayVisitor
from taichi_mrf.inference.sum_product import TINY
from taichi_mrf.sensor.forward import SUPPORT
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, I32Array, I64Array, IVec3, Template, Vec3, Vec4
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, walk_bricks, walk_voxels

SCALE = float(1 << 24)
"""Steps of the sums for a weight of 1."""

SURE = 0.99
"""P of a ray is not followed further than this."""


@dataclass(frozen=True)
class Band(Bundle):
    """The band to either side of its surface in which a ray counts."""

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

    excess: I64Array
    """Of this weight times (d^2 - sigma^2 - (voxel / 4)^2), in voxels^2: about 0 if all rays measured one
    surface that passes through the voxel."""


@dataclass(frozen=True)
class _Marked(Bundle):
    """The bricks of a window: its shape, and a mark for each."""

    shape: IVec3
    marks: I32Array


@dataclass(frozen=True)
class AddDistances(RayVisitor):
    """Adds the distances of rays to the bricks of ``space``, in the same window as those of the map. A ray is
    followed from the camera until P can only be SURE or more, and then along its band."""

    outliers: F32
    """o."""

    band: Band
    space: Space
    sums: DistanceSums

    @ti.func
    def reach(self, sensor: Template, model: Template, measured: F32, noise: Template, to_voxels: F32):
        return _reach_of(sensor, measured, noise, self.band, to_voxels)

    @ti.func
    def meet(self, ahead: Template, sight: Template, voxel: I32, here: F32):
        return ti.cast(ahead.explained * (1.0 - SURE) < self.outliers * SURE, ti.i32)

    @ti.func
    def end(self, ahead: Template, sight: Template, beyond: F32):
        met = ahead.explained + TINY + beyond
        weight = sight.pixels * met / (met + self.outliers)
        begin, end = sight.reach[2], sight.reach[3]
        clip(sight.ray, begin, end, self.space.lower, self.space.upper)
        walk_voxels(
            sight.ray, begin, end, self.space, _add_distance, ahead, _Measured(sight, self.sums, weight)
        )


@dataclass(frozen=True)
class _Measured(Bundle):
    """One ray, and all that a step along its band needs."""

    sight: Template
    sums: DistanceSums
    weight: F32  # pixels times P


@kernel
def mark_band(
    rays: RayList, scouts: I32, sensor: Sensor, view: Viewpoint, shape: IVec3, lower: Vec3, upper: Vec3,
    band: Band, marks: I32Array,
) -> None:  # fmt: skip
    """Mark the bricks that lie in the bands of every ``scouts``-th ray. ``marks`` (bricks of the window) are
    those of a window of ``shape`` bricks; ``lower`` and ``upper`` bound its mapped part, in voxels."""
    for scout in range((rays.number + scouts - 1) // scouts):
        i = scout * scouts
        ray, noise, _ = listed_ray(rays, i, sensor, view)
        reach = _reach_of(sensor, rays.depth[i], noise, band, ray.direction.norm())
        begin, end = reach[2], reach[3]
        clip(ray, begin, end, lower, upper)
        state = 0
        walk_bricks(ray, begin, end, shape, marks, False, _mark_brick, state, _Marked(shape, marks))


@ti.func
def _reach_of(sensor: Template, measured: F32, noise: Template, band: Template, to_voxels: F32) -> Vec4:
    """Depths of a ray: before which no surface can have made its measurement, where it ends, and between
    which its band lies. ``to_voxels`` is its length, in voxels, for one metre of depth."""
    surface, least = sensor.surface_depth(measured, noise), band.voxels / to_voxels
    nearest = sensor.nearest_depth(measured, noise, band.sigmas)
    farthest = sensor.farthest_depth(measured, noise, band.sigmas)
    # In front sigma is smaller: this is further in front than the exact depth.
    support = surface - (surface - nearest) * (SUPPORT / band.sigmas)
    begin, end = ti.max(0.0, ti.min(nearest, surface - least)), ti.max(farthest, surface + least)
    return Vec4(support, farthest, begin, ti.min(end, band.max_depth))


@ti.func
def _mark_brick(state: Template, marked: Template, ray: Template, brick: IVec3, t: F32, t_leave: F32):
    """Mark one brick of a band."""
    cell = flat(brick, marked.shape)
    if marked.marks[cell] == 0:  # a NumPy array that is not read comes back from Vulkan undefined elsewhere
        marked.marks[cell] = 1
    return 1


@ti.func
def _add_distance(state: Template, measured: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a band."""
    ray, noise, to_voxels = measured.sight.ray, measured.sight.noise, measured.sight.voxels_per_depth
    centre = ti.floor(ray.origin + 0.5 * (near + far) * ray.direction) + 0.5
    depth = (centre - ray.origin).dot(ray.direction) / (to_voxels * to_voxels)
    distance = (measured.sight.measured - noise.bias(depth) - depth) * to_voxels
    sigma = noise.sigma(depth) * to_voxels
    variance = sigma * sigma + 1.0 / 16.0
    weight = measured.weight * (far - near) * to_voxels / (16.0 * variance)
    excess = distance * distance - variance
    ti.atomic_add(measured.sums.weight[voxel], ti.cast(weight * SCALE, ti.i64))
    ti.atomic_add(measured.sums.distance[voxel], ti.cast(weight * distance * SCALE, ti.i64))
    ti.atomic_add(measured.sums.excess[voxel], ti.cast(weight * excess * SCALE, ti.i64))
    return 1
