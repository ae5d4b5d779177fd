"""The posterior of a ray's first surface: one pass over a keyframe's rays for all who ask what they saw.

With the marginals m of the voxels 1 .. N of a ray, ordered from the camera, and the symbols of
sum_product.py,

    here_i = nu_i m_i vis_i        here_i / (sum_j here_j + beyond + o)                                (4)

is the probability that voxel i made the measurement: the ray reached it, it is occupied, and it explains the
measurement. ``beyond`` is what lies past the end of the map, o the density of a measurement that no surface
made.

In front of all their surfaces the rays of a group have one shared path, as for messages (ray_list.py).

What is done with a ray's posterior is up to a :class:`RayVisitor`. There are three: the surface counts rays
by the chance that they met one (surface_rays.py), pixels feed the voxels that they saw (pixel_pass.py),
and rays vote for their likeliest voxel (surface_votes.py).
"""

import math
from dataclasses import dataclass

from taichi_mrf.inference.keyframe import RayList
from taichi_mrf.inference.ray_list import block_ray, end_of_shared_path, listed_ray
from taichi_mrf.inference.ray_model import RayModel, log_pass
from taichi_mrf.inference.sum_product import crossing, passage
from taichi_mrf.inference.workers import Workers
from taichi_mrf.sensor.model import Sensor
from taichi_mrf.system.bundles import Bundle, kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, F32Array, I32Array, IVec3, Struct, Template, Vec4
from taichi_mrf.voxels.layout import VOXELS
from taichi_mrf.voxels.log_odds import exp_of_negative, log_let_through
from taichi_mrf.voxels.numbering import flat, strip_begin, strip_length
from taichi_mrf.voxels.pool import BrickPool, PoolPart
from taichi_mrf.voxels.traversal import InBricks, Space, Viewpoint, clip, cross_brick, walk_bricks


@ti.dataclass
class Ahead(Struct):
    """A ray on its way from the camera, in front of voxel i. A visitor may use a struct with more members."""

    visibility: F32  # vis_i
    explained: F32  # sum_{j<i} here_j


@dataclass(frozen=True)
class FreeLogs(Bundle):
    """The voxels that rays cross."""

    log_free: F32Array
    """log(1 - m) of each, or log(1 - (1 - s) m), at most 0; (bricks * 512)."""

    closed: I32Array
    """1 if any voxel of a brick is likelier occupied than by the prior; (bricks). In front of the depths that
    can have made its measurement, a ray passes through others as through empty space."""

    @staticmethod
    def of(pool: BrickPool | PoolPart, model: RayModel) -> "FreeLogs":
        """Those of the marginals of a whole map, in the pool's order."""
        log_free = ti.ndarray(ti.f32, max(1, pool.capacity) * VOXELS)
        share = log_pass(model.pass_through)
        _find_free_logs(pool.in_use, pool.belief, share, model.passes, log_free, strip_length())
        return FreeLogs.with_bricks(log_free, pool.capacity, pool.prior_log_odds, model)

    @staticmethod
    def with_bricks(
        log_free: "ti.Ndarray", bricks: int, prior_log_odds: float, model: RayModel
    ) -> "FreeLogs":
        """With the first ``bricks`` of an array."""
        closed = ti.ndarray(ti.i32, max(1, bricks))
        prior = math.exp(prior_log_odds)
        let_through = math.log1p(model.pass_through * prior) - math.log1p(prior)
        # A little more than the prior, which voxels that nothing is known of have but for rounding.
        _find_closed(bricks, log_free, 1.01 * let_through, closed)
        return FreeLogs(log_free, closed)


@dataclass(frozen=True)
class Sight(Bundle):
    """One ray of a keyframe, from depth ``begin`` to depth ``end``, and all that a step along it needs."""

    model: RayModel
    swept: FreeLogs
    sensor: Sensor
    measured: F32  # its measurement, metres
    noise: Template  # of its pixel
    support: F32  # depth before which no surface can have made the measurement
    voxels_per_depth: F32  # length of the ray, in voxels, for one metre of depth
    pixels: I32  # for how many pixels it stands
    number: I32  # in the list of rays
    block: I32  # of pixels, for ray_list.block_of
    worker: I32  # that follows it
    ray: Template
    begin: F32
    end: F32
    reach: Template  # RayVisitor.reach
    space: Space


@dataclass(frozen=True)
class RayVisitor(Bundle):
    """Visitor of the rays of a keyframe. Subclasses have the fields that they need; all their methods are
    ``ti.func``."""

    @ti.func
    def wants(self, rays: Template, number: I32):
        """True if ray ``number`` of a list (keyframe.RayList) is followed."""
        return 1

    @ti.func
    def reach(self, sensor: Template, model: Template, measured: F32, noise: Template, to_voxels: F32):
        """The depth before which no surface can have made a measurement, and the depth at which its ray
        ends, because the measurement carries no more evidence; then two numbers for the visitor itself.
        ``to_voxels`` is the ray's length, in voxels, for one metre of depth."""
        last = sensor.farthest_depth(measured, noise, model.end_sigmas)
        return Vec4(sensor.support(measured, noise), last, 0.0, 0.0)

    @ti.func
    def begin(self, sight: Template):
        """The state of a ray at the camera: an :class:`Ahead`, or a struct with its members and more."""
        return Ahead(1.0, 0.0)

    @ti.func
    def meet(self, ahead: Template, sight: Template, voxel: I32, here: F32):
        """One voxel that may have made the measurement; ``ahead.explained`` has its ``here``. The ray is
        followed no further if this returns 0."""
        return 1

    @ti.func
    def end(self, ahead: Template, sight: Template, beyond: F32):
        """The ray's end. ``beyond`` is the density of the measurement if it met its surface past the map."""


@kernel
def follow_rays(
    rays: RayList, sensor: Sensor, view: Viewpoint, space: Space,
    model: RayModel, swept: FreeLogs, workers: Workers, visitor: RayVisitor,
) -> None:  # fmt: skip
    """Follow the rays of a keyframe for a visitor. ``space`` and ``swept`` hold the bricks that they meet. A
    worker follows one group of rays after the other."""
    if ti.static(workers.block > 0):
        ti.loop_config(block_dim=workers.block)
    for iteration in range(workers.number * workers.spread):
        worker = iteration // workers.spread
        turns = 0
        if iteration % workers.spread == 0:
            turns = workers.turns(rays.group_number)
        for turn in range(turns):
            group = workers.ray(worker, turn)
            if group < rays.group_number:
                # In front of all surfaces of the group only the visibility changes, on the shared path.
                middle = block_ray(rays.groups[group], sensor, view)
                apart = end_of_shared_path(rays, group, middle, 0.0, model.max_depth)
                visibility = _visibility_at(apart, middle, space, model, swept)
                for i in range(rays.first[group], rays.first[group + 1]):
                    if visitor.wants(rays, i) == 1:
                        measured = rays.depth[i]
                        ray, noise, pixels = listed_ray(rays, i, sensor, view)

                        # The ray ends where its measurement carries no more evidence, or where the map ends.
                        to_voxels = ray.direction.norm()
                        reach = visitor.reach(sensor, model, measured, noise, to_voxels)
                        support, last = reach[0], reach[1]
                        begin, end = 0.0, ti.min(last, model.max_depth)
                        clip(ray, begin, end, space.lower, space.upper)

                        sight = Sight(
                            model, swept, sensor, measured, noise, support,
                            to_voxels, pixels, i, rays.blocks[i], worker, ray, begin, end, reach, space,
                        )  # fmt: skip
                        ahead = visitor.begin(sight)
                        ahead.visibility = visibility
                        own = ti.max(begin, apart)  # a name of its own: the sight keeps ``begin``
                        walk_bricks(
                            ray, own, end, space.shape, space.chunks, True, _see_brick, ahead,
                            InBricks(space, _see, _Visited(sight, visitor)),
                        )  # fmt: skip
                        beyond = 0.0
                        if end < last:
                            beyond = ahead.visibility * sensor.likelihood_beyond(measured, end, noise)
                        visitor.end(ahead, sight, beyond)


@dataclass(frozen=True)
class _Passed(Bundle):
    """A ray that passes in front of all surfaces."""

    model: RayModel
    swept: FreeLogs
    voxels_per_depth: F32


@ti.func
def _visibility_at(depth: F32, ray: Template, space: Template, model: Template, swept: Template):
    """vis of what lies at a depth, in front of which no surface made a measurement."""
    begin, end = 0.0, depth
    clip(ray, begin, end, space.lower, space.upper)
    ahead = Ahead(1.0, 0.0)
    walk_bricks(
        ray, begin, end, space.shape, space.chunks, True, _pass_brick, ahead,
        InBricks(space, _pass, _Passed(model, swept, ray.direction.norm())),
    )  # fmt: skip
    return ahead.visibility


@ti.func
def _pass_brick(ahead: Template, inside: Template, ray: Template, brick: IVec3, near: F32, far: F32):
    """One brick in front of all surfaces."""
    slot, closed = inside.space.bricks[flat(brick, inside.space.shape)], 0
    if slot >= 0:
        closed = inside.context.swept.closed[slot]
    if closed == 1:
        cross_brick(ahead, inside, ray, brick, near, far)
    return 1


@ti.func
def _pass(ahead: Template, passed: Template, voxel: I32, near: F32, far: F32):
    """One voxel in front of all surfaces."""
    _, log_free = passage(passed, voxel, near, far)
    ahead.visibility *= exp_of_negative(log_free)
    return 1


@dataclass(frozen=True)
class _Visited(Bundle):
    """A ray and who looks at it."""

    sight: Sight
    visitor: RayVisitor


@ti.func
def _see_brick(ahead: Template, inside: Template, ray: Template, brick: IVec3, near: F32, far: F32):
    """One brick of a ray."""
    slot, go = inside.space.bricks[flat(brick, inside.space.shape)], 1
    if slot >= 0:
        sight = inside.context.sight
        if far > sight.support or sight.swept.closed[slot] == 1:
            go = cross_brick(ahead, inside, ray, brick, near, far)
    return go


@ti.func
def _see(ahead: Template, visited: Template, voxel: I32, near: F32, far: F32):
    """One voxel of a ray, which is in it from depth ``near`` to ``far``."""
    met = crossing(visited.sight, voxel, near, far)
    free = exp_of_negative(met[1])
    go = 1
    if met[2] > 0.0:
        here = (1.0 - free) * met[2] * ahead.visibility
        ahead.explained += here
        go = visited.visitor.meet(ahead, visited.sight, voxel, here)
    ahead.visibility *= free
    return go


@kernel
def _find_free_logs(
    slots: I32Array, belief: F32Array, share: F32, passes: Template, log_free: F32Array, strip: Template
) -> None:
    """``log_free`` of the bricks in ``slots`` (n) from their log-odds, as sum_product.cavity has it.
    ``belief`` and ``log_free`` are (pool * 512); ``share`` is the logarithm of what passes."""
    for part in range(slots.shape[0] * (VOXELS // strip)):
        _, j = strip_begin(part, slots, strip)
        for k in range(strip):
            log_free[j + k] = log_let_through(belief[j + k], share, passes)


@ti.kernel
def _find_closed(bricks: I32, log_free: F32Array, prior: F32, closed: I32Array):
    """FreeLogs.closed: whether a brick has a ``log_free`` below that of the ``prior``."""
    for brick in range(bricks):
        least = 0.0
        for k in range(VOXELS):
            least = ti.min(least, log_free[brick * VOXELS + k])
        closed[brick] = ti.cast(least < prior, ti.i32)
