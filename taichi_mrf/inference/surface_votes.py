"""The voxels that rays take for their first surface, by a vote of all rays.

For each ray of each keyframe the likeliest first surface is the voxel with the largest (symbols of
sum_product.py, with the marginals of the whole map as m)

    nu_i m_i vis_i

among the voxels that are likelier occupied than by the prior. The ray votes for it, and against every
voxel that it crosses before it. A voxel wins that more than two fifths of the rays that come as far as it
take for their surface. Rays whose measurement the map holds for an outlier do not vote.

A post that is thinner than a voxel stops a few of the rays that cross the voxel, and the others outvote them:
the marginal says free. Ends are therefore counted, too, whatever the marginals explain them by. A measurement
whose sigma is small ends in one voxel. With e_k the most that an end says of a voxel that other rays of the
keyframe k pass, and p_j the rays of each keyframe j without an end in it that pass,

    score = sum_k e_k - sum_j min(p_j, PASSED)

is the evidence, in twentieths of a nat, that something in the voxel stops one ray in twenty. A keyframe whose
rays all end in a voxel says nothing: that voxel is full, and the marginals' business. A thing that is always
there has ends in most keyframes; one that moves, a flying pixel or a pose that is off has them in few, and
the others outweigh these. What follows from a score is in thin_matter.py.

In a world that may change, each keyframe that sees a voxel takes a quarter from its score first, so that what
has gone is forgotten.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from taichi_mrf.config.schema import VolumeConfig
from taichi_mrf.inference.brick_sums import VOTES
from taichi_mrf.inference.keyframe import Keyframe, VisibleBricks
from taichi_mrf.inference.ray_model import RayModel
from taichi_mrf.inference.ray_posterior import FreeLogs, RayVisitor, follow_rays
from taichi_mrf.inference.workers import workers_without_trace
from taichi_mrf.system import runtime
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.resident import zeros
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, I64Array, Struct, Template
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.numbering import strip_begin, strip_length
from taichi_mrf.voxels.pool import BrickPool, PoolPart
from taichi_mrf.voxels.traversal import voxel_in, walk_voxels
from taichi_mrf.voxels.window import WindowIndex

FOR, AGAINST = 3, 2
"""Weights of a vote for a voxel and of one against it: a voxel wins if more than two fifths of the rays that
come as far take it for their surface. With half, walls have holes where voxels are finer than the noise."""

GRAZED = 0.1
"""A ray that is in a voxel for less than this, in voxel sizes, does not vote against it."""

SHARP, BLURRED = 0.25, 1.0
"""Sigmas, in voxel sizes: up to the first an end says ENDED, up to the second BLURRED_END, then nothing."""

ENDED, BLURRED_END = 78, 40
"""Twentieths of a nat that an end says of its voxel, log(1 / .02) and log(1 / .135): in so many keyframes
there is one where nothing is."""

PASSED = 30
"""The most that the passing rays of one keyframe say against, for poses that are off."""

BEFORE_SIGMAS = 3.0
"""A ray without a surface to vote for passes what lies so many sigmas before its measurement."""

FADING, FREE_FADING = 2, 4
"""A keyframe takes 1 / 2^FADING from the scores of what it sees, in a world that may change, and less from
those below 0: one end in space that was free for long is noise."""

LASTING = ENDED << FADING
"""The largest score that fading leaves."""

_PASS, _SILENT = 21, 42
"""Lowest bits of the numbers of rays that vote against a voxel, and that pass it without a vote, among the
counts of one keyframe. Those that vote for it are below. Each number has 21 bits."""

CALLED = 0.01
"""Log-odds above even odds, or above what counts as known, that a voxel that wins has at least."""


def count_votes(
    keyframes: Iterable[tuple[Keyframe, VisibleBricks]],
    pool: BrickPool | PoolPart,
    model: RayModel,
    volume: VolumeConfig,
    votes: "ti.Ndarray",
    changing: bool = False,
    between: Callable[[], object] = lambda: None,
) -> None:
    """Add the rays of keyframes, with their lists of visible bricks, to the votes and scores
    (capacity * 512 * VOTES) int32; ``model`` are the parameters of their rays. In a ``changing`` world their
    order counts, and old scores fade. ``between`` is called after each keyframe."""
    learnt = pool.prior_log_odds + volume.min_evidence
    index = WindowIndex()
    counts, ends = (zeros(kind, pool.belief.shape[0]) for kind in (np.int64, np.int32))
    free_logs, vote = FreeLogs.of(pool, model), _Vote(pool.belief, learnt, counts, ends)
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
            _tally(visible.slots, counts, ends, votes, int(changing), strip_length())
            runtime.settle()
        between()


def no_votes(voxels: int) -> "ti.Ndarray":
    """Votes and scores of so many voxels, all 0."""
    return ti.ndarray(ti.i32, VOTES * voxels)


@ti.dataclass
class _Ahead(Struct):
    """A ray on its way from the camera."""

    visibility: F32
    explained: F32
    largest: F32  # nu m vis so far
    surface: I32  # the voxel of the largest, -1 before there is one


@dataclass(frozen=True)
class _Vote(RayVisitor):
    """Adds what the rays of a keyframe say to its ``counts`` and ``ends`` (pool * 512); ``belief`` (pool *
    512) are log-odds, of which those above ``learnt`` are likelier than by the prior."""

    belief: F32Array
    learnt: F32
    counts: I64Array
    ends: I32Array

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
        depth = sight.sensor.surface_depth(sight.measured, sight.noise)
        sigma, inside = sight.noise.sigma(depth), depth > sight.begin and depth < sight.end
        blur = sigma * sight.voxels_per_depth
        if inside and blur <= BLURRED:
            place = sight.ray.origin + depth * sight.ray.direction
            voxel = voxel_in(sight.space, ti.cast(ti.floor(place), ti.i32))
            if voxel >= 0:
                said = ENDED
                if blur > SHARP:
                    said = BLURRED_END
                ti.atomic_max(self.ends[voxel], said)
        surface, until = -1, depth - BEFORE_SIGMAS * sigma
        if ahead.surface >= 0 and ahead.explained > sight.model.floor:
            surface, until = ahead.surface, sight.end
            ti.atomic_add(self.counts[surface], ti.cast(1, ti.i64))
        if surface >= 0 or inside:
            one = ti.cast(1, ti.i64) << _PASS
            if surface < 0:
                one = ti.cast(1, ti.i64) << _SILENT
            voting = _Voting(self.counts, one, surface, until, sight.voxels_per_depth)
            walk_voxels(sight.ray, sight.begin, sight.end, sight.space, _vote_against, ahead, voting)


@dataclass(frozen=True)
class _Voting(Bundle):
    """A ray, the count of one that passes, and where it passes no more: at a ``surface``, -1 for none, or at
    a depth."""

    counts: I64Array
    one: Template
    surface: I32
    until: F32
    voxels_per_depth: F32


@ti.func
def _vote_against(state: Template, voting: Template, voxel: I32, near: F32, far: F32):
    """One voxel in front of the likeliest surface."""
    before = ti.cast(voxel != voting.surface and near <= voting.until, ti.i32)
    if before == 1 and far <= voting.until and (far - near) * voting.voxels_per_depth > GRAZED:
        ti.atomic_add(voting.counts[voxel], voting.one)
    return before


@kernel
def _tally(
    slots: I32Array, counts: I64Array, ends: I32Array, votes: I32Array, changing: I32, strip: Template
) -> None:
    """Add what the rays of one keyframe say to the ``votes`` and scores (pool * 512 * VOTES) in the bricks in
    ``slots`` (n) that it sees, and set its ``counts`` and ``ends`` (pool * 512) there to 0. ``changing`` is 1
    in a world that may change."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        _, first = strip_begin(part, slots, strip)
        for k in range(strip):
            voxel = first + k
            said, ended = counts[voxel], ends[voxel]
            if said != 0 or ended != 0:
                counts[voxel], ends[voxel] = 0, 0
                above, silent = said >> _PASS, said >> _SILENT
                won = ti.cast(said - (above << _PASS), ti.i32)
                against = ti.cast(above - (silent << (_SILENT - _PASS)), ti.i32)
                passed = against + ti.cast(silent, ti.i32)
                votes[VOTES * voxel] += FOR * won - AGAINST * against
                score = votes[VOTES * voxel + 1]
                if changing == 1:
                    score -= score >> (FADING if score > 0 else FREE_FADING)
                if ended == 0:
                    score -= ti.min(passed, PASSED)
                elif passed > 0:
                    score += ended
                votes[VOTES * voxel + 1] = score


def call_winners(votes: "ti.Ndarray", log_odds: "ti.Ndarray", prior: float, min_evidence: float) -> None:
    """Raise the ``log_odds`` (n) of voxels that win the ``votes`` (n * VOTES), so that they are occupied.
    Those whose evidence has since gone below what is known of them stay."""
    _call(votes, log_odds, prior + min_evidence, called(prior, min_evidence))


def called(prior_log_odds: float, min_evidence: float) -> float:
    """The least log-odds of a voxel that wins the vote."""
    return max(0.0, prior_log_odds + min_evidence) + CALLED


@kernel
def set_votes(slots: I32Array, those: I32Array, votes: I32Array) -> None:
    """Set the votes and scores in the bricks in ``slots`` (n) to ``those`` (n * 512 * VOTES)."""
    for i in range(slots.shape[0] * VOXELS * VOTES):
        votes[slots[i // (VOXELS * VOTES)] * (VOXELS * VOTES) + i % (VOXELS * VOTES)] = those[i]


@kernel
def clear_votes(slots: I32Array, votes: I32Array) -> None:
    """Set the votes and scores in the bricks in ``slots`` (n) to 0."""
    for i in range(slots.shape[0] * VOXELS * VOTES):
        votes[slots[i // (VOXELS * VOTES)] * (VOXELS * VOTES) + i % (VOXELS * VOTES)] = 0


@kernel
def move_votes(slots: I32Array, votes: I32Array, part: I32Array, back: I32) -> None:
    """Copy the votes and scores in the bricks in ``slots`` (n) to those of a part of the map, (n * 512 *
    VOTES) at least, or with ``back`` from there."""
    for i in range(slots.shape[0] * VOXELS * VOTES):
        here = slots[i // (VOXELS * VOTES)] * (VOXELS * VOTES) + i % (VOXELS * VOTES)
        if back == 1:
            votes[here] = part[i]
        else:
            part[i] = votes[here]


@ti.kernel
def _call(votes: I32Array, log_odds: F32Array, learnt: F32, least: F32):
    """Raise the ``log_odds`` (n) of voxels that win the ``votes`` (n * VOTES) to ``least``, if they are above
    ``learnt``."""
    for i in range(log_odds.shape[0]):
        if votes[VOTES * i] > 0 and log_odds[i] > learnt:
            log_odds[i] = ti.max(log_odds[i], least)
