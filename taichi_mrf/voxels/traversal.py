"""Rays through the grid: Amanatides & Woo's traversal at three levels, with exact segment lengths.

The same few functions step through chunks, bricks and voxels: a level only differs in the size of its
cells. A ray first steps through chunks, inside a chunk that holds bricks through bricks, and inside a
brick that exists through voxels, so that empty space costs one step for each chunk or brick.

Coordinates are voxels from the corner of a window (window.py), so they stay small and float32 stays
exact to about 1e-4 of a voxel however far from the world's origin the map has grown. A ray is
origin + t * direction; t is axial depth or range, as the direction has it.
"""

from dataclasses import dataclass

from taichi_mrf.system.bundles import Bundle
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, I32Array, IVec3, Mat3, Struct, Template, Vec3
from taichi_mrf.voxels.layout import BRICK, CHUNK, CHUNK_VOXELS, VOXELS
from taichi_mrf.voxels.numbering import flat, voxel_number

FAR = 1e30
"""Stands for 1 / 0 and 'never': finite, because Taichi's fast maths may not keep infinities apart."""


@dataclass(frozen=True)
class Space(Bundle):
    """The bricks of a window that rays meet (WindowIndex.space)."""

    shape: IVec3
    """Size of the window in bricks, a multiple of CHUNK along each axis."""

    lower: Vec3
    """Corner of the mapped part of the window, in voxels from the window's corner."""

    upper: Vec3
    """The opposite corner."""

    chunks: I32Array
    """(chunks of the window): 0 for a chunk without bricks, which a ray passes in one step."""

    bricks: I32Array
    """(bricks of the window): the slot of each brick, -1 where there is none. May be longer."""


@dataclass(frozen=True)
class Viewpoint(Bundle):
    """Pose of a camera in a window (Window.viewpoint)."""

    centre: Vec3
    """The camera's centre, in voxels from the window's corner. Rays start there unless the camera is
    moving."""

    to_voxels: Mat3
    """Turns a direction of the camera frame, in metres, into one of the window, in voxels."""


@ti.dataclass
class Ray(Struct):
    """A ray in a window: origin in voxels, direction in voxels for one unit of t."""

    origin: Vec3
    direction: Vec3
    inverse: Vec3
    step: IVec3


@ti.dataclass
class Walk(Struct):
    """Position of a ray on one level: its cell, and the t at which it leaves it through each axis."""

    cell: IVec3
    leave: Vec3


@ti.func
def lesser(a: F32, b: F32) -> F32:
    """The smaller of two numbers; ``ti.min`` also looks for NaN, which costs more."""
    return ti.select(a < b, a, b)


@ti.func
def greater(a: F32, b: F32) -> F32:
    """The larger of two numbers, likewise."""
    return ti.select(a > b, a, b)


@ti.func
def make_ray(origin: Vec3, direction: Vec3) -> Ray:
    """A ray with its steps and reciprocal direction worked out once."""
    inverse = Vec3(FAR)
    step = IVec3(1)
    for axis in ti.static(range(3)):
        if ti.abs(direction[axis]) > 1e-12:
            inverse[axis] = 1.0 / direction[axis]
            if direction[axis] < 0.0:
                step[axis] = -1
    return Ray(origin, direction, inverse, step)


@ti.func
def ray_start(sensor: Template, view: Template, u: F32, v: F32) -> Vec3:
    """Start of the ray of pixel (u, v): the camera's centre, unless the camera moves while it measures
    (sensor/rays.py)."""
    start = view.centre
    if ti.static(sensor.moving):
        origin = sensor.origin(u, v)
        start = view.centre + view.to_voxels @ origin
    return start


@ti.func
def pixel_ray(sensor: Template, view: Template, u: F32, v: F32) -> Ray:
    """The ray of pixel (u, v) of a sensor (sensor/model.py) in a window; t is depth in metres."""
    # A vector with a name of its own: a product with the bare call is compiled to other roundings.
    direction = sensor.direction(u, v)
    # Without origins nothing is left of them, not even a name: copies are compiled to other roundings too.
    if ti.static(sensor.moving):
        start = ray_start(sensor, view, u, v)
        return make_ray(start, view.to_voxels @ direction)
    else:
        return make_ray(view.centre, view.to_voxels @ direction)


@ti.func
def enter(ray: Ray, t: F32, size: Template, first: IVec3, count: IVec3) -> Walk:
    """Start on a level whose cells are ``size`` voxels wide, at t, inside the parent's cells.

    These are ``count`` cells from ``first`` on, and the walk's cell is counted from there. It is clamped
    among them: a t on the parent's face may round to either side of it, and a cast rounds up below 0.
    """
    walk = Walk(IVec3(0), Vec3(0.0))
    for axis in ti.static(range(3)):
        position = (ray.origin[axis] + t * ray.direction[axis]) * (1.0 / size)
        cell = ti.max(0, ti.min(count[axis] - 1, ti.cast(position, ti.i32) - first[axis]))
        walk.cell[axis] = cell
        face = (first[axis] + cell + (1 if ray.step[axis] > 0 else 0)) * size
        walk.leave[axis] = (face - ray.origin[axis]) * ray.inverse[axis]
    return walk


@ti.func
def leave_at(walk: Walk) -> F32:
    """The t at which the ray leaves its cell."""
    return lesser(lesser(walk.leave[0], walk.leave[1]), walk.leave[2])


@ti.func
def advance(ray: Ray, walk: Template, nearest: F32, size: Template):
    """Step to the next cell, through the nearest face."""
    if walk.leave[0] <= nearest:
        walk.cell[0] += ray.step[0]
        walk.leave[0] += size * ti.abs(ray.inverse[0])
    elif walk.leave[1] <= nearest:
        walk.cell[1] += ray.step[1]
        walk.leave[1] += size * ti.abs(ray.inverse[1])
    else:
        walk.cell[2] += ray.step[2]
        walk.leave[2] += size * ti.abs(ray.inverse[2])


@ti.func
def within(cell: IVec3, count: IVec3) -> I32:
    """True if a cell lies among ``count`` cells."""
    return cell.min() >= 0 and (count - cell).min() > 0


@ti.func
def voxel_in(space: Template, cell: IVec3) -> I32:
    """Index of a voxel among those of its space's bricks (bricks * 512), -1 where no brick is; ``cell``
    counts voxels from the window's corner."""
    brick, voxel = cell >> 3, -1
    if within(brick, space.shape):
        slot = space.bricks[flat(brick, space.shape)]
        if slot >= 0:
            voxel = slot * VOXELS + voxel_number(cell & 7)
    return voxel


@ti.func
def inside_eight(cell: IVec3) -> I32:
    """True if a cell lies among the 8^3 of its parent: a voxel in a brick, a brick in a chunk."""
    return ((cell[0] | cell[1] | cell[2]) & -8) == 0


@ti.func
def clip(ray: Ray, t_begin: Template, t_end: Template, lower: Vec3, upper: Vec3):
    """Cut [t_begin, t_end] to the part of the ray inside the box from ``lower`` to ``upper``."""
    for axis in ti.static(range(3)):
        t_low = (lower[axis] - ray.origin[axis]) * ray.inverse[axis]
        t_high = (upper[axis] - ray.origin[axis]) * ray.inverse[axis]
        t_begin = greater(t_begin, lesser(t_low, t_high))
        t_end = lesser(t_end, greater(t_low, t_high))


@ti.func
def walk_bricks(
    ray: Ray,
    t_begin: F32,
    t_end: F32,
    shape: IVec3,
    chunks: Template,
    skip_empty: Template,
    visit: Template,
    state: Template,
    context: Template,
):
    """Call ``visit(state, context, ray, brick, t, t_leave)`` for each brick of the window along the ray.

    ``shape`` is the window's size in bricks, a multiple of CHUNK; ``chunks`` counts the bricks that
    exist in each chunk, and with ``skip_empty`` an empty chunk is one step. The interval must lie
    inside the window (:func:`clip`). The walk ends where ``visit`` returns 0.
    """
    chunk_shape = shape // CHUNK
    t = t_begin
    go = 1
    chunk = enter(ray, t, CHUNK_VOXELS, IVec3(0), chunk_shape)
    while go == 1 and t < t_end and within(chunk.cell, chunk_shape):
        next_chunk = leave_at(chunk)
        t_chunk = lesser(next_chunk, t_end)
        wanted = 1
        if ti.static(skip_empty):
            wanted = chunks[flat(chunk.cell, chunk_shape)]
        if wanted > 0:
            first = chunk.cell * CHUNK
            brick = enter(ray, t, BRICK, first, IVec3(CHUNK))
            while go == 1 and t < t_chunk and inside_eight(brick.cell):
                next_brick = leave_at(brick)
                t_brick = lesser(next_brick, t_chunk)
                if t_brick > t:  # a ray through an edge touches cells for no length at all
                    go = visit(state, context, ray, first + brick.cell, t, t_brick)
                    t = t_brick
                advance(ray, brick, next_brick, BRICK)
        t = greater(t, t_chunk)
        advance(ray, chunk, next_chunk, CHUNK_VOXELS)


@dataclass(frozen=True)
class InBricks(Bundle):
    """Arguments that :func:`walk_voxels` takes along through the bricks."""

    space: Space
    visit: Template
    context: Template


@ti.func
def walk_voxels(
    ray: Ray, t_begin: F32, t_end: F32, space: Template, visit: Template, state: Template, context: Template
):
    """Call ``visit(state, context, index, t, t_leave)`` for each voxel of the space along the ray.

    Only voxels of bricks that exist. ``index`` is slot * 512 + the voxel's number in its brick. The segments
    [t, t_leave) follow each other without overlap. The interval must lie inside the window (:func:`clip`).
    The walk ends where ``visit`` returns 0.
    """
    walk_bricks(
        ray, t_begin, t_end, space.shape, space.chunks, True, cross_brick, state,
        InBricks(space, visit, context),
    )  # fmt: skip


@ti.func
def cross_brick(state: Template, inside: Template, ray: Ray, brick: IVec3, t_enter: F32, t_leave: F32):
    """Visit the voxels of one brick."""
    go = 1
    slot = inside.space.bricks[flat(brick, inside.space.shape)]
    if slot >= 0:
        t = t_enter
        voxel = enter(ray, t, 1, brick * BRICK, IVec3(BRICK))
        while go == 1 and t < t_leave and inside_eight(voxel.cell):
            next_voxel = leave_at(voxel)
            t_voxel = lesser(next_voxel, t_leave)
            if t_voxel > t:
                index = slot * VOXELS + voxel_number(voxel.cell)
                go = inside.visit(state, inside.context, index, t, t_voxel)
                t = t_voxel
            advance(ray, voxel, next_voxel, 1)
    return go
