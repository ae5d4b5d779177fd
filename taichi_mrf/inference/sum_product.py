"""Sum-product belief propagation on the ray Markov random field: the method itself.

    p(o, d) = 1/Z  prod_i phi(o_i)  prod_r psi_r(o_r, d_r)                                    (1)

A voxel o_i is 1 if occupied; a ray r is a factor over all voxels that it crosses, and rates how well the
first occupied one among them explains the measured depth (eqs. 3 to 5). Equation numbers are those of
Shankar & Michael, "MRFMap: Online Probabilistic 3D Mapping using Forward Ray Sensor Models" (RSS 2020);
the supplement's are marked S.

All rays of a keyframe send a voxel the same, average message (section IV-A), so a keyframe keeps one
message for each voxel that it sees. Where none of the rays of a group can have met its surface yet, nu is 0
and all say the same, so one way through the middle of the group stands for all (ray_list.py). A sweep over
a keyframe is four steps:

    cavity     belief of each voxel without the keyframe's own message                          (6)
    forward    follow each ray: which voxel may have made the measurement?                  (4), (11)
    backward   the message of the ray to each voxel                                        (13), (14)
    finish     average over rays, renew the keyframe's message, update the beliefs          (7), (8)

Messages and beliefs are log-odds. A ray that spends the length l (in voxel sizes) in a voxel passes it with
probability (1 - m)^l. In the symbols of section III, for the voxels 1 .. N of one ray from the camera on:

    m_i         cavity probability of occupied      exp(log_free) = 1 - m_i, or 1 - (1 - s) m_i
    nu_i        likelihood of the measurement if voxel i is the first surface                   (4)
    vis_i       prod_{k<i} (1 - m_k)^l_k                                        ForwardPass.visibility
    before_i    sum_{j<i} nu_j m_j vis_j                                         ForwardPass.explained
    behind_i    sum_{j>i} nu_j m_j vis_j, and what lies beyond the map

With the chance s that a ray passes through an occupied voxel (``pass_through``; 0 in the paper), m becomes
(1 - s) m in all of these, and a voxel's message for occupied has the share s of that for empty.
"""

from dataclasses import dataclass

from taichi_mrf.inference.accumulators import add_message, length_sum, mean_message
from taichi_mrf.inference.keyframe import RayList
from taichi_mrf.inference.ray_list import block_ray, end_of_shared_path, listed_ray
from taichi_mrf.inference.ray_model import RayModel, SweptVoxels, Trace
from taichi_mrf.inference.workers import Workers
from taichi_mrf.sensor.forward import AUTO
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import (
    F32,
    I32,
    AnyArray,
    F32Array,
    I32Array,
    I64Array,
    Struct,
    Template,
    Vec3,
    Vec4,
)
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.log_odds import clamped_log_odds, exp_of_negative, log_let_through, moves
from taichi_mrf.voxels.numbering import strip_begin
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, walk_voxels

TINY = 1e-30
"""Keeps a ray that explains nothing, without an outlier floor, from dividing zero by zero."""


@ti.dataclass
class ForwardPass(Struct):
    """A ray on its way from the camera, in front of voxel i."""

    visibility: F32  # vis_i
    explained: F32  # before_i
    voxels: I32  # i


@dataclass(frozen=True)
class Cast(Bundle):
    """One ray, and all that a step along it needs."""

    model: RayModel
    swept: SweptVoxels
    sensor: Sensor
    measured: F32  # its measurement, metres
    noise: Template  # of its pixel
    support: F32  # depth before which no surface can have made a measurement of its group
    voxels_per_depth: F32  # length of the ray, in voxels, for one metre of depth
    pixels: F32  # for how many pixels it stands


@kernel
def cavity(
    slots: I32Array, belief: F32Array, messages: AnyArray, lowest: F32, highest: F32,
    log_pass: F32, passes: Template, log_free: F32Array, sums: I64Array, strip: Template,
) -> None:  # fmt: skip
    """Step 3, eq. 6: the belief of each voxel without this keyframe's own message.

    ``slots`` (n) are the visible bricks' places in the pool, ``belief`` (pool * 512) log-odds and
    ``messages`` (n * 512) log-odds, float16 or float32. Writes log(1 - (1 - s) m) to ``log_free`` (n * 512),
    with log-odds bounded by ``lowest`` and ``highest`` and the logarithm ``log_pass`` of s
    (kernels/log_odds.py), and sets the ``sums`` (n * 512) to zero. ``strip`` is the
    number of voxels for an iteration (voxels/numbering.py), here and below.
    """
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        for k in range(strip):
            log_odds = belief[j + k] - ti.cast(messages[i + k], ti.f32)
            bounded = ti.max(lowest, ti.min(highest, log_odds))
            log_free[i + k] = log_let_through(bounded, log_pass, passes)
            sums[i + k] = 0


@kernel
def send_messages(
    rays: RayList, begin_depth: F32, sensor: Sensor, view: Viewpoint, space: Space,
    model: RayModel, swept: SweptVoxels, trace: Trace, workers: Workers,
) -> None:  # fmt: skip
    """Follow the rays of a keyframe out and back, from ``begin_depth`` on, and sum up their messages to each
    voxel.

    A worker follows one group of rays after the other: its shared path in front of all surfaces, from there
    on each ray by itself out and back, and the shared path back. It writes each step into its own part of
    the trace and reads it on the way back.
    """
    if ti.static(workers.block > 0):
        ti.loop_config(block_dim=workers.block)
    for iteration in range(workers.number * workers.spread):
        worker = iteration // workers.spread
        largest = ti.exp(model.clamp)
        turns = 0
        if iteration % workers.spread == 0:
            turns = workers.turns(rays.group_number)
            trace.steps[worker] = 0
        for turn in range(turns):
            group = workers.ray(worker, turn)
            if group < rays.group_number:
                # In front of all surfaces of the group, forward: nu_j is 0, so only vis_i changes.
                support = rays.support[group]
                middle = block_ray(rays.groups[group], sensor, view)
                apart = end_of_shared_path(rays, group, middle, begin_depth, model.max_depth)
                begin, end = begin_depth, apart
                clip(middle, begin, end, space.lower, space.upper)
                common, behind_all, pixels_all = ForwardPass(1.0, 0.0, 0), 0.0, 0.0
                shared = _SharedPath(model, swept, trace, worker, middle.direction.norm())
                walk_voxels(middle, begin, end, space, _trace_free, common, shared)

                for i in range(rays.first[group], rays.first[group + 1]):
                    measured = rays.depth[i]
                    ray, noise, pixels = listed_ray(rays, i, sensor, view)
                    cast = Cast(
                        model, swept, sensor, measured, noise, support,
                        ray.direction.norm(), ti.cast(pixels, ti.f32),
                    )  # fmt: skip

                    # The ray ends where its measurement carries no more evidence, or where the map ends.
                    last = rays.last[i]
                    begin, end = apart, ti.min(sensor.until(measured, last), model.max_depth)
                    clip(ray, begin, end, space.lower, space.upper)

                    # Step 4, forward, eqs. 4 and 11, from the camera outwards:
                    # before_i = sum_{j<i} nu_j m_j vis_j, vis_i = prod_{k<i} (1 - m_k)^l_k.
                    ahead = ForwardPass(common.visibility, 0.0, 0)
                    traced = _Traced(cast, trace, worker, common.voxels)
                    walk_voxels(ray, begin, end, space, _trace_voxel, ahead, traced)
                    trace.steps[worker] += ahead.voxels

                    # A ray that gets through to the end of the map may have met its surface there.
                    behind = 0.0
                    if end < last:
                        behind = ahead.visibility * sensor.likelihood_beyond(measured, end, noise)

                    # Step 5, backward, eqs. 13 and 14, from the far end: occupied = before_i + nu_i vis_i,
                    # empty = before_i + behind_i / (1 - m_i)^l_i, and log(occupied / empty) is sent.
                    for step in range(ahead.voxels):
                        j = trace.place(worker, common.voxels + ahead.voxels - 1 - step)
                        weight, free = trace.step[j][0], trace.step[j][1]
                        density, before = trace.step[j][2], trace.step[j][3]
                        message = _message(model, before, density, behind, free, largest)
                        behind += (1.0 - free) * density
                        add_message(swept.sums, trace.voxel[j], weight, message, swept.scale)
                    behind_all += cast.pixels * behind
                    pixels_all += cast.pixels

                # In front of all surfaces, backward: behind_i is the mean of the rays', and for all of them.
                trace.steps[worker] += common.voxels
                behind = behind_all / pixels_all
                for step in range(common.voxels):
                    j = trace.place(worker, step)
                    weight, free = trace.step[j][0], trace.step[j][1]
                    message = _message(model, 0.0, 0.0, behind, free, largest)
                    add_message(swept.sums, trace.voxel[j], pixels_all * weight, message, swept.scale)


@dataclass(frozen=True)
class _SharedPath(Bundle):
    """The shared path of a group, which a worker writes down in its trace."""

    model: RayModel
    swept: SweptVoxels
    trace: Trace
    worker: I32
    voxels_per_depth: F32


@ti.func
def _trace_free(ahead: Template, way: Template, voxel: I32, near: F32, far: F32):
    """One voxel of the shared path, in which no surface can have made a measurement."""
    length, log_free = passage(way, voxel, near, far)
    if ti.static(not way.model.segment_lengths):
        length = 1.0
    free = exp_of_negative(log_free)
    j = way.trace.place(way.worker, ahead.voxels)
    way.trace.voxel[j] = voxel
    way.trace.step[j][0] = length
    way.trace.step[j][1] = free
    ahead.visibility *= free
    ahead.voxels += 1
    return 1


@dataclass(frozen=True)
class _Traced(Bundle):
    """A ray that a worker writes down in its trace, after the ``shared`` steps of its group."""

    cast: Cast
    trace: Trace
    worker: I32
    shared: I32


@ti.func
def passage(way: Template, voxel: I32, near: F32, far: F32):
    """l_i and log(1 - m_i)^l_i of a voxel, in which a ray is from depth ``near`` to ``far``."""
    length = (far - near) * way.voxels_per_depth
    log_free = way.swept.log_free[voxel]
    if ti.static(way.model.segment_lengths):
        log_free *= length
    return length, log_free


@ti.func
def crossing(cast: Template, voxel: I32, near: F32, far: F32) -> Vec3:
    """l_i, log(1 - m_i)^l_i and nu_i of a voxel, in which the ray is from depth ``near`` to ``far``."""
    length, log_free = passage(cast, voxel, near, far)
    density = 0.0
    if far > cast.support:
        density = cast.sensor.likelihood(cast.measured, near, far, cast.noise, cast.model.voxel_size, AUTO)
    return Vec3(length, log_free, density)


@ti.func
def _explain(ahead: Template, met: Vec3) -> Vec4:
    """Eqs. 4 and 11 for one voxel: it is visible, it is occupied, and it explains the measurement.

    Renews ``ahead``; returns the step that the way back reads: weight, (1 - m)^l, nu * vis, before.
    """
    free = exp_of_negative(met[1])
    density = met[2] * ahead.visibility
    before = ahead.explained
    ahead.explained += (1.0 - free) * density
    ahead.visibility *= free
    return Vec4(met[0], free, density, before)


@ti.func
def _trace_voxel(ahead: Template, traced: Template, voxel: I32, near: F32, far: F32):
    """One voxel of the forward pass, written down in the trace."""
    met = crossing(traced.cast, voxel, near, far)
    met[0] = _weight(traced.cast, met[0])
    j = traced.trace.place(traced.worker, traced.shared + ahead.voxels)
    traced.trace.voxel[j] = voxel
    traced.trace.step[j] = _explain(ahead, met)
    ahead.voxels += 1
    return 1


@ti.func
def _message(model: Template, before: F32, here: F32, behind: F32, free: F32, largest: F32) -> F32:
    """Eqs. 13 and 14 as one number in [0, 1] for the accumulators. ``largest`` is e^clamp."""
    occupied = occupied_message(before, here, model.floor)
    empty = empty_message(before, behind, free, model.floor)
    if ti.static(model.passes):
        occupied += model.pass_through * (empty - occupied)
    return clamped_log_odds(occupied, empty, model.clamp, largest)


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


@ti.func
def _weight(cast: Template, length: F32) -> F32:
    """Section IV-A: a ray's message counts by its length in the voxel, and by the pixels it stands for."""
    weight = cast.pixels
    if ti.static(cast.model.segment_lengths):
        weight *= length
    return weight


@kernel
def finish(
    slots: I32Array, belief: F32Array, messages: AnyArray, sums: I64Array, scale: F32,
    clamp: F32, least_length: F32, moved: I32Array, strip: Template,
) -> None:  # fmt: skip
    """Step 6: renew a keyframe's messages with the rays' averages, eq. 7, and with them the beliefs, eq. 8.

    ``slots`` (n) are the visible bricks' places in the pool, ``belief`` (pool * 512) and ``messages`` (n *
    512) log-odds, ``sums`` (n * 512) those of the rays. A voxel that rays crossed for ``least_length`` voxel
    sizes or less keeps its message. ``moved`` (n) counts, for each brick, the voxels whose marginal changed
    by more than MOVED.
    """
    for part in range(slots.shape[0] * (VOXELS // strip)):
        i, j = strip_begin(part, slots, strip)
        count = 0
        for k in range(strip):
            packed = sums[i + k]
            if packed != 0 and length_sum(packed, scale) > least_length:
                old = ti.cast(messages[i + k], ti.f32)
                messages[i + k] = clamp * (2.0 * mean_message(packed) - 1.0)
                # The belief takes what was stored, not what was meant, so that it stays the sum of messages.
                change = ti.cast(messages[i + k], ti.f32) - old
                before = belief[j + k]
                belief[j + k] = before + change
                count += moves(before, change)
        if count > 0:
            moved[i // VOXELS] += count
