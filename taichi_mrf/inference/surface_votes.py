"""Which voxels the rays take for their first surface, by a vote of all rays.

For each ray of each keyframe the likeliest first surface is the voxel with the largest (symbols of
sum_product.py, with the marginals of the whole map as m)

    nu_i m_i vis_i

among the voxels that are likelier occupied than by the prior. The ray votes for it, and against every
voxel that it crosses before it. A voxel wins that more than two fifths of the rays that come as far as it
take for their surface. Rays whose measurement the map holds for an outlier do not vote.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import taichi as ti

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.inference.keyframe import Keyframe, RayList, VisibleBricks
from taichi_mrf.inference.ray_list import listed_ray
from taichi_mrf.inference.ray_model import RayModel
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.log_odds import exp_of_negative, softplus
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, Struct, Template
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system import runtime
from taichi_mrf.voxels.pool import BrickPool, copied
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, walk_voxels
from taichi_mrf.voxels.window import WindowIndex

FOR, AGAINST = 3, 2
"""What a vote for a voxel and one against it weigh: a voxel wins if more than two fifths of the rays that
come as far take it for their surface. With half, walls have holes where voxels are finer than the noise."""

GRAZED = 0.1
"""A ray that is in a voxel for less than this, in voxel sizes, does not vote against it."""

CALLED = 0.01
"""Log-odds above even odds, or above what counts as known, that a voxel that wins has at least."""


def surfaces_first(
    keyframes: Iterable[tuple[Keyframe, VisibleBricks]],
    pool: BrickPool,
    model: RayModel,
    volume: VolumeConfig,
) -> "ti.Ndarray":
    """The log-odds of a map's voxels, (capacity * 512), in which each voxel that wins the vote of the rays is
    occupied; all others keep their marginals.

    ``keyframes`` come with their lists of visible bricks, ``model`` are the parameters of their rays.
    """
    learnt = pool.prior_log_odds + volume.min_evidence
    belief, index = pool.belief, WindowIndex()
    votes = ti.ndarray(ti.i32, belief.shape)
    votes.fill(0)
    for keyframe, visible in keyframes:
        if len(visible.slots) > 0:
            window = keyframe.footprint.window
            index.fill(window, visible.cells, visible.slots)
            _vote(
                keyframe.ray_list, keyframe.image.sensor, window.viewpoint(keyframe.T_world_camera),
                index.space(window, volume.lower, volume.upper), model, learnt, belief, votes,
            )  # fmt: skip
            index.clear(window, visible.cells)
    log_odds = copied(belief)
    _call(votes, log_odds, max(0.0, learnt) + CALLED)
    runtime.settle()
    return log_odds


@ti.dataclass
class _Ahead(Struct):
    """A ray on its way from the camera."""

    visibility: F32
    explained: F32
    largest: F32  # nu m vis so far
    surface: I32  # the voxel of the largest, -1 before there is one


@dataclass(frozen=True)
class _Looking(Bundle):
    """One ray, and all that a step along it needs."""

    model: RayModel
    belief: F32Array
    learnt: F32
    sensor: Sensor
    measured: F32
    noise: Template
    support: F32
    voxels_per_depth: F32


@ti.func
def _look(ahead: Template, looking: Template, voxel: I32, near: F32, far: F32):
    """One voxel on the way to the likeliest surface."""
    log_odds = looking.belief[voxel]
    log_free = -softplus(log_odds)
    if ti.static(looking.model.segment_lengths):
        log_free *= (far - near) * looking.voxels_per_depth
    free = exp_of_negative(log_free)
    if far > looking.support:
        density = looking.sensor.likelihood(
            looking.measured, near, far, looking.noise, looking.model.voxel_size, looking.model.likelihood
        )
        here = (1.0 - free) * density * ahead.visibility
        ahead.explained += here
        if here > ahead.largest and log_odds > looking.learnt:
            ahead.largest = here
            ahead.surface = voxel
    ahead.visibility *= free
    return 1


@dataclass(frozen=True)
class _Voting(Bundle):
    """A ray that votes, and what it votes for."""

    votes: I32Array
    surface: I32
    voxels_per_depth: F32


@ti.func
def _vote_against(state: Template, voting: Template, voxel: I32, near: F32, far: F32):
    """One voxel in front of the likeliest surface."""
    before = ti.cast(voxel != voting.surface, ti.i32)
    if before == 1 and (far - near) * voting.voxels_per_depth > GRAZED:
        ti.atomic_sub(voting.votes[voxel], AGAINST)
    return before


@kernel
def _vote(
    rays: RayList, sensor: Sensor, view: Viewpoint, space: Space, model: RayModel, learnt: F32,
    belief: F32Array, votes: I32Array,
) -> None:  # fmt: skip
    """Add the votes of a keyframe's rays to ``votes`` (pool * 512); ``belief`` (pool * 512) are log-odds."""
    for i in range(rays.blocks.shape[0]):
        if i < rays.number:
            measured = rays.depth[i]
            ray, noise, _ = listed_ray(rays, i, sensor, view)
            looking = _Looking(
                model, belief, learnt, sensor, measured, noise, sensor.support(measured, noise),
                ray.direction.norm(),
            )  # fmt: skip
            begin = 0.0
            end = ti.min(sensor.farthest_depth(measured, noise, model.end_sigmas), model.max_depth)
            clip(ray, begin, end, space.lower, space.upper)
            ahead = _Ahead(1.0, 0.0, 0.0, -1)
            walk_voxels(ray, begin, end, space, _look, ahead, looking)
            if ahead.surface >= 0 and ahead.explained > model.floor:
                ti.atomic_add(votes[ahead.surface], FOR)
                voting = _Voting(votes, ahead.surface, looking.voxels_per_depth)
                walk_voxels(ray, begin, end, space, _vote_against, ahead, voting)


@ti.kernel
def _call(votes: I32Array, log_odds: F32Array, least: F32):
    """Raise the ``log_odds`` (n) of voxels that win the ``votes`` (n) to ``least``."""
    for i in range(votes.shape[0]):
        if votes[i] > 0:
            log_odds[i] = ti.max(log_odds[i], least)
