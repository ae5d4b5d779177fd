"""The voxels that rays take for their first surface, by a vote of all rays.

For each ray of each keyframe the likeliest first surface is the voxel with the largest (symbols of
sum_product.py, with the marginals of the whole map as m)

    nu_i m_i vis_i

among the voxels that are likelier occupied than by the prior. The ray votes for it, and against every
voxel that it crosses before it. A voxel wins that more than two fifths of the rays that come as far as it
take for their surface. Rays whose measurement the map holds for an outlier do not vote.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.inference.keyframe import Keyframe, VisibleBricks
from taichi_mrf.inference.ray_model import RayModel
from taichi_mrf.inference.ray_posterior import FreeLogs, RayVisitor, follow_rays
from taichi_mrf.inference.workers import workers_without_trace
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, Struct, Template
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.pool import BrickPool, PoolPart
from taichi_mrf.voxels.traversal import walk_voxels
from taichi_mrf.voxels.window import WindowIndex

FOR, AGAINST = 3, 2
"""Weights of a vote for a voxel and of one against it: a voxel wins if more than two fifths of the rays that
come as far take it for their surface. With half, walls have holes where voxels are finer than the noise."""

GRAZED = 0.1
"""A ray that is in a voxel for less than this, in voxel sizes, does not vote against it."""

CALLED = 0.01
"""Log-odds above even odds, or above what counts as known, that a voxel that wins has at least."""


def count_votes(
    keyframes: Iterable[tuple[Keyframe, VisibleBricks]],
    pool: BrickPool | PoolPart,
    model: RayModel,
    volume: VolumeConfig,
    between: Callable[[], object] = lambda: None,
) -> "ti.Ndarray":
    """The votes for and against each voxel, (capacity * 512) int32, of keyframes with their lists of visible
    bricks; ``model`` are the parameters of their rays. ``between`` is called after each keyframe."""
    learnt = pool.prior_log_odds + volume.min_evidence
    index = WindowIndex()
    votes = ti.ndarray(ti.i32, pool.belief.shape)
    votes.fill(0)
    free_logs, vote = FreeLogs.of(pool, model), _Vote(pool.belief, learnt, votes)
    for keyframe, visible in keyframes:
        if len(visible.slots) > 0:
            window = keyframe.footprint.window
            index.fill(window, visible.cells, visible.slots)
            follow_rays(
                keyframe.ray_list, keyframe.image.sensor, window.viewpoint(keyframe.T_world_camera),
                index.space(window, volume.lower, volume.upper),
                model, free_logs, workers_without_trace(), vote,
            )  # fmt: skip
            index.clear(window, visible.cells)
            runtime.settle()
        between()
    return votes


@ti.dataclass
class _Ahead(Struct):
    """A ray on its way from the camera."""

    visibility: F32
    explained: F32
    largest: F32  # nu m vis so far
    surface: I32  # the voxel of the largest, -1 before there is one


@dataclass(frozen=True)
class _Vote(RayVisitor):
    """Adds the votes of rays to ``votes`` (pool * 512); ``belief`` (pool * 512) are log-odds, of which those
    above ``learnt`` are likelier than by the prior."""

    belief: F32Array
    learnt: F32
    votes: I32Array

    @ti.func
    def begin(self, sight: Template):
        return _Ahead(1.0, 0.0, 0.0, -1)

    @ti.func
    def meet(self, ahead: Template, sight: Template, voxel: I32, here: F32):
        if here > ahead.largest and self.belief[voxel] > self.learnt:
            ahead.largest = here
            ahead.surface = voxel
        return 1

    @ti.func
    def end(self, ahead: Template, sight: Template, beyond: F32):
        if ahead.surface >= 0 and ahead.explained > sight.model.floor:
            ti.atomic_add(self.votes[ahead.surface], FOR)
            voting = _Voting(self.votes, ahead.surface, sight.voxels_per_depth)
            walk_voxels(sight.ray, sight.begin, sight.end, sight.space, _vote_against, ahead, voting)


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


def call_winners(votes: "ti.Ndarray", log_odds: "ti.Ndarray", prior: float, min_evidence: float) -> None:
    """Raise the ``log_odds`` (n) of voxels that win the ``votes`` (n), so that they are occupied: those whose
    evidence has since gone below what is known of them stay."""
    _call(votes, log_odds, prior + min_evidence, called(prior, min_evidence))


def called(prior_log_odds: float, min_evidence: float) -> float:
    """The least log-odds of a voxel that wins the vote."""
    return max(0.0, prior_log_odds + min_evidence) + CALLED


@kernel
def add_votes(slots: I32Array, more: I32Array, votes: I32Array) -> None:
    """Add votes ``more`` (n * 512) in the bricks in ``slots`` (n)."""
    for i in range(slots.shape[0] * VOXELS):
        votes[slots[i // VOXELS] * VOXELS + i % VOXELS] += more[i]


@ti.kernel
def _call(votes: I32Array, log_odds: F32Array, learnt: F32, least: F32):
    """Raise the ``log_odds`` (n) of voxels that win the ``votes`` (n), if they are above ``learnt``, to
    ``least``."""
    for i in range(votes.shape[0]):
        if votes[i] > 0 and log_odds[i] > learnt:
            log_odds[i] = ti.max(log_odds[i], least)
