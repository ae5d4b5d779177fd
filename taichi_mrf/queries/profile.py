"""Profile of a single ray through the map, voxel by voxel (the curves of the paper's Fig. 7)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.log_odds import logistic
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, Struct, Template, Vec3
from taichi_mrf.queries.occlusion import Occlusion, occlusion
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.traversal import Space, clip, make_ray, walk_voxels


@dataclass(frozen=True)
class RayProfile:
    """Profile of a ray, voxel by voxel, where bricks exist; all arrays (N,) float32.

    ``distance`` is the range in metres to the middle of the ray's segment in the voxel, ``length`` the
    segment's length in metres; ``occupancy`` the marginal, ``visibility`` what is left of the ray at the
    segment's begin (eq. 15), ``omega`` the density, per metre, of the ray's surface being there (eq. 18).
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
