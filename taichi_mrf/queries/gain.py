"""The information gain of a view: the uncertainty along its rays.

A ray gains the entropy of what it sees, in bits, weighted by whether it is seen:

    G = sum over voxels i of H(p_i) * integral over the ray's segment in i of V(t) dt / voxel size,
    H(p) = -p log2 p - (1 - p) log2 (1 - p),    V(t) the visibility, eq. 15 of MRFMap.

V falls as exp(-alpha t) within a voxel, alpha = -ln(1 - p) / voxel size, so the integral is exact. It is the
occlusion-aware information of Isler et al. (ICRA 2016), with true lengths in place of a count of voxels.
Unknown voxels have the entropy of their probability: that of the prior in an MRFMap, 1 bit in maps
that integrate scan by scan. What rays pass as empty holds nothing to be learnt: bricks without voxels that
were seen to be free, and in maps that integrate scan by scan the free voxels (see Occlusion.empty_below).
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.geometry.poses import Pose, as_pose
from taichi_mrf.queries.given_rays import RaySpace
from taichi_mrf.queries.survey import OPAQUE, Occlusion, occlusion, stopped_share
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.sensor.camera import Camera
from taichi_mrf.sensor.origins import widened
from taichi_mrf.sensor.rays import CameraRays
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, Struct, Template
from taichi_mrf.voxels.log_odds import exp_of_negative, logistic
from taichi_mrf.voxels.traversal import FAR, Space, Viewpoint, clip, pixel_ray, walk_voxels

_THINNEST = 1e-6
"""Below this thickness a voxel dims nothing, and the integral of the visibility is the length."""


@tensors.in_kind("T_world_camera")
def view_gain(
    m: VoxelMap, camera: Camera, T_world_camera: ArrayLike, max_depth: float
) -> NDArray[np.float64]:
    """Information gain of views, in bits: poses (N, 4, 4) -> (N,), or (4, 4) -> a number of shape ().

    The gain is the sum of :func:`pixel_gain` over the image. A voxel counts once for each ray that crosses
    it, so compare only views of one camera; few pixels suffice to rank them. Raises the errors of pixel_gain.
    """
    poses = np.asarray(T_world_camera, np.float64)
    if poses.ndim == 2:
        return np.array(pixel_gain(m, camera, poses, max_depth).sum(dtype=np.float64))
    if poses.ndim != 3:
        raise ConfigError(f"poses must be of shape (4, 4) or (N, 4, 4), not {poses.shape}")
    space = RaySpace(m)
    return np.array([_gain(space, camera, as_pose(T), max_depth).sum(dtype=np.float64) for T in poses])


@tensors.in_kind("T_world_camera")
def pixel_gain(
    m: VoxelMap, camera: Camera, T_world_camera: ArrayLike, max_depth: float
) -> NDArray[np.float32]:
    """Information gain of each pixel's ray up to an axial depth in metres, (H, W) float32 in bits.

    Raises KeyframeError for an impossible pose, ConfigError for a depth that is not positive, CapacityError
    if the view reaches through more space than fits memory.
    """
    return _gain(RaySpace(m), camera, as_pose(T_world_camera), max_depth)


def _gain(space: RaySpace, camera: Camera, T_world_camera: Pose, max_depth: float) -> NDArray[np.float32]:
    if not (np.isfinite(max_depth) and max_depth > 0):
        raise ConfigError(f"max_depth must be a positive number, not {max_depth}")
    m = space.map
    gain = np.zeros(camera.width * camera.height, np.float32)
    centre_m = T_world_camera[:3, 3]
    ends = camera.rays().reshape(-1, 3) * max_depth
    points = np.concatenate([ends @ T_world_camera[:3, :3].T + centre_m, centre_m[None]])
    box = widened(camera, T_world_camera, points.min(axis=0), points.max(axis=0))
    with space.indexed(*box) as window:
        view = m.view
        _gain_rays(
            camera.in_kernels(), window.viewpoint(T_world_camera), view.index.space(window), view.pool.belief,
            max_depth, view.pool.prior_log_odds, dataclasses.replace(view.occlusion, unknown=FAR),
            space.unknown_from, gain,
        )  # fmt: skip
        runtime.settle()
    return gain.reshape(camera.shape)


@ti.dataclass
class _Look(Struct):
    """A ray that looks for what is not certain."""

    voxels_per_depth: F32  # length of the ray, in voxels, for one metre of depth
    prior: F32
    unknown_from: I32
    visibility: F32  # what is left of the ray
    bits: F32  # gained so far


@dataclass(frozen=True)
class _Learnt(Bundle):
    """Inputs of a step along a ray: log-odds (pool * 512), and how voxels dim the ray."""

    belief: F32Array
    occlusion: Occlusion


@ti.func
def _entropy(log_odds: F32):
    """Bits of a voxel, the same for p and 1 - p; what is as good as certain has none."""
    p = logistic(-ti.abs(log_odds))
    bits = 0.0
    if p > 1e-7:
        bits = -(p * ti.log(p) + (1.0 - p) * ti.log(1.0 - p)) / ti.log(2.0)
    return bits


@ti.func
def _learn(look: Template, learnt: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray."""
    log_odds = look.prior
    if voxel < look.unknown_from:
        log_odds = learnt.belief[voxel]
    length = (far - near) * look.voxels_per_depth
    alpha = occlusion(log_odds, learnt.occlusion)
    seen = length
    if alpha * length > _THINNEST:
        seen = stopped_share(alpha * length) / alpha
    if log_odds >= learnt.occlusion.empty_below:
        look.bits += _entropy(log_odds) * look.visibility * seen
    look.visibility *= exp_of_negative(-alpha * length)
    return ti.cast(look.visibility > OPAQUE, ti.i32)


@kernel
def _gain_rays(
    camera: CameraRays, view: Viewpoint, space: Space, belief: F32Array, max_depth: F32, prior: F32,
    rule: Occlusion, unknown_from: I32, gain: F32Array,
) -> None:  # fmt: skip
    """The gain in bits of each pixel's ray into ``gain`` (H * W), up to ``max_depth`` metres.

    ``belief`` (pool * 512) holds log-odds; voxels from ``unknown_from`` on have none, but the ``prior``.
    """
    for pixel in range(gain.shape[0]):
        u, v = camera.pixel(pixel)
        path = pixel_ray(camera, view, u, v)
        look = _Look(path.direction.norm(), prior, unknown_from, 1.0, 0.0)
        begin, end = 0.0, max_depth
        clip(path, begin, end, space.lower, space.upper)
        walk_voxels(path, begin, end, space, _learn, look, _Learnt(belief, rule))
        gain[pixel] = look.bits
