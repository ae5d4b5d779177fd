"""The voxels that rays take for their first surface, by a vote of all rays.

For each ray of each keyframe the likeliest first surface is the voxel with the largest (symbols of
sum_product.py, with the marginals of the whole map as m)

    nu_i m_i vis_i

among the voxels that are likelier occupied than by the prior. The ray votes for it, and against every
voxel that it crosses before it. A voxel wins that more than two fifths of the rays that come as far as it
take for their surface. Rays whose measurement the map holds for an outlier do not vote.

A post that is thinner than a voxel stops a few of the rays that cross the voxel, and the others outvote them:
the marginal says free, and the measurements on the post are outliers to the map. They are counted, too. A ray
that no voxel explains ends in the voxel of its measurement. With the keyframes k in which such rays end in a
voxel, and p_j rays of each other keyframe j that pass it,

    score = sum_k ENDED - sum_j min(p_j, PASSED)

is the evidence that something in it stops rays, in tenths of a nat. A thing that is always there has ends in
most keyframes; one that moves, a flying pixel or a pose that is off has them in few, and the others outweigh
these. A voxel with more than DOUBT is not called free. With more than MATTER it is occupied, if it has no
more than ALONE occupied voxels around it: beside a larger surface, ends are its noise or its edge.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.inference.brick_sums import VOTES
from taichi_mrf.inference.keyframe import Keyframe, VisibleBricks
from taichi_mrf.inference.ray_model import RayModel
from taichi_mrf.inference.ray_posterior import FreeLogs, RayVisitor, follow_rays
from taichi_mrf.inference.workers import workers_without_trace
from taichi_mrf.kernels.bundles import Bundle, kernel
from taichi_mrf.kernels.types import F32, I32, F32Array, I32Array, I64Array, Struct, Template
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.voxels.blended_field import cell_of, voxel_around
from taichi_mrf.voxels.calls import DOUBT, MATTER, SUREST
from taichi_mrf.voxels.layout import VOXELS, grid_keys, rows_around
from taichi_mrf.voxels.numbering import flat, strip_begin, strip_length, voxel_number
from taichi_mrf.voxels.pool import BrickPool, PoolPart
from taichi_mrf.voxels.traversal import walk_voxels, within
from taichi_mrf.voxels.window import WindowIndex

FOR, AGAINST = 3, 2
"""Weights of a vote for a voxel and of one against it: a voxel wins if more than two fifths of the rays that
come as far take it for their surface. With half, walls have holes where voxels are finer than the noise."""

GRAZED = 0.1
"""A ray that is in a voxel for less than this, in voxel sizes, does not vote against it."""

UNEXPLAINED = 1e-3
"""A ray ends in the voxel of its measurement if no voxel likelier than the prior made that with more than
this density, in 1/m."""

SHARPEST_VOXELS = 1.0
"""Only rays with a sigma up to this, in voxel sizes, tell the voxel in which they end."""

ENDED, PASSED = 39, 10
"""Tenths of a nat for a keyframe with ends in a voxel, log(1 / .02): one in fifty has them where nothing is;
and the most against, for one without."""

ALONE, NEIGHBOURS = 3, 2
"""Occupied voxels at most around one that is occupied by its score, and how many voxels away they count."""

_PASS, _END = 21, 42
"""Lowest bits of the numbers of rays that vote against a voxel and that end in it, among the counts of one
keyframe. Those that vote for it are below. Each number has 21 bits."""

CALLED = 0.01
"""Log-odds above even odds, or above what counts as known, that a voxel that wins has at least."""


def count_votes(
    keyframes: Iterable[tuple[Keyframe, VisibleBricks]],
    pool: BrickPool | PoolPart,
    model: RayModel,
    volume: VolumeConfig,
    between: Callable[[], object] = lambda: None,
) -> "ti.Ndarray":
    """The votes and the score of each voxel, (capacity * 512 * VOTES) int32, of keyframes with their lists of
    visible bricks; ``model`` are the parameters of their rays. ``between`` is called after each keyframe."""
    learnt = pool.prior_log_odds + volume.min_evidence
    index = WindowIndex()
    votes, counts = no_votes(pool.belief.shape[0]), ti.ndarray(ti.i64, pool.belief.shape)
    counts.fill(0)
    free_logs, vote = FreeLogs.of(pool, model), _Vote(pool.belief, learnt, counts)
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
            _tally(visible.slots, counts, votes, strip_length())
            runtime.settle()
        between()
    return votes


def no_votes(voxels: int) -> "ti.Ndarray":
    """Votes and scores of so many voxels, all 0."""
    votes = ti.ndarray(ti.i32, VOTES * voxels)
    votes.fill(0)
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
    """Adds what the rays of a keyframe say to its ``counts`` (pool * 512); ``belief`` (pool * 512) are
    log-odds, of which those above ``learnt`` are likelier than by the prior."""

    belief: F32Array
    learnt: F32
    counts: I64Array

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
            ti.atomic_add(self.counts[ahead.surface], ti.cast(1, ti.i64))
            voting = _Voting(self.counts, ahead.surface, sight.voxels_per_depth)
            walk_voxels(sight.ray, sight.begin, sight.end, sight.space, _vote_against, ahead, voting)
        if ahead.largest <= UNEXPLAINED and beyond <= sight.model.floor:
            depth = sight.sensor.surface_depth(sight.measured, sight.noise)
            sharp = sight.noise.sigma(depth) * sight.voxels_per_depth <= SHARPEST_VOXELS
            if sharp and depth > sight.begin and depth < sight.end:
                voxel = _voxel_at(sight.ray, depth, sight.space)
                if voxel >= 0:
                    ti.atomic_add(self.counts[voxel], ti.cast(1, ti.i64) << _END)


@ti.func
def _voxel_at(ray: Template, depth: F32, space: Template) -> I32:
    """The voxel that a ray is in at a depth, -1 where there is none."""
    cell = ti.cast(ti.floor(ray.origin + depth * ray.direction), ti.i32)
    brick, voxel = cell >> 3, -1
    if within(brick, space.shape):
        slot = space.bricks[flat(brick, space.shape)]
        if slot >= 0:
            voxel = slot * VOXELS + voxel_number(cell & 7)
    return voxel


@dataclass(frozen=True)
class _Voting(Bundle):
    """A ray that votes, and what it votes for."""

    counts: I64Array
    surface: I32
    voxels_per_depth: F32


@ti.func
def _vote_against(state: Template, voting: Template, voxel: I32, near: F32, far: F32):
    """One voxel in front of the likeliest surface."""
    before = ti.cast(voxel != voting.surface, ti.i32)
    if before == 1 and (far - near) * voting.voxels_per_depth > GRAZED:
        ti.atomic_add(voting.counts[voxel], ti.cast(1, ti.i64) << _PASS)
    return before


@kernel
def _tally(slots: I32Array, counts: I64Array, votes: I32Array, strip: Template) -> None:
    """Add what the rays of one keyframe say to the ``votes`` and scores (pool * 512 * VOTES) in the bricks in
    ``slots`` (n) that it sees, and set its ``counts`` (pool * 512) there to 0."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        _, first = strip_begin(part, slots, strip)
        for k in range(strip):
            said = counts[first + k]
            if said != 0:
                counts[first + k] = 0
                above, ended = said >> _PASS, said >> _END
                won = ti.cast(said - (above << _PASS), ti.i32)
                passed = ti.cast(above - (ended << (_END - _PASS)), ti.i32)
                votes[VOTES * (first + k)] += FOR * won - AGAINST * passed
                if ended > 0:
                    votes[VOTES * (first + k) + 1] += ENDED
                elif won == 0:
                    votes[VOTES * (first + k) + 1] -= ti.min(passed, PASSED)


def call_winners(votes: "ti.Ndarray", log_odds: "ti.Ndarray", prior: float, min_evidence: float) -> None:
    """Raise the ``log_odds`` (n) of voxels that win the ``votes`` (n * VOTES), so that they are occupied.
    Those whose evidence has since gone below what is known of them stay."""
    _call(votes, log_odds, prior + min_evidence, called(prior, min_evidence))


def called(prior_log_odds: float, min_evidence: float) -> float:
    """The least log-odds of a voxel that wins the vote."""
    return max(0.0, prior_log_odds + min_evidence) + CALLED


@kernel
def add_votes(slots: I32Array, more: I32Array, votes: I32Array) -> None:
    """Add votes and scores ``more`` (n * 512 * VOTES) in the bricks in ``slots`` (n)."""
    for i in range(slots.shape[0] * VOXELS * VOTES):
        votes[slots[i // (VOXELS * VOTES)] * (VOXELS * VOTES) + i % (VOXELS * VOTES)] += more[i]


@ti.kernel
def _call(votes: I32Array, log_odds: F32Array, learnt: F32, least: F32):
    """Raise the ``log_odds`` (n) of voxels that win the ``votes`` (n * VOTES) to ``least``, if they are above
    ``learnt``."""
    for i in range(log_odds.shape[0]):
        if votes[VOTES * i] > 0 and log_odds[i] > learnt:
            log_odds[i] = ti.max(log_odds[i], least)


def call_unexplained(
    votes: "ti.Ndarray",
    log_odds: "ti.Ndarray",
    bricks: NDArray[np.int32],
    slots: NDArray[np.int32],
    prior: float,
    min_evidence: float,
) -> None:
    """Change the ``log_odds`` (n), by which voxels have their states, where the scores say that there is
    matter. An occupied voxel gets those of its score, one in doubt that was free the prior, which is unknown.
    ``bricks`` (capacity, 3) are those of the map, which are in ``slots`` (m)."""
    rule = prior + min_evidence, prior - min_evidence
    found = np.zeros(len(slots), np.int32)
    _find_doubted(slots, votes, log_odds, rule[0], found)
    doubted = np.flatnonzero(found)
    if not len(doubted):
        return
    order = np.argsort(grid_keys(bricks[slots]))
    around = rows_around(bricks[slots[doubted]], grid_keys(bricks[slots[order]]))
    around = np.where(around >= 0, slots[order][around], -1).astype(np.int32)
    verdicts = ti.ndarray(ti.i32, len(doubted) * VOXELS)
    _judge(slots[doubted], around.reshape(-1), votes, log_odds, *rule, verdicts)
    _carry_out(slots[doubted], verdicts, votes, log_odds, prior, called(prior, min_evidence))
    runtime.settle()


_STAYS, _UNKNOWN, _MATTER = 0, 1, 2


@kernel
def _find_doubted(slots: I32Array, votes: I32Array, log_odds: F32Array, learnt: F32, found: I32Array) -> None:
    """Mark the bricks in ``slots`` (n) with a voxel in doubt that is not occupied."""
    for i in range(slots.shape[0]):
        doubted = 0
        for k in range(VOXELS):
            voxel = slots[i] * VOXELS + k
            if votes[VOTES * voxel + 1] > DOUBT and log_odds[voxel] <= learnt:
                doubted = 1
        found[i] = doubted


@kernel
def _judge(
    slots: I32Array, around: I32Array, votes: I32Array, log_odds: F32Array, learnt: F32, free_below: F32,
    verdicts: I32Array,
) -> None:  # fmt: skip
    """The verdict on each voxel of the bricks in ``slots`` (n), (n * 512), by its score and the occupied
    voxels around it; ``around`` (n * 27) are the slots of the bricks around each."""
    for i in range(slots.shape[0] * VOXELS):
        place, voxel = i // VOXELS, slots[i // VOXELS] * VOXELS + i % VOXELS
        score = votes[VOTES * voxel + 1]
        verdicts[i] = _STAYS
        if score > DOUBT and log_odds[voxel] <= learnt:
            occupied, side = 0, 2 * NEIGHBOURS + 1
            for k in range(side * side * side):
                step = ti.Vector([k // (side * side), k // side % side, k % side]) - NEIGHBOURS
                other = voxel_around(around, place, cell_of(i % VOXELS) + step)
                if other >= 0 and log_odds[other] > ti.max(learnt, 0.0):
                    occupied += 1
            if score > MATTER and occupied <= ALONE:
                verdicts[i] = _MATTER
            elif log_odds[voxel] < free_below:
                verdicts[i] = _UNKNOWN


@kernel
def _carry_out(
    slots: I32Array, verdicts: I32Array, votes: I32Array, log_odds: F32Array, prior: F32, least: F32
) -> None:
    """Change the ``log_odds`` by the ``verdicts`` (n * 512) on the bricks in ``slots`` (n)."""
    for i in range(slots.shape[0] * VOXELS):
        voxel = slots[i // VOXELS] * VOXELS + i % VOXELS
        if verdicts[i] == _MATTER:
            evidence = prior + 0.1 * votes[VOTES * voxel + 1]
            log_odds[voxel] = ti.max(ti.min(evidence, SUREST), least)
        elif verdicts[i] == _UNKNOWN:
            log_odds[voxel] = prior
