"""Sum-product belief propagation on the ray Markov random field: the method itself.

    p(o, d) = 1/Z  prod_i phi(o_i)  prod_r psi_r(o_r, d_r)                                    (1)

A voxel o_i is 1 if occupied; a ray r is a factor over all voxels that it crosses, and says how well the
first occupied one among them explains the measured depth (eqs. 3 to 5). Equation numbers are those of
Shankar & Michael, "MRFMap: Online Probabilistic 3D Mapping using Forward Ray Sensor Models" (RSS 2020);
the supplement's are marked S.

All rays of a keyframe send a voxel the same, average message (section IV-A), so a keyframe keeps one
message for each voxel that it sees, and a sweep over it is four steps:

    cavity     what all others believe of each voxel                    belief - own message      (6)
    forward    follow each ray: which voxel may have made the measurement?                  (4), (11)
    backward   tell each voxel what that implies for it                                    (13), (14)
    finish     average over rays, renew the keyframe's message, update the beliefs          (7), (8)

With ``maximise`` the middle two are those of max_product.py. Messages and beliefs are log-odds. A voxel
counts by the length l (in voxel sizes) that a ray spends in it: it lets the ray pass with probability
(1 - m)^l where m is its probability of being occupied.
"""

import taichi as ti

from taichi_mrf.inference.accumulators import add_message, length_sum, mean_message
from taichi_mrf.inference.first_occupied import NEVER
from taichi_mrf.inference.max_product import best_message, cost, see_best
from taichi_mrf.inference.ray_list import block_of
from taichi_mrf.kernels.log_odds import clamped_log_odds, exp_of_negative, logistic, softplus
from taichi_mrf.kernels.types import (
    F32,
    I32,
    AnyArray,
    F32Array,
    F32Array3,
    I32Array,
    I64Array,
    IVec3,
    Mat3,
    Struct,
    Template,
    Vec3,
    Vec4,
    Vec4Array,
)
from taichi_mrf.sensor.forward import (
    SUPPORT,
    PixelNoise,
    beyond_likelihood,
    depth_of_deviation,
    pixel_noise,
    surface_likelihood,
)
from taichi_mrf.sensor.rays import deals, dealt_ray, pixel_direction
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.strips import strip_begin
from taichi_mrf.voxels.traversal import clip, make_ray, walk_voxels

TINY = 1e-30
"""Keeps a ray that explains nothing, without an outlier floor, from dividing zero by zero."""

MOVED = 0.01
"""A marginal that changes by more than this counts as moved (the residual of a sweep)."""


@ti.dataclass
class ForwardPass(Struct):
    """What is known of a ray on its way from the camera."""

    measured: F32  # axial depth, metres
    noise: PixelNoise
    support: F32  # depth before which no surface can have made the measurement
    voxels_per_depth: F32  # length of the ray, in voxels, for one metre of axial depth
    visibility: F32  # prod_{k < i} (1 - m_k)^{l_k}
    explained: F32  # sum_{j < i} of eq. 11; for max-product the least cost of such an explanation
    first: F32  # depth at which the ray enters its first voxel
    voxels: I32
    trace: I32  # where this ray's steps are written down


@ti.kernel
def cavity(
    slots: I32Array, belief: F32Array, messages: AnyArray, lowest: F32, highest: F32,
    log_free: F32Array, sums: I64Array, strip: Template,
):  # fmt: skip
    """Eq. 6: what a voxel tells this keyframe's rays is all that it knows but from them.

    Writes log(1 - m) for each voxel, its log-odds bounded by ``lowest`` and ``highest``, and empties the
    sums. ``strip``: voxels an iteration (voxels/strips.py), here and below.
    """
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            log_odds = belief[j + k] - ti.cast(messages[i + k], ti.f32)
            log_free[i + k] = -softplus(ti.max(lowest, ti.min(highest, log_odds)))
            sums[i + k] = 0


@ti.kernel
def send_messages(
    blocks: I32Array, depth: F32Array, rays: I32, entry_depths: F32Array, entry_depths_known: I32,
    width: I32, intrinsics: Vec4, centre: Vec3, to_voxels: Mat3,
    noise: F32Array3, patch: I32, columns: I32,
    voxel_size: F32, max_depth: F32, end_sigmas: F32, floor: F32,
    shape: IVec3, box_lower: Vec3, box_upper: Vec3, chunks: I32Array, bricks: I32Array,
    log_free: F32Array, sums: I64Array, scale: F32, clamp: F32,
    trace_voxel: I32Array, trace: Vec4Array, longest: I32, steps: I32Array,
    workers: I32, run: I32, spread: I32,
    likelihood: Template, segment_lengths: Template, log_average: Template, maximise: Template,
    retrace: Template, block_dim: Template,
):  # fmt: skip
    """Follow the rays of a keyframe there and back, and sum up what they tell each voxel.

    A worker follows one ray after the other and writes each ray's steps into its own part of the trace,
    so that the way back need not be walked again. ``longest`` is never less than a ray has voxels.
    With ``retrace``, which cannot ``maximise``, each ray is followed a second time and leaves no trace.
    ``steps`` receives each worker's number of voxels crossed.
    ``entry_depths`` holds the depth at which each ray meets its first brick: found by the first sweep, and
    where later sweeps start. Rays are dealt out in runs of ``run`` neighbours; one that
    stands for a block of pixels counts as many as they are.
    """
    if ti.static(block_dim > 0):
        ti.loop_config(block_dim=block_dim)
    for iteration in range(workers * spread):
        worker = iteration // spread
        largest = ti.exp(clamp)
        turns = 0
        if iteration % spread == 0:
            turns = deals(workers, run, rays)
            steps[worker] = 0
        for turn in range(turns):
            i = dealt_ray(worker, turn, workers, run)
            if i < rays:
                measured = depth[i]
                u, v, wide, high = block_of(blocks[i], width)
                middle = pixel_direction(u + 0.5 * (wide - 1), v + 0.5 * (high - 1), intrinsics)
                direction = to_voxels @ middle
                ray = make_ray(centre, direction)
                here = pixel_noise(noise, patch, columns, u + wide // 2, v + high // 2)

                # The ray ends where its measurement has nothing more to say, or where the map does.
                last = depth_of_deviation(measured, -end_sigmas, here)
                begin, end = 0.0, ti.min(last, max_depth)
                if entry_depths_known == 1:
                    begin = entry_depths[i]
                clip(ray, begin, end, box_lower, box_upper)

                # Forward: eq. 11 for each voxel, from the camera outwards.
                ahead = ForwardPass(
                    measured, here, depth_of_deviation(measured, SUPPORT, here), direction.norm(),
                    1.0, NEVER if ti.static(maximise) else 0.0, end, 0, worker * longest,
                )  # fmt: skip
                walk_voxels(
                    ray, begin, end, shape, chunks, bricks, _see_voxel, ahead,
                    (log_free, voxel_size, likelihood, segment_lengths,
                     trace_voxel, trace, maximise, retrace, floor),
                )  # fmt: skip

                if entry_depths_known == 0:
                    entry_depths[i] = ahead.first
                steps[worker] += ahead.voxels

                # What gets through to where the map ends may have met its surface there.
                behind = 0.0
                if end < last:
                    behind = beyond_likelihood(measured, end, here)
                behind = cost(behind, floor + TINY) if ti.static(maximise) else ahead.visibility * behind

                # Backward: eqs. 13 and 14 for each voxel, from the far end.
                pixels = ti.cast(wide * high, ti.f32)
                if ti.static(retrace):
                    # From the near end again: what lies behind a voxel is what neither it nor those before
                    # it explain.
                    total = ahead.explained + behind
                    again = ForwardPass(
                        measured, here, ahead.support, ahead.voxels_per_depth, 1.0, 0.0, end, 0, 0
                    )  # fmt: skip
                    if ahead.voxels > 0:
                        walk_voxels(
                            ray, ahead.first, end, shape, chunks, bricks, _tell_voxel, again,
                            (log_free, voxel_size, likelihood, segment_lengths,
                             sums, total, pixels, scale, floor, clamp, largest, log_average),
                        )  # fmt: skip
                else:
                    for step in range(ahead.voxels):
                        j = ahead.trace + ahead.voxels - 1 - step
                        message = 0.0
                        if ti.static(maximise):
                            message = best_message(trace[j], behind, clamp, log_average)
                        else:
                            free, density, before = trace[j][1], trace[j][2], trace[j][3]
                            message = _message(
                                before, density, behind, free, floor, clamp, largest, log_average
                            )
                            behind += (1.0 - free) * density
                        weight = pixels
                        if ti.static(segment_lengths):
                            weight *= trace[j][0]
                        add_message(sums, trace_voxel[j], weight, message, scale)


@ti.func
def _crossing(way: Template, context: Template, voxel: I32, near: F32, far: F32) -> Vec3:
    """How long a ray is in a voxel, the log-chance that the voxel lets it pass, and the density of its
    measurement if not; ``near`` and ``far`` bound the ray's segment in it, in axial depth."""
    length = (far - near) * way.voxels_per_depth
    log_free = context[0][voxel]
    if ti.static(context[3]):
        log_free *= length
    density = 0.0
    if far > way.support:
        density = surface_likelihood(way.measured, near, far, way.noise, context[1], context[2])
    return Vec3(length, log_free, density)


@ti.func
def _see_voxel(ahead: Template, context: Template, voxel: I32, near: F32, far: F32):
    """One voxel of the forward pass."""
    met = _crossing(ahead, context, voxel, near, far)
    if ahead.voxels == 0:
        ahead.first = near
    j = ahead.trace + ahead.voxels
    if ti.static(not context[7]):
        context[4][j] = voxel
    if ti.static(context[6]):
        context[5][j] = see_best(ahead.explained, met[0], met[1], met[2], context[8] + TINY)
    else:
        # Eq. 4, and eq. 11: the voxel is seen, it is occupied, and it explains the measurement.
        free = exp_of_negative(met[1])
        density = met[2] * ahead.visibility
        if ti.static(not context[7]):
            context[5][j] = Vec4(met[0], free, density, ahead.explained)
        ahead.explained += (1.0 - free) * density
        ahead.visibility *= free
    ahead.voxels += 1
    return 1


@ti.func
def _tell_voxel(again: Template, context: Template, voxel: I32, near: F32, far: F32):
    """One voxel of the second way along a ray (``retrace``)."""
    met = _crossing(again, context, voxel, near, far)
    free = exp_of_negative(met[1])
    density = met[2] * again.visibility
    before = again.explained
    again.explained += (1.0 - free) * density
    again.visibility *= free
    behind = ti.max(0.0, context[5] - again.explained)
    weight = context[6]
    if ti.static(context[3]):
        weight *= met[0]
    message = _message(
        before, density, behind, free, context[8], context[9], context[10], context[11]
    )  # fmt: skip
    add_message(context[4], voxel, weight, message, context[7])
    return 1


@ti.func
def _message(
    before: F32, here: F32, behind: F32, free: F32, floor: F32, clamp: F32, largest: F32,
    log_average: Template,
) -> F32:  # fmt: skip
    """What a ray tells a voxel, in [0, 1] for the accumulators."""
    occupied = occupied_message(before, here, floor)
    empty = empty_message(before, behind, free, floor)
    message = occupied / (occupied + empty)
    if ti.static(log_average):
        message = clamped_log_odds(occupied, empty, clamp, largest)
    return message


@ti.func
def occupied_message(before: F32, here: F32, floor: F32) -> F32:
    """Eq. 13: a voxel before this one made the measurement, or this one did if it is occupied."""
    return before + here + (floor + TINY)


@ti.func
def empty_message(before: F32, behind: F32, free: F32, floor: F32) -> F32:
    """Eq. 14: a voxel before this one made the measurement, or one behind it did if this one is empty.

    ``behind`` was seen through this voxel and is divided by the chance of getting through.
    """
    return before + behind / ti.max(free, TINY) + (floor + TINY)


@ti.kernel
def finish(
    slots: I32Array, belief: F32Array, messages: AnyArray, sums: I64Array, scale: F32,
    clamp: F32, damping: F32, min_length: F32, moved: I32Array, log_average: Template, strip: Template,
):  # fmt: skip
    """Renew a keyframe's messages with the rays' averages (eq. 7), and the beliefs with them (eq. 8).

    ``moved`` counts, for each brick, the voxels whose marginal changed by more than MOVED.
    """
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        count = 0
        for k in range(strip):
            if length_sum(sums[i + k], scale) > min_length:
                mean = mean_message(sums[i + k])
                log_odds = clamp * (2.0 * mean - 1.0)
                if not ti.static(log_average):
                    log_odds = ti.log(ti.max(mean, TINY) / ti.max(1.0 - mean, TINY))
                    log_odds = ti.max(-clamp, ti.min(clamp, log_odds))
                old = ti.cast(messages[i + k], ti.f32)
                messages[i + k] = old + (1.0 - damping) * (log_odds - old)
                # The belief takes what was stored, not what was meant, so that it stays the sum of messages.
                change = ti.cast(messages[i + k], ti.f32) - old
                before = belief[j + k]
                belief[j + k] = before + change
                count += _moves(before, change)
        if count > 0:
            moved[i // VOXELS] += count


@ti.func
def _moves(log_odds: F32, change: F32) -> I32:
    """Whether a marginal changes by more than MOVED; never by more than a quarter of its log-odds' change."""
    moves = 0
    if ti.abs(change) > 4.0 * MOVED:
        moves = ti.abs(logistic(log_odds + change) - logistic(log_odds)) > MOVED
    return moves


@ti.kernel
def withdraw(slots: I32Array, belief: F32Array, messages: AnyArray, moved: I32Array, strip: Template):
    """Take a keyframe's messages out of the beliefs; ``moved`` counts as in :func:`finish`."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        count = 0
        for k in range(strip):
            message = ti.cast(messages[i + k], ti.f32)
            count += _moves(belief[j + k], -message)
            belief[j + k] -= message
        if count > 0:
            moved[i // VOXELS] += count


@ti.kernel
def fold(slots: I32Array, evidence: F32Array, messages: AnyArray, strip: Template):
    """Add a keyframe's messages to what inference starts from (freezing)."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            evidence[j + k] += ti.cast(messages[i + k], ti.f32)
