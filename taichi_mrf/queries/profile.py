"""What a single ray meets on its way through the map, voxel by voxel (the curves of the paper's Fig. 7)."""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from taichi_mrf.kernels.log_odds import logistic
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, IVec3, Struct, Template, Vec3
from taichi_mrf.queries.occlusion import occlusion
from taichi_mrf.voxels.traversal import clip, make_ray, walk_voxels


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


@ti.dataclass
class _Meet(Struct):
    voxel_size: F32
    unknown: F32
    empty_below: F32
    visibility: F32
    count: I32


@ti.func
def _meet(meet: Template, context: Template, voxel: I32, near: F32, far: F32):
    alpha = occlusion(context[0][voxel], meet.unknown, meet.empty_below) / meet.voxel_size
    i = meet.count
    context[1][i] = 0.5 * (near + far)
    context[2][i] = far - near
    context[3][i] = logistic(context[0][voxel])
    context[4][i] = meet.visibility
    context[5][i] = alpha * meet.visibility
    meet.visibility *= ti.exp(-alpha * (far - near))
    meet.count += 1
    return 1


@ti.kernel
def profile_ray(
    origin: Vec3, direction: Vec3, voxel_size: F32, max_range: F32, unknown: F32, empty_below: F32,
    shape: IVec3, lower: Vec3, upper: Vec3,
    chunks: I32Array, bricks: I32Array, belief: F32Array,
    distance: F32Array, length: F32Array, occupancy: F32Array, visibility: F32Array, omega: F32Array,
    count: I32Array,
):  # fmt: skip
    for _ in range(1):
        ray = make_ray(origin, direction)
        begin, end = 0.0, max_range
        clip(ray, begin, end, lower, upper)
        meet = _Meet(voxel_size, unknown, empty_below, 1.0, 0)
        walk_voxels(
            ray, begin, end, shape, chunks, bricks, _meet, meet,
            (belief, distance, length, occupancy, visibility, omega),
        )  # fmt: skip
        count[0] = meet.count
