"""The ends of a scan's rays: at the measured points, at the end of the range, or once per voxel.

A pixel that got no return has a ray that is free from the sensor's minimum range on, up to where missing
returns count.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.footprint import visible_box
from taichi_mrf.inference.keyframe import DepthImage
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.no_return import NoReturnLaw
from taichi_mrf.sensor.origins import origins_of
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, F32Array2, Template, Vec3, Vec4
from taichi_mrf.voxels.traversal import Viewpoint, ray_start
from taichi_mrf.voxels.window import Window

NO_RAY, FREE_END, HIT = -1.0, 0.0, 1.0
"""Fourth component of a ray's end: no measurement; the ray was cut off and only marks free space; a surface
was measured here. Between the last two: it marks free space from this share of its length on."""


@dataclass(frozen=True)
class OneStart(Bundle):
    """All rays start at the camera's centre."""

    centre: Vec3
    """Voxels from the window's corner."""

    @ti.func
    def of(self, ray: I32) -> Vec3:
        """Start of a ray."""
        return self.centre


@dataclass(frozen=True)
class OwnStarts(Bundle):
    """Each ray starts at a place of its own, since the camera moves while it measures."""

    places: F32Array2
    """(n, 3) voxels from the window's corner."""

    @ti.func
    def of(self, ray: I32) -> Vec3:
        """Start of a ray."""
        return Vec3(self.places[ray, 0], self.places[ray, 1], self.places[ray, 2])


Starts = OneStart | OwnStarts


def ray_ends(
    image: DepthImage,
    T_world_camera: Pose,
    window: Window,
    *,
    max_depth: float,
    max_range: float = 0.0,
    discretise: bool = False,
    correct_bias: bool = False,
    free: float = FREE_END,
) -> "tuple[ti.Ndarray, Starts]":
    """The ends of an image's rays, (n, 4) float32: the place in voxels from the window's corner, and the kind
    of end; and where the rays start.

    ``correct_bias`` subtracts the sensor's bias. Measurements beyond the axial ``max_depth`` (metres) are cut
    off there, with ends of the kind ``free``. ``discretise`` keeps one ray to the centre of each voxel that
    contains an end (OctoMap's computeDiscreteUpdate), from where the first of its rays starts; otherwise
    there is one ray per pixel. Rays longer than the Euclidean ``max_range`` (metres, 0 for no limit) are then
    cut off there.
    """
    view = window.viewpoint(T_world_camera)
    starts: Starts = OneStart(view.centre)
    ends = ti.ndarray(ti.f32, (image.camera.width * image.camera.height, 4))
    _find_ends(image.depth, image.sensor, view, max_depth, free, ends, correct_bias)
    origins = origins_of(image.camera)
    if origins is not None:
        places = origins @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        every = np.broadcast_to(window.to_voxels(places), (*image.camera.shape, 3)).reshape(-1, 3)
        starts = OwnStarts(_array(every.astype(np.float32)))
    if discretise:
        ends, kept = _once_a_voxel(ends)
        if isinstance(starts, OwnStarts):
            starts = OwnStarts(_array(starts.places.to_numpy()[kept]))
    if max_range > 0:
        _cut_off(ends, starts, max_range / window.voxel_size)
    return ends, starts


@dataclass(frozen=True)
class MissingReturns:
    """The pixels of an image that got no return, and the law of where that counts. ``image`` gives them a
    depth beyond its reach."""

    image: DepthImage
    law: NoReturnLaw

    @staticmethod
    def of(image: DepthImage, law: NoReturnLaw | None) -> "MissingReturns | None":
        """Those of an image, None if there are none, or they do not count."""
        if law is None or image.own.no_return is None:
            return None
        depth = np.where(image.own.no_return, np.float32(2 * law.reach_m), np.float32(0.0))
        return MissingReturns(DepthImage.upload(depth, image.camera, law), law)

    def box(self, T_world_camera: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Two corners, in metres, of a box around the beginnings and the ends of their rays."""
        return visible_box(self.image, T_world_camera, self.law.reach_m, end_sigmas=0.0)

    def added_to(
        self, ends: "ti.Ndarray", starts: Starts, T_world_camera: Pose, window: Window, max_range: float
    ) -> "tuple[ti.Ndarray, Starts]":
        """The ends and starts of rays, (n, 4), and those of these pixels, (n + m, 4), whose rays are free
        from the minimum range to the reach of the law, at most to ``max_range``."""
        law = self.law
        more, own = ray_ends(
            self.image, T_world_camera, window, max_depth=law.reach_m, max_range=max_range,
            free=law.begin_m / law.reach_m,
        )  # fmt: skip
        rows = more.to_numpy()
        kept = rows[:, 3] != NO_RAY
        both = _array(np.concatenate([ends.to_numpy(), rows[kept]]))
        if isinstance(starts, OwnStarts) and isinstance(own, OwnStarts):
            starts = OwnStarts(
                _array(np.concatenate([starts.places.to_numpy(), own.places.to_numpy()[kept]]))
            )
        return both, starts


def _array(rows: NDArray[np.float32]) -> "ti.Ndarray":
    """Rows where kernels can reach them."""
    array = ti.ndarray(ti.f32, rows.shape)
    array.from_numpy(rows)
    return array


def _once_a_voxel(ends: "ti.Ndarray") -> "tuple[ti.Ndarray, NDArray[np.intp]]":
    """The centres of the voxels that contain ends, (n, 4): each once for hits and once for cut-off rays; and
    the number of the first ray of each, (n,)."""
    every = ends.to_numpy()
    rays = np.flatnonzero(every[:, 3] >= 0)
    every = every[rays]
    once, kept = np.array([[0.0, 0.0, 0.0, NO_RAY]], np.float32), np.zeros(1, np.intp)
    if len(every):
        voxels = np.floor(every).astype(np.int64)
        lowest = voxels.min(axis=0)
        shape = tuple((voxels.max(axis=0) - lowest + 1).tolist())
        keys, first = np.unique(np.ravel_multi_index(tuple((voxels - lowest).T), shape), return_index=True)
        kept = rays[first]
        once = (np.stack(np.unravel_index(keys, shape), axis=1) + lowest).astype(np.float32)
        once[:, :3] += 0.5
    return _array(once), kept


@ti.func
def end_of(ends: Template, ray: I32) -> Vec4:
    """The place and kind of a ray's end."""
    return Vec4(ends[ray, 0], ends[ray, 1], ends[ray, 2], ends[ray, 3])


@ti.func
def free_from(end: Vec4) -> F32:
    """From which share of its length on a ray counts."""
    return end[3] if end[3] < HIT else 0.0


@ti.func
def put_end(ends: Template, ray: I32, place: Vec3, kind: F32):
    """Store the place and kind of a ray's end."""
    for axis in ti.static(range(3)):
        ends[ray, axis] = place[axis]
    ends[ray, 3] = kind


@kernel
def _find_ends(
    depth: F32Array, sensor: Sensor, view: Viewpoint, max_depth: F32, free: F32, ends: F32Array2,
    correct_bias: Template,
) -> None:  # fmt: skip
    """The end of each pixel's ray.

    ``depth`` is (H * W) metres, 0 without a measurement. ``free`` is the kind of the ends of rays that are
    cut off at ``max_depth``. ``ends`` (H * W, 4) receives voxels from the
    window's corner, and the kind of end.
    """
    for pixel in range(depth.shape[0]):
        u, v = sensor.pixel(pixel)
        surface = depth[pixel]
        kind = NO_RAY
        if surface > 0.0:
            if ti.static(correct_bias):
                surface = sensor.surface_depth(surface, sensor.noise_at(u, v))
            kind = HIT if surface <= max_depth else free
        direction = sensor.direction(u, v)  # with a name, as in traversal.pixel_ray
        start = ray_start(sensor, view, u, v)
        end = start + view.to_voxels @ direction * ti.min(surface, max_depth)
        put_end(ends, pixel, end, kind)


@kernel
def _cut_off(ends: F32Array2, starts: Starts, longest: F32) -> None:
    """Cut off rays that are longer than ``longest`` voxels. ``ends`` (n, 4) as in :func:`_find_ends`."""
    for i in range(ends.shape[0]):
        end, start = end_of(ends, i), starts.of(i)
        way = Vec3(end[0], end[1], end[2]) - start
        if end[3] >= 0.0 and way.norm() > longest:
            near = start + way * (longest / way.norm())
            begin = free_from(end) * (way.norm() / longest)  # the same place on a shorter ray
            put_end(ends, i, near, begin if begin < 1.0 else NO_RAY)
