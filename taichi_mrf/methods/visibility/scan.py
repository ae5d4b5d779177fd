"""The kernels of visibility-aware occupancy mapping: one scan into the map.

Schauwecker & Zell, "Robust and Efficient Volumetric Occupancy Mapping with an Application to Stereo Vision"
(IROS 2014); equation numbers are theirs. A voxel v is occupied (O_v), visible (V_v), locally occluded (C_v),
or inside the obstacle that a ray measured (I_v). A scan is integrated in three steps:

    hide     is a voxel occluded by its neighbours towards the sensor?                              (1)
    follow   each ray: is the voxel visible from here, and inside the obstacle?           (2), (3), (7)
    update   each voxel once, with the scan's largest P(V_v) and largest P(I_v)          (4) to (6), (8)

Visibility is computed in the map before the scan, so the order of the rays does not matter. The paper updates
each voxel once per scan and lets hits override misses, as OctoMap does; with P(I_v) between 0 and 1, the
largest is used. A voxel is hidden only if it is hidden from all rays, so the largest P(V_v) is used too.
"""

from dataclasses import dataclass
from statistics import NormalDist

from taichi_mrf.methods.recursive_update import updated
from taichi_mrf.sensor.forward import SUPPORT, normal_tail
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, IVec3, Struct, Template, Vec3
from taichi_mrf.voxels.layout import BRICK, VOXELS
from taichi_mrf.voxels.log_odds import logistic
from taichi_mrf.voxels.numbering import flat
from taichi_mrf.voxels.traversal import Space, Viewpoint, clip, pixel_ray, walk_voxels

UNKNOWN = 0.5
"""P(O_v) of a voxel without a brick; a new brick starts with it too (recursive_update)."""

SURE = 0.95
"""P(I_v) that is "close to 1" (section III-C): the ray crosses one more voxel, a full hit, and ends. A
smaller value makes walls thinner."""

SURE_SIGMAS = NormalDist().inv_cdf(SURE)
"""Sigmas behind the measurement at which P(I_v) is SURE."""

BEYOND_VOXELS = 4.5
"""Voxel sizes behind that depth by which every ray has ended: the voxel at this depth, one whose segment's
centre lies behind it, and one more, each up to sqrt(3) long."""

GRAZED = 1e-4
"""A ray's segment in a voxel that is shorter than this, in voxel sizes, is skipped: it is below the precision
of float32 (voxels/traversal.py). At the face of the mapped box it keeps the other side unknown."""


@ti.dataclass
class Beam(Struct):
    """The state of a ray on its way from the sensor."""

    measured: F32  # axial depth in metres, without the sensor's bias
    sigma: F32  # of that measurement
    grazed: F32  # the least axial depth to spend in a voxel, metres
    visible: F32  # P(V) of the last voxel
    sure: I32  # whether P(I) of that voxel reached SURE


@dataclass(frozen=True)
class SeenVoxels(Bundle):
    """The visibility of each voxel that a scan's rays cross. Arrays (crossed bricks * 512)."""

    occluded: F32Array
    """P(C_v)."""

    visible: I32Array
    """The largest P(V_v) of any ray, as the bits of a float. Positive floats are ordered like their bits,
    and integers have an atomic maximum on every backend."""

    inside: I32Array
    """The largest P(I_v) of any ray, in the same form."""


@dataclass(frozen=True)
class RayLimits(Bundle):
    """Limits on the visibility of rays (VisibilityConfig)."""

    voxel_size: F32
    """Metres."""

    max_depth: F32
    """Metres of depth that no ray goes beyond."""

    max_range: F32
    """Metres of range that no ray goes beyond."""

    if_occluded: F32
    """P(V) of a voxel that is occluded by its neighbours, if the one before it on the ray is visible."""

    if_clear: F32
    """P(V) of a voxel that is not occluded, if the one before it on the ray is visible."""

    q_min: F32
    """P(V) below which a ray ends."""

    q_max: F32
    """P(V) of at least this counts as 1."""


@dataclass(frozen=True)
class OccludedFromCentre(Bundle):
    """P(C_v) where all rays start at one place: :func:`hide` has computed it."""

    occluded: F32Array
    """(crossed bricks * 512)"""

    @ti.func
    def of(self, voxel: I32, ray: Template, depth: F32) -> F32:
        """That of a voxel that a ray crosses at a depth."""
        return self.occluded[voxel]


@dataclass(frozen=True)
class OccludedFromRay(Bundle):
    """P(C_v) where each ray starts at a place of its own. ``space`` and ``belief`` are those of
    :func:`hide`."""

    space: Space
    belief: F32Array

    @ti.func
    def of(self, voxel: I32, ray: Template, depth: F32) -> F32:
        """That of a voxel that a ray crosses at a depth."""
        place = ray.origin + depth * ray.direction
        cell, start = ti.floor(place, ti.i32), ti.floor(ray.origin, ti.i32)
        return local_occlusion(cell, start, self.space, self.belief)


Occluded = OccludedFromCentre | OccludedFromRay


@dataclass(frozen=True)
class _Followed(Bundle):
    """Input and output of a step along a ray."""

    ray: Template
    occluded: Template
    seen: SeenVoxels
    limits: RayLimits


@kernel
def hide(cells: I32Array, centre: Vec3, space: Space, belief: F32Array, seen: SeenVoxels) -> None:
    """P(C_v) of each voxel of the bricks at a window's ``cells`` (n); P(V_v) and P(I_v) are reset to 0.

    ``space`` holds the pool's slots of all bricks of the window, crossed by this scan or not;
    ``belief`` (pool * 512) log-odds; ``centre`` is the camera's, in voxels.
    """
    sensor = ti.floor(centre, ti.i32)
    for i in range(cells.shape[0] * VOXELS):
        cell, number, shape = cells[i // VOXELS], i % VOXELS, space.shape
        brick = IVec3(cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2])
        voxel = brick * BRICK + IVec3(number // BRICK**2, number // BRICK % BRICK, number % BRICK)
        seen.occluded[i] = local_occlusion(voxel, sensor, space, belief)
        seen.visible[i] = 0
        seen.inside[i] = 0


@ti.func
def local_occlusion(voxel: IVec3, sensor: IVec3, space: Template, belief: Template) -> F32:
    """Eq. 1: the least P(O) of the voxels at those faces of v that the sensor sees, usually three.

    In the slab of voxels that holds the sensor, neither of an axis' faces can be seen, and a voxel that
    holds the sensor itself is not occluded.
    """
    least = 1.0
    seen = 0
    for axis in ti.static(range(3)):
        neighbour = voxel
        if sensor[axis] != voxel[axis]:
            neighbour[axis] += 1 if sensor[axis] > voxel[axis] else -1
            least = ti.min(least, occupancy(neighbour, space, belief))
            seen = 1
    return least * seen


@ti.func
def occupancy(voxel: IVec3, space: Template, belief: Template) -> F32:
    """P(O) of any voxel, in whatever brick it lies: UNKNOWN where there is none.

    Voxels outside the mapped box count as free, so they never occlude.
    """
    probability = UNKNOWN
    middle = ti.cast(voxel, ti.f32) + 0.5
    if (middle - space.lower).min() < 0.0 or (space.upper - middle).min() < 0.0:
        probability = 0.0
    else:
        slot = space.bricks[flat(voxel // BRICK, space.shape)]
        if slot >= 0:
            local = voxel % BRICK
            number = (local[0] * BRICK + local[1]) * BRICK + local[2]
            probability = logistic(belief[slot * VOXELS + number])
    return probability


@kernel
def follow(
    depth: F32Array, sensor: Sensor, view: Viewpoint, space: Space, occluded: Occluded, limits: RayLimits,
    seen: SeenVoxels,
) -> None:  # fmt: skip
    """Follow each ray until it is no longer visible, or surely inside the measured obstacle.

    ``depth`` is (H * W) metres, 0 without a measurement.
    """
    for pixel in range(depth.shape[0]):
        if depth[pixel] > 0.0:
            u, v = sensor.pixel(pixel)
            ray = pixel_ray(sensor, view, u, v)
            noise = sensor.noise_at(u, v)
            voxels_per_depth = ray.direction.norm()

            # Eq. 7, with any noise model: the sigma of the depth that the measurement stands for.
            measured = sensor.surface_depth(depth[pixel], noise)
            sigma = noise.sigma(measured)

            range_per_depth = voxels_per_depth * limits.voxel_size
            end = measured + SURE_SIGMAS * sigma + BEYOND_VOXELS * limits.voxel_size
            begin, end = 0.0, ti.min(end, limits.max_depth, limits.max_range / range_per_depth)
            clip(ray, begin, end, space.lower, space.upper)

            beam = Beam(measured, sigma, GRAZED / voxels_per_depth, 1.0, 0)
            walk_voxels(ray, begin, end, space, _come_through, beam, _Followed(ray, occluded, seen, limits))


@ti.func
def _come_through(beam: Template, followed: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray; ``near`` and ``far`` bound the ray's segment in it, in depth."""
    seen, limits = followed.seen, followed.limits
    go = 1
    if far - near > beam.grazed:
        occluded = followed.occluded.of(voxel, followed.ray, 0.5 * (near + far))
        beam.visible = visibility(beam.visible, occluded, limits.if_occluded, limits.if_clear, limits.q_max)
        if beam.visible < limits.q_min:
            go = 0
        else:
            # The voxel is reduced to a point on the ray: the centre of the ray's segment in it.
            probability = 1.0
            if beam.sure == 0:
                probability = inside_obstacle(0.5 * (near + far), beam.measured, beam.sigma)
            else:
                go = 0  # this was the one more voxel
            if probability >= SURE:
                beam.sure = 1
            _raise(seen.visible, voxel, beam.visible)
            _raise(seen.inside, voxel, probability)
    return go


@ti.func
def visibility(before: F32, occluded: F32, if_occluded: F32, if_clear: F32, q_max: F32) -> F32:
    """Eqs. 2 and 3: P(V) of a voxel, from that of the one before it and its own P(C); 1 from q_max on.

    A voxel behind one that is not visible is not visible either, so two of eq. 2's terms are 0.
    """
    visible = before * (if_occluded * occluded + if_clear * (1.0 - occluded))
    return visible if visible < q_max else 1.0


@ti.func
def inside_obstacle(depth: F32, measured: F32, sigma: F32) -> F32:
    """P(I): the normal distribution's F((depth - measured) / sigma)."""
    deviation = (depth - measured) / sigma
    probability = 0.0
    if deviation > 0.0:
        probability = 1.0 - normal_tail(deviation)
    elif deviation > -SUPPORT:
        probability = normal_tail(-deviation)
    return probability


@ti.func
def _raise(largest: Template, voxel: I32, value: F32):
    """Keep the larger of a voxel's value, as the bits of a float, and this one."""
    bits = ti.bit_cast(value, ti.i32)
    if largest[voxel] < bits:  # most rays come late, and reading is cheaper
        ti.atomic_max(largest[voxel], bits)


@ti.kernel
def update(
    slots: I32Array, belief: F32Array, visible: I32Array, inside: I32Array,
    hit_if_occupied: F32, hit_if_free: F32, hit_if_hidden: F32, lowest: F32, highest: F32,
):  # fmt: skip
    """Update each voxel that some ray has seen once; its log-odds stay within [lowest, highest].

    ``slots`` (n) are the crossed bricks' places in the pool, ``belief`` (pool * 512) log-odds; ``visible``
    and ``inside`` (n * 512) those of SeenVoxels.
    """
    for i in range(slots.shape[0] * VOXELS):
        seen = ti.bit_cast(visible[i], ti.f32)
        if seen > 0.0:
            j = slots[i // VOXELS] * VOXELS + i % VOXELS
            before = belief[j]
            occupied = interpolated(
                logistic(before), seen, ti.bit_cast(inside[i], ti.f32),
                hit_if_occupied, hit_if_free, hit_if_hidden,
            )  # fmt: skip
            belief[j] = updated(before, ti.log(occupied / (1.0 - occupied)) - before, lowest, highest)


@ti.func
def interpolated(
    occupied: F32, visible: F32, inside: F32, hit_if_occupied: F32, hit_if_free: F32, hit_if_hidden: F32
) -> F32:
    """Eq. 8: P(O | M) between that after a miss and that after a hit."""
    hit = bayes(occupied, visible, hit_if_occupied, hit_if_free, hit_if_hidden)
    miss = bayes(occupied, visible, 1.0 - hit_if_occupied, 1.0 - hit_if_free, 1.0 - hit_if_hidden)
    return inside * hit + (1.0 - inside) * miss


@ti.func
def bayes(occupied: F32, visible: F32, if_occupied: F32, if_free: F32, if_hidden: F32) -> F32:
    """P(O | M) of a hit or a miss M, from P(O), P(V), P(M | O, V), P(M | not O, V) and P(M | not V)."""
    hidden = if_hidden * (1.0 - visible)
    of_occupied = hidden + if_occupied * visible  # eq. 5
    of_any = hidden + if_occupied * occupied * visible + if_free * (1.0 - occupied) * visible  # eq. 6
    return of_occupied * occupied / of_any  # eq. 4
