"""Which bricks a depth image sees: those that its rays cross, and those at the surfaces it measured.

Bricks are allocated near measured surfaces only (section IV-B). The rays' way there is remembered too:
it tells seen-free space from unknown space, and which bricks of other keyframes these rays cross.
"""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.config.inference import InferenceConfig
from taichi_mrf.config.schema import SensorConfig, VolumeConfig
from taichi_mrf.errors import CapacityError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.keyframe import TILE, DepthImage, Footprint, RayList
from taichi_mrf.inference.ray_list import block_of
from taichi_mrf.kernels.types import (
    F32,
    I32,
    F32Array,
    F32Array3,
    I32Array,
    IVec3,
    Mat3,
    Struct,
    Template,
    Vec3,
    Vec4,
)
from taichi_mrf.sensor.forward import depth_of_deviation, pixel_noise
from taichi_mrf.sensor.noise import LEAST_SIGMA_M, evaluate
from taichi_mrf.sensor.rays import pixel_direction
from taichi_mrf.system.memory import check_memory
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import clip, make_ray, walk_bricks
from taichi_mrf.voxels.window import Window

CROSSED, SURFACE = 1, 2


def find_footprint(
    image: DepthImage,
    rays: RayList,
    T_world_camera: Pose,
    voxel_size: float,
    sensor: SensorConfig,
    inference: InferenceConfig,
    volume: VolumeConfig,
    beyond_m: float = 0.0,
    scouts: int = 1,
) -> Footprint:
    """Follow every ray of an image's list from the camera to ``end_sigmas`` beyond its measurement, and
    ``beyond_m`` metres of axial depth more. Near its measurement each ray counts; of the way there only that
    of every ``scouts``-th ray is followed, so that bricks may go unnoticed that few rays graze.

    Raises CapacityError if the space that the image sees has too many bricks at this voxel size.
    """
    lower_m, upper_m = visible_box(image, T_world_camera, sensor.max_depth, inference.end_sigmas, beyond_m)
    window = window_around(lower_m, upper_m, voxel_size, volume)
    if image.rays == 0 or window is None:
        nowhere = Window.covering(T_world_camera[:3, 3], T_world_camera[:3, 3], voxel_size)
        return Footprint(nowhere, np.zeros(0, np.int32), np.zeros(0, np.int32), 1)
    centre, to_voxels = window.rays_of(T_world_camera)
    box_lower, box_upper = window.clip_box(volume.lower, volume.upper)
    # NumPy arrays, which a kernel on the CPU writes in place: small voxels make the window large.
    marks = np.zeros(window.cells, np.int32)
    longest = np.ones(1, np.int32)
    _mark(
        rays.blocks, rays.depth, rays.number, image.camera.width, image.intrinsics, centre, to_voxels,
        image.noise, image.noise_table.patch, image.noise_table.columns,
        sensor.max_depth, inference.end_sigmas, beyond_m, scouts,
        window.shape_vector, box_lower, box_upper, marks, longest,
    )  # fmt: skip
    crossed = np.flatnonzero(marks).astype(np.int32)
    surface = crossed[marks[crossed] & SURFACE != 0]
    _check_size(len(crossed), len(surface), voxel_size, volume.memory_limit_gb)
    return Footprint(window, crossed, surface, int(longest[0]))


def window_around(
    lower_m: NDArray[np.float64], upper_m: NDArray[np.float64], voxel_size: float, volume: VolumeConfig
) -> Window | None:
    """The window around what lies in the mapped volume of a box in metres; None if nothing does.

    Raises CapacityError if it has too many bricks.
    """
    if volume.lower is not None and volume.upper is not None:
        lower_m, upper_m = np.maximum(lower_m, volume.lower), np.minimum(upper_m, volume.upper)
    if (lower_m >= upper_m).any():
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
    """Two corners, in metres, of an upright box around the camera and the ends of all its rays."""
    camera = image.camera
    farthest = image.farthest.astype(np.float64)
    rows, columns = farthest.shape
    # Generous: the end of a ray is never further than depth_of_deviation() lets it be, and no patch of
    # the table is worse than the worst.
    values = np.abs(evaluate(image.noise_table.coefficients[:, :, None], farthest.reshape(1, 1, -1)))
    sigma, bias = np.maximum(values[:, 0], LEAST_SIGMA_M).max(axis=0), values[:, 1].max(axis=0)
    reach = (3 * (end_sigmas * sigma + bias)).reshape(farthest.shape) + beyond_m
    ends = np.minimum(farthest + reach, max_depth)
    ends[farthest <= 0] = 0.0
    u = np.minimum(np.arange(columns + 1) * TILE, camera.width) - 0.5
    v = np.minimum(np.arange(rows + 1) * TILE, camera.height) - 0.5
    corners = [T_world_camera[:3, 3][None]]
    for du in (0, 1):
        for dv in (0, 1):
            x = (u[du : du + columns][None, :] - camera.cx) / camera.fx * ends
            y = (v[dv : dv + rows][:, None] - camera.cy) / camera.fy * ends
            points = np.stack([x, y, ends], axis=-1).reshape(-1, 3)
            corners.append(points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])
    cloud = np.concatenate(corners)
    return cloud.min(axis=0), cloud.max(axis=0)


@ti.dataclass
class _Mark(Struct):
    surface_begin: F32  # depth from which a brick is near the measured surface


@ti.func
def _mark_brick(mark: Template, context: Template, ray: Template, brick: IVec3, t: F32, t_leave: F32):
    kind = CROSSED
    if t_leave > mark.surface_begin:
        kind = CROSSED | SURFACE
    cell = flat(brick, context[0])
    if (context[1][cell] & kind) != kind:  # most bricks are marked already, and reading is cheaper
        ti.atomic_or(context[1][cell], kind)
    return 1


@ti.kernel
def _mark(
    blocks: I32Array, depth: F32Array, rays: I32, width: I32,
    intrinsics: Vec4, centre: Vec3, to_voxels: Mat3,
    noise: F32Array3, patch: I32, columns: I32,
    max_depth: F32, end_sigmas: F32, beyond_m: F32, scouts: I32,
    shape: IVec3, box_lower: Vec3, box_upper: Vec3, marks: I32Array, longest: I32Array,
):  # fmt: skip
    for i in range(rays):
        measured = depth[i]
        u, v, wide, high = block_of(blocks[i], width)
        direction = to_voxels @ pixel_direction(u + 0.5 * (wide - 1), v + 0.5 * (high - 1), intrinsics)
        ray = make_ray(centre, direction)
        noise_here = pixel_noise(noise, patch, columns, u + wide // 2, v + high // 2)
        last = depth_of_deviation(measured, -end_sigmas, noise_here) + beyond_m
        begin, end = 0.0, ti.min(last, max_depth)
        clip(ray, begin, end, box_lower, box_upper)
        if end > begin:
            # A step along the ray leaves a voxel through a face, or enters a brick anew.
            faces = (end - begin) * (ti.abs(direction[0]) + ti.abs(direction[1]) + ti.abs(direction[2]))
            bricks = ti.cast(faces / BRICK, ti.i32) + 4
            steps = ti.cast(faces, ti.i32) + 4 + 2 * bricks
            if steps > longest[0]:
                ti.atomic_max(longest[0], steps)
        mark = _Mark(depth_of_deviation(measured, end_sigmas, noise_here))
        if i % scouts != 0:
            begin = ti.max(begin, mark.surface_begin)
        walk_bricks(ray, begin, end, shape, marks, False, _mark_brick, mark, (shape, marks))
