"""Depth at which rays meet the surface that keyframes measured, near their likeliest voxel.

The likeliest voxel of a ray (eq. 18) is as coarse as the grid, and lies before the surface where sigma is
wider than a voxel. The measured surface is where the mean of the signed distances passes through 0
(inference/surface_rays.py). It is more exact, but has holes, through which a ray meets what is behind. So a
ray is followed around its likeliest voxel alone: it ends where it comes from a positive distance to a
negative one, if that is near the voxel along the surface's normal, and not in the midst of free space, where
rays with a large sigma leave such places in front of a surface.
"""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.queries.view import viewed_box
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.noise import NoiseTable
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, IVec3, Template, Vec3, Vec4
from taichi_mrf.voxels.blended_field import blended, cell_of
from taichi_mrf.voxels.distance_field import LEAST_WEIGHT, DistanceField
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.numbering import voxel_number
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, pixel_ray, voxel_in
from taichi_mrf.voxels.window import Window, WindowIndex

NEAR_VOXELS, NEAR_M = 1.5, 0.075
"""Distance, along the surface's normal, at which the likeliest voxel of a ray and its surface still are the
same. In metres too, since a sensor's errors move the likeliest of small voxels; along the normal, because
rays that graze a surface run along it."""

GRAZING = 3.0
"""A ray is followed so many times that far to either side of its likeliest voxel: those that meet a surface
at less than 19 degrees may end in the voxel instead."""

AROUND = 2
"""There is no surface where the map takes all voxels for free that the ray crosses up to so many voxel sizes
before and behind it."""

STEP = 0.5
"""Voxels between the places at which a ray reads its distance."""

WORDS = VOXELS // 32
"""Words of 32 bits that have a bit for each voxel of a brick."""

NONE = 1e6
"""Stands for a distance that no ray measured."""

_NO_NOISE = NoiseTable(np.zeros((1, 2, 5), np.float32), 1 << 30, 1)


class MeasuredDepth:
    """The surface of a field of signed distances, as rays meet it."""

    def __init__(self, field: DistanceField, free: NDArray[np.bool_], voxel_size: float) -> None:
        """``free`` are the voxels of the field's bricks, (bricks, 512), that the map takes for free;
        ``voxel_size`` is in metres."""
        self._bricks, self._voxel_size = field.bricks, voxel_size
        self._free = ti.ndarray(ti.i32, max(1, len(field.bricks)) * WORDS)
        if len(field.bricks):
            self._free.from_numpy(np.packbits(free, axis=1, bitorder="little").view("<i4").reshape(-1))
        self._mean = ti.ndarray(ti.f32, max(1, len(field.bricks)) * VOXELS)
        self._index = WindowIndex()
        if len(field.bricks):
            around = field.rows_around().reshape(-1)
            _blend(field.weight.reshape(-1), field.distance.reshape(-1), around, self._mean)
            runtime.settle()

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return 4 * (self._mean.shape[0] + self._free.shape[0] + self._index.bricks.shape[0])

    def near(
        self, depth_m: NDArray[np.float32], camera: Camera, T_world_camera: Pose, max_depth: float
    ) -> NDArray[np.float32]:
        """Axial depth (H, W) of the surface where it is near ``depth_m`` (H, W), that of the likeliest
        voxels; NaN elsewhere, and where that is NaN or 0."""
        found = np.zeros(camera.shape, np.float32)
        box = viewed_box(camera, T_world_camera, max_depth)
        bricks = np.floor(np.stack(box) / (self._voxel_size * BRICK))
        rows = np.flatnonzero(((self._bricks >= bricks[0] - 1) & (self._bricks <= bricks[1] + 1)).all(axis=1))
        if len(rows):
            middle_m = (self._bricks[rows] + 0.5) * (self._voxel_size * BRICK)
            window = Window.covering(middle_m.min(axis=0), middle_m.max(axis=0), self._voxel_size)
            cells = window.cells_of(self._bricks[rows])
            self._index.fill(window, cells, rows.astype(np.int32))
            _meet(
                _NO_NOISE.sensor(camera), window.viewpoint(T_world_camera), self._index.space(window),
                self._mean, self._free, np.nan_to_num(depth_m).astype(np.float32).reshape(-1),
                max(NEAR_VOXELS, NEAR_M / self._voxel_size), found.reshape(-1),
            )  # fmt: skip
            runtime.settle()
            self._index.clear(window, cells)
        return np.where(found > 0, found, np.float32(np.nan))


@kernel
def _blend(weight: F32Array, distance: F32Array, around: I32Array, mean: F32Array) -> None:
    """The mean distance of each voxel, (bricks * 512), NONE without one: sums of ``weight`` and of
    ``distance`` times weight, blended as voxels.distance_field.blended_sums has it. ``around`` (bricks * 27)
    are the rows of the bricks around each, -1 where there is none."""
    for i in range(mean.shape[0]):
        mean[i] = NONE
        if weight[i] > 0.0:
            sums = blended(weight, distance, around, i // VOXELS, cell_of(i % VOXELS))
            if sums[0] > LEAST_WEIGHT:
                mean[i] = sums[1] / sums[0]


@kernel
def _meet(
    sensor: Sensor, view: Viewpoint, space: Space, mean: F32Array, free: I32Array, depth: F32Array, near: F32,
    found: F32Array,
) -> None:  # fmt: skip
    """The depth of the surface on the ray of each pixel, into ``found`` (H * W), 0 where there is none near
    the likeliest voxel at ``depth`` (H * W), both in metres; ``near`` is in voxels, and ``free`` (bricks *
    WORDS) has a bit for each voxel."""
    for pixel in range(found.shape[0]):
        found[pixel] = 0.0
        if depth[pixel] > 0.0:
            u, v = sensor.pixel(pixel)
            found[pixel] = _crossing(pixel_ray(sensor, view, u, v), depth[pixel], near, space, mean, free)


@ti.func
def _crossing(
    ray: Template, likeliest: F32, near: F32, space: Template, mean: Template, free: Template
) -> F32:
    """The first depth around the likeliest at which a ray meets the surface from the front, 0 if it does
    not."""
    to_voxels = ray.direction.norm()
    begin, end = likeliest - GRAZING * near / to_voxels, likeliest + GRAZING * near / to_voxels
    begin = ti.max(begin, 0.0)
    clip(ray, begin, end, space.lower, space.upper)
    step = STEP / to_voxels
    found, before, t = 0.0, NONE, begin
    while t <= end and found == 0.0:
        here = _distance(space, mean, ray.origin + t * ray.direction)
        if here[0] <= 0.0 and before < NONE and before > 0.0:
            meets = t - step * here[0] / (here[0] - before)
            gradient = Vec3(here[1], here[2], here[3])
            along = ti.abs(gradient.dot(ray.direction)) / ti.max(gradient.norm(), 1e-6)
            if ti.abs(meets - likeliest) * along <= near and _may_be(ray, meets, to_voxels, space, free) == 1:
                found = meets
        before = here[0]
        t += step
    return found


@ti.func
def _may_be(ray: Template, depth: F32, to_voxels: F32, space: Template, free: Template) -> I32:
    """True unless the map takes all voxels of a ray around a depth for free."""
    may = 0
    for k in range(-AROUND, AROUND + 1):
        voxel = ti.cast(ti.floor(ray.origin + (depth + k / to_voxels) * ray.direction), ti.i32)
        number = voxel_in(space, voxel)
        if number >= 0:
            may |= 1 - ((free[number >> 5] >> (number & 31)) & 1)
    return may


@ti.func
def _distance(space: Template, mean: Template, place: Vec3) -> Vec4:
    """The mean distance at a place in voxels from the window's corner, between the centres of eight voxels,
    and its gradient; NONE where one of them has none."""
    corner = ti.floor(place - 0.5)
    share = place - 0.5 - corner
    first = ti.cast(corner, ti.i32)
    # Where all eight lie in one brick, it is looked up once.
    number, apart = voxel_in(space, first), (first & 7).max() == 7
    found = Vec4(0.0)
    for x, y, z in ti.static(ti.ndrange(2, 2, 2)):
        value, voxel = ti.cast(NONE, ti.f32), number
        if apart:
            voxel = voxel_in(space, first + IVec3(x, y, z))
        elif number >= 0:
            voxel += voxel_number(IVec3(x, y, z))
        if voxel >= 0:
            value = mean[voxel]
        of_x = share[0] if x == 1 else 1.0 - share[0]
        of_y = share[1] if y == 1 else 1.0 - share[1]
        of_z = share[2] if z == 1 else 1.0 - share[2]
        found += value * Vec4(
            of_x * of_y * of_z,
            (2 * x - 1) * of_y * of_z,
            (2 * y - 1) * of_x * of_z,
            (2 * z - 1) * of_x * of_y,
        )
        if value >= NONE:
            found[0] = 8.0 * NONE
    if found[0] > 0.1 * NONE:
        found[0] = NONE
    return found
