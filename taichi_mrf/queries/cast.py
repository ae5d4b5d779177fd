"""Ray casting: many rays at once, with a stated policy for unknown space."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from taichi_mrf.errors import ConfigError
from taichi_mrf.queries.given_rays import GivenRays, RaySpace, WindowRays
from taichi_mrf.queries.points import OCCUPIED, UNKNOWN, state_of
from taichi_mrf.queries.voxel_map import VoxelMap
from taichi_mrf.system import runtime, tensors
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, Struct, Template
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.traversal import Space, clip, make_ray, walk_voxels
from taichi_mrf.voxels.window import Window

Unknown = Literal["free", "stop", "hit"]
"""Policy for a ray that reaches unknown space: pass, end there without a hit, or count it as a hit."""

_POLICIES: dict[str, int] = {"free": 0, "stop": 1, "hit": 2}
_PASSED, _HIT, _STOPPED = 0, 1, 2


RAYS_A_BRICK = 4
"""From so many rays for each brick on, bricks are looked through for occupied voxels first: this takes about
the time that four rays save."""


@dataclass(frozen=True)
class RayHits:
    """Ends of rays: ``hit`` (N,) is True where a ray hit something, ``range`` (N,) float32 is its length in
    metres, ``point`` (N, 3) float64 its end in the world; ``in_unknown`` (N,) is True where unknown space
    stopped it. A ray that nothing stops has the maximum range."""

    hit: NDArray[np.bool_]
    range: NDArray[np.float32]
    point: NDArray[np.float64]
    in_unknown: NDArray[np.bool_]


@tensors.in_kind("origins", "directions", on_device=True)
def cast_rays(
    m: VoxelMap, origins: ArrayLike, directions: ArrayLike, max_range: float, unknown: Unknown = "free"
) -> RayHits:
    """Follow rays to the first voxel that is occupied (:meth:`state`), in one kernel for all of them.

    ``origins`` and ``directions`` are (N, 3) in the world, in metres, or one of them is (3,), shared by all
    rays; directions need not be normalised. CPU and CUDA read float32 and float64 without a copy. The range
    is that of the face through which the ray enters the voxel, 0 if it begins inside. Raises ConfigError for
    another policy, for arrays that do not fit or are not finite and for a direction of no length,
    CapacityError if the rays reach through more space than fits memory.
    """
    m = m.decided
    if unknown not in _POLICIES:
        raise ConfigError(f"unknown must be one of {', '.join(_POLICIES)}, not {unknown!r}")
    rays = GivenRays(origins, directions)
    if not (np.isfinite(max_range) and max_range > 0):
        raise ConfigError(f"max_range must be a positive number, not {max_range}")
    end_m = tensors.empty(rays.like, (rays.count,))
    outcome = tensors.empty(rays.like, (rays.count,), "int32")
    end_m[:], outcome[:] = max_range, _PASSED
    if rays.count:
        corners = rays.corners(max_range)
        if unknown == "free":
            _through_voxels(m, rays, corners, max_range, end_m, outcome)
        else:
            _through_space(m, rays, corners, max_range, end_m, outcome)
    ended_in_unknown = outcome == _STOPPED
    hit = outcome == _HIT
    if unknown == "hit":
        hit |= ended_in_unknown
    return RayHits(hit, end_m, rays.points(end_m), ended_in_unknown)


def _through_voxels(
    m: VoxelMap, rays: GivenRays, corners: NDArray[np.float64], max_range: float, end_m: Any, outcome: Any
) -> None:
    """Past everything but occupied voxels: only bricks that exist need to be looked at."""
    filled = m.view.fill(corners, lambda slots: _may_end_rays(m, slots, rays.count))
    if filled is None:
        return
    window, cells = filled
    _launch(m, window, rays, max_range, 2**31 - 1, 0, end_m, outcome)
    m.view.index.clear(window, cells)
    runtime.settle()


def _through_space(
    m: VoxelMap, rays: GivenRays, corners: NDArray[np.float64], max_range: float, end_m: Any, outcome: Any
) -> None:
    """As far as space is known. A layer of unknown bricks lies around it, so no ray leaves the window."""
    space = RaySpace(m)
    known = space.known_box_m()
    lower, upper = corners
    if known is not None:
        lower, upper = np.maximum(lower, known[0]), np.minimum(upper, known[1])
    if known is None or (lower > upper).any():
        end_m[:], outcome[:] = 0.0, _STOPPED
        return
    with space.indexed(lower, upper) as window:
        _launch(m, window, rays, max_range, space.unknown_from, 1, end_m, outcome)
        runtime.settle()


def _may_end_rays(m: VoxelMap, slots: NDArray[np.int32], rays: int) -> NDArray[np.bool_]:
    """True for the bricks (n,) with an occupied voxel: the others are passed in one step. Where rays are
    few, looking would cost more than it saves, and it is all of them."""
    marks = np.ones(len(slots), np.int32)
    if rays >= RAYS_A_BRICK * len(slots):
        pool = m.view.pool
        _mark_occupied(slots, pool.belief, pool.prior_log_odds, m.view.volume.min_evidence, marks)
        runtime.settle()
    return marks > 0


def _launch(
    m: VoxelMap,
    window: Window,
    rays: GivenRays,
    max_range: float,
    unknown_from: int,
    stop_in_unknown: int,
    end_m: Any,
    outcome: Any,
) -> None:
    view = m.view
    _cast(
        rays.within(window), max_range, view.pool.prior_log_odds, view.volume.min_evidence, unknown_from,
        stop_in_unknown, view.index.space(window), view.pool.belief, end_m, outcome,
    )  # fmt: skip


@ti.dataclass
class _Search(Struct):
    """A ray on the way to its end, and the condition that ends it."""

    prior: F32
    min_evidence: F32
    unknown_from: I32
    stop_in_unknown: I32
    end_m: F32
    outcome: I32


@ti.func
def _look(search: Template, belief: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray."""
    log_odds = search.prior
    if voxel < search.unknown_from:
        log_odds = belief[voxel]
    found = _PASSED
    state = state_of(log_odds, search.prior, search.min_evidence)
    if state == OCCUPIED:
        found = _HIT
    elif state == UNKNOWN and search.stop_in_unknown == 1:
        found = _STOPPED
    if found != _PASSED:
        search.outcome = found
        search.end_m = near
    return ti.cast(found == _PASSED, ti.i32)


@kernel
def _mark_occupied(slots: I32Array, belief: F32Array, prior: F32, min_evidence: F32, marks: I32Array) -> None:
    """Write to ``marks`` (n) whether a voxel of the brick in ``slots`` (n) is occupied."""
    for i in range(slots.shape[0]):
        found, k = 0, 0
        while k < VOXELS and found == 0:
            log_odds = belief[slots[i] * VOXELS + k]
            found = ti.cast(state_of(log_odds, prior, min_evidence) == OCCUPIED, ti.i32)
            k += 1
        marks[i] = found


@kernel
def _cast(
    rays: WindowRays, max_range: F32, prior: F32, min_evidence: F32, unknown_from: I32, stop_in_unknown: I32,
    space: Space, belief: F32Array, end_m: F32Array, outcome: I32Array,
) -> None:  # fmt: skip
    """Follow each ray until something ends it; where the unknown does, one that begins outside of the window
    ends at once.

    ``belief`` (pool * 512) holds log-odds. ``end_m`` (N) receives the range in metres, ``outcome`` (N) what
    ended the ray.
    """
    for i in range(outcome.shape[0]):
        start = rays.start(i)
        ray = make_ray(start, rays.way(i))
        search = _Search(prior, min_evidence, unknown_from, stop_in_unknown, max_range, _PASSED)
        if stop_in_unknown == 1 and ((start - space.lower).min() < 0.0 or (space.upper - start).min() <= 0.0):
            search.end_m = 0.0
            search.outcome = _STOPPED
        else:
            begin, end = 0.0, max_range
            clip(ray, begin, end, space.lower, space.upper)
            walk_voxels(ray, begin, end, space, _look, search, belief)
        end_m[i] = search.end_m
        outcome[i] = search.outcome
