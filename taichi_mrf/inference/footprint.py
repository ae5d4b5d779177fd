"""The bricks that a depth image sees: those that its rays cross, and those at the surfaces it measured.

Bricks are allocated near measured surfaces only (section IV-B). The bricks in front of them are recorded too:
they give the bricks of other keyframes that rays cross, and those of which rays see most are free space.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import SensorConfig, VolumeConfig
from taichi_mrf.errors import CapacityError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import TILE, DepthImage, Footprint, NoReturnRays, RayList
from taichi_mrf.inference.ray_list import block_ray, end_of_shared_path, listed_ray
from taichi_mrf.inference.ray_model import END_SIGMAS
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.sensor.origins import widened
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.memory import check_memory
from taichi_mrf.system.types import F32, I32, I32Array, IVec3, Struct, Template, Vec3
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import FAR, Viewpoint, clip, walk_bricks
from taichi_mrf.voxels.window import Window

CROSSED, SURFACE = 1, 2

SEEN = 5
"""Of the eighths of a brick, so many have to be crossed by a keyframe's rays for it to be seen. A brick whose
corner rays cut has no voxels, and was free as a whole: also the part of a wall in it that nothing saw."""

_EIGHTHS = 2
"""Lowest bit of the marks of a brick's eighths."""

_ALL_EIGHTHS = 0xFF << _EIGHTHS


def find_footprint(
    image: DepthImage,
    rays: RayList,
    T_world_camera: Pose,
    voxel_size: float,
    sensor: SensorConfig,
    volume: VolumeConfig,
    end_sigmas: float = END_SIGMAS,
    beyond_m: float = 0.0,
    no_returns: Sequence[NoReturnRays] = (),
) -> Footprint:
    """Follow every ray of an image's list from the camera to its end, which the list's maker put
    ``end_sigmas`` beyond its measurement, and ``beyond_m`` metres of axial depth more; in front of all
    surfaces the rays of a group go the way that they have in common (sum_product.send_messages). Rays of
    ``no_returns`` cross bricks up to where they count and are near no surface.

    Raises CapacityError if the space that the image sees has too many bricks at this voxel size.
    """
    lower_m, upper_m = visible_box(image, T_world_camera, sensor.max_depth, end_sigmas, beyond_m)
    for each in no_returns:
        end = visible_box(each.image, T_world_camera, each.reach_m, end_sigmas)
        lower_m, upper_m = np.minimum(lower_m, end[0]), np.maximum(upper_m, end[1])
    window = window_around(lower_m, upper_m, voxel_size, volume)
    if (image.rays == 0 and not no_returns) or window is None:
        nowhere = Window.covering(T_world_camera[:3, 3], T_world_camera[:3, 3], voxel_size)
        nothing = np.zeros(0, np.int32)
        return Footprint(nowhere, nothing, nothing, nothing, 1)
    box_lower, box_upper = window.clip_box(volume.lower, volume.upper)
    # NumPy arrays, which a kernel on the CPU writes in place: small voxels make the window large.
    marks = np.zeros(window.cells, np.int32)
    longest = np.ones(1, np.int32)
    view, seen = (
        window.viewpoint(T_world_camera),
        _Marks(window.shape_vector, box_lower, box_upper, marks, longest),
    )
    _mark(rays, image.sensor, view, _Reach(0.0, sensor.max_depth, end_sigmas, beyond_m, CROSSED), seen)
    for each in no_returns:
        kind = CROSSED | _ALL_EIGHTHS if each.is_sure else CROSSED
        reach = _Reach(each.begin_m, each.reach_m, end_sigmas, 0.0, kind)
        _mark(each.ray_list, each.image.sensor, view, reach, seen)
    crossed = np.flatnonzero(marks).astype(np.int32)
    kinds = marks[crossed]
    surface = crossed[kinds & SURFACE != 0]
    eighths = np.unpackbits((kinds >> _EIGHTHS).astype(np.uint8)[:, None], axis=1).sum(axis=1)
    seen = crossed[(eighths >= SEEN) | (kinds & SURFACE != 0)]
    _check_size(len(crossed), len(surface), voxel_size, volume.memory_limit_gb)
    return Footprint(window, crossed, surface, seen, int(longest[0]))


def window_around(
    lower_m: NDArray[np.float64], upper_m: NDArray[np.float64], voxel_size: float, volume: VolumeConfig
) -> Window | None:
    """The window around what lies in the mapped volume of a box in metres; None if nothing does.

    Raises CapacityError if it has too many bricks.
    """
    if volume.lower is not None and volume.upper is not None:
        lower_m, upper_m = np.maximum(lower_m, volume.lower), np.minimum(upper_m, volume.upper)
    if (lower_m > upper_m).any():
        return None
    window = Window.covering(lower_m, upper_m, voxel_size)
    if window.cells >= 2**31:
        raise CapacityError(f"a view at a voxel size of {voxel_size:g} m has {window.cells:.3g} bricks")
    check_memory(4.0 * window.cells, f"the bricks around a view at a voxel size of {voxel_size:g} m")
    return window


def _check_size(crossed: int, surface: int, voxel_size: float, limit_gb: float) -> None:
    """Refuse a view before anything is allocated for it: 60 bytes for each brick crossed while lists of
    them are made, and for each voxel near a surface belief, message and a sweep's scratch."""
    check_memory(
        60.0 * crossed + VOXELS * surface * (4.0 + 2.0 + 12.0),
        f"a view of {surface * VOXELS / 1e6:.3g} million voxels of {voxel_size:g} m",
        limit_gb,
    )


def visible_box(
    image: DepthImage, T_world_camera: Pose, max_depth: float, end_sigmas: float, beyond_m: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two corners, in metres, of an upright box around the beginnings and the ends of all rays."""
    farthest = image.farthest.astype(np.float64)
    # Generous: the end of a ray is never further than depth_of_deviation() lets it be, and no patch of
    # the table is worse than the worst.
    sigma, bias = image.noise_table.largest(farthest)
    reach = (3 * (end_sigmas * sigma + bias)).reshape(farthest.shape) + beyond_m
    ends = np.minimum(farthest + reach, max_depth)
    ends[farthest <= 0] = 0.0
    hulls = image.camera.tile_hulls(TILE)
    corners = [T_world_camera[:3, 3][None]]
    for k in range(hulls.shape[2]):
        points = (hulls[:, :, k] * ends[..., None]).reshape(-1, 3)
        corners.append(points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])
    cloud = np.concatenate(corners)
    return widened(image.camera, T_world_camera, cloud.min(axis=0), cloud.max(axis=0))


@dataclass(frozen=True)
class _Reach(Bundle):
    """Bounds of the way along which rays are followed."""

    min_depth: F32
    """Metres of depth before which they cross nothing."""

    max_depth: F32
    """Metres of depth that no ray goes beyond."""

    end_sigmas: F32
    """Sigmas in front of the measurement from which on a brick is near the surface."""

    beyond_m: F32
    """Metres of depth that a ray goes on behind those."""

    kind: I32
    """Mark of each brick that is crossed."""


@dataclass(frozen=True)
class _Marks(Bundle):
    """The bricks of a window that are crossed."""

    shape: IVec3
    """Size of the window in bricks."""

    lower: Vec3
    """Corners of its mapped part, in voxels from the window's corner."""

    upper: Vec3

    kinds: I32Array
    """(bricks of the window): CROSSED, SURFACE, and a bit for each eighth that is crossed."""

    longest: I32Array
    """(1): a bound on the voxels that any ray crosses."""


@ti.dataclass
class _Mark(Struct):
    """A ray that marks bricks."""

    surface_begin: F32  # depth from which a brick is near the measured surface
    kind: I32  # of every brick


@ti.func
def _mark_brick(mark: Template, marks: Template, ray: Template, brick: IVec3, t: F32, t_leave: F32):
    """Mark one brick of a ray."""
    kind, cell = mark.kind, flat(brick, marks.shape)
    known = marks.kinds[cell]
    if t_leave > mark.surface_begin:
        kind |= SURFACE
    elif t <= 0.0:  # where the sensor is, nothing else can be
        kind |= _ALL_EIGHTHS
    elif (known & _ALL_EIGHTHS) != _ALL_EIGHTHS:
        for third in ti.static(range(3)):
            place = ray.origin + (t + (third + 0.5) / 3.0 * (t_leave - t)) * ray.direction - BRICK * brick
            upper = ti.cast(place >= 0.5 * BRICK, ti.i32)
            kind |= 1 << (_EIGHTHS + 4 * upper[0] + 2 * upper[1] + upper[2])
    if (known & kind) != kind:  # most bricks are marked already, and reading is cheaper
        ti.atomic_or(marks.kinds[cell], kind)
    return 1


@ti.func
def _most_voxels(ray: Template, begin: F32, end: F32) -> I32:
    """A bound on the voxels of a ray between two depths, and on its steps: each leaves a voxel through a
    face, or enters a brick anew."""
    along = ti.abs(ray.direction[0]) + ti.abs(ray.direction[1]) + ti.abs(ray.direction[2])
    faces = ti.max(end - begin, 0.0) * along
    return ti.cast(faces, ti.i32) + 4 + 2 * (ti.cast(faces / BRICK, ti.i32) + 4)


@kernel
def _mark(rays: RayList, sensor: Sensor, view: Viewpoint, reach: _Reach, marks: _Marks) -> None:
    """Mark the bricks that each ray crosses."""
    for group in range(rays.group_number):
        middle, free = block_ray(rays.groups[group], sensor, view), _Mark(FAR, reach.kind)
        apart = end_of_shared_path(rays, group, middle, reach.min_depth, reach.max_depth)
        begin, end = 0.0, apart  # a sweep begins at the camera
        clip(middle, begin, end, marks.lower, marks.upper)
        shared = _most_voxels(middle, begin, end)
        begin = ti.max(begin, reach.min_depth)
        walk_bricks(middle, begin, end, marks.shape, marks.kinds, False, _mark_brick, free, marks)
        for i in range(rays.first[group], rays.first[group + 1]):
            measured = rays.depth[i]
            ray, noise, _ = listed_ray(rays, i, sensor, view)
            last = sensor.until(measured, rays.last[i] + reach.beyond_m)
            begin, end = apart, ti.min(last, reach.max_depth)
            clip(ray, begin, end, marks.lower, marks.upper)
            steps = ti.max(shared + _most_voxels(ray, begin, end), _most_voxels(ray, 0.0, end))
            if steps > marks.longest[0]:
                ti.atomic_max(marks.longest[0], steps)
            mark = _Mark(sensor.nearest_depth(measured, noise, reach.end_sigmas), reach.kind)
            walk_bricks(ray, begin, end, marks.shape, marks.kinds, False, _mark_brick, mark, marks)
